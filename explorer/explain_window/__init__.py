"""The explain window: evidence, heatmaps, comparison, sweep, region search, and a second model, in tabs."""
