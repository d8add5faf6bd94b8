"""Flights over a user's map: files of a flight, maps, the place of each photo, and flights in progress.

Nothing of LPN needs this package. Commands, sources, and the explorer reach it by entry points; the few imports from outside
are listed in `tests/test_architecture.py`.
"""
