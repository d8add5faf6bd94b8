"""The analysis of tasks: one query with `QueryAnalyser`; all queries with failure rates, comparisons, and embedding maps.

The package imports `explain`, `tasks`, and the packages below them; it draws nothing.
"""
