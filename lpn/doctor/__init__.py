"""Checks of a machine (`environment_check`), a data set (`dataset_check`), a model (`model_check`), and written files (`verify`).

It imports `training` and the packages below it; only `cli` imports it. `environment_check` must work without any
installed package, so nothing is imported here.
"""
