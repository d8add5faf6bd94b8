"""One file for each published method, or for several methods of one network; each file has `ADAPTERS`."""
