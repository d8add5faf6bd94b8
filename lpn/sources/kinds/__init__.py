"""The kinds of source, one for each file; `lpn.sources.recognise` finds them."""
