"""Damaged and hostile input for everything that is read from files or from an address: `python -m tools.fuzz.readers`."""
