"""The layouts of data sets, a file each. A package brings another by an entry point, see `lpn.datasets`."""
