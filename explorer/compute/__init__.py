"""The inference scheduler, background jobs, and caches that all browsers share.

Nothing here draws."""
