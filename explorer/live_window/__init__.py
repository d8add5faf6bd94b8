"""The page of a flight that goes on: `lpn locate --live` in a browser.

`record` keeps what was located, `window` shows it to one browser with the HTML and scripts of the flight window, and `server`
serves the page. Only `explorer.cli` imports this package.
"""
