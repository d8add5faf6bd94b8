"""Everything between the network and the app: authentication, message filter, rate limiter, and viser itself.

It imports `lpn.core` and no other package of `explorer`."""
