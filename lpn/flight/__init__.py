"""Flights over a map of one's own: files of a flight, maps, where each photo was taken, and flights that go on.

Nothing of LPN needs this package. Commands, sources, and the explorer reach it by entry points; the few imports from outside
are listed in `tests/test_architecture.py`.
"""
