"""The layers between the network and the app: authentication, rate limits, the message filter, and viser's private API.

Imports `lpn.core` only, and nothing else of `explorer`; `app`, `uploads`, and the views import it.
"""
