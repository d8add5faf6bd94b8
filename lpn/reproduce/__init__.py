"""Reproduction of the paper's tables and figures: training, measurement, and tables beside the paper's values.

It imports `training`, `analysis`, `drawing`, and the packages below them; `cli` imports it. `tables.toml` has the paper's tables.
"""
