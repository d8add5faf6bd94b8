"""Fuzzing of everything that is read from files or from a URL: `python -m tools.fuzz.readers`."""
