"""Scheduling of the computations that all browsers share: inference, background jobs, and caches.

Nothing here draws. Imports `lpn`; `app`, `workspace`, and the windows import it.
"""
