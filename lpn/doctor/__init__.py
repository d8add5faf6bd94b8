"""Checks of a machine, of a data set's folder, and of files against their checksums.

It may import every package of `lpn` but `cli`."""
