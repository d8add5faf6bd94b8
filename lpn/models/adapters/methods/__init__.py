"""One file for each published method, or for methods of one network; each has `ADAPTERS`."""
