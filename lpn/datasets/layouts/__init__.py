"""The layouts of data sets, one for each file. Packages add others by entry points, see `lpn.datasets`."""
