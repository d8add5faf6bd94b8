"""Fuzzing of all readers of files and URLs: `python -m tools.fuzz.readers`."""
