"""The explain window: evidence, comparison, sweep, region search, and a second model, in tabs."""
