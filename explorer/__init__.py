"""The LPN Explorer app: per-browser session state, and views that draw what `lpn` computes."""
