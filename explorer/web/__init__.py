"""HTML templates, CSS, and JavaScript of the page, and the bridge to that script.

Every view of the explorer may import this package; it imports only `explorer.server` and `lpn`.
"""
