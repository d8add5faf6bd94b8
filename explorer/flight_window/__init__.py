"""The flight window: a flight over its map, with the answers of all stages, a timeline, and the scores of all windows.

`pictures` serves tiles and photos to all browsers, `page` renders, `messages` checks what the page sends, and `window` shows
one browser's view. Only `explorer.client` and `explorer.app` import this package.
"""
