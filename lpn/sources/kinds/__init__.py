"""The kinds of source, a file each; `lpn.sources.recognise` finds them."""
