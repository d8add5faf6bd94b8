"""Tasks and their analysis: one query with `QueryAnalyser`; all queries with outcomes, failure rates, notes, and maps.

`Task` lives here rather than in `retrieval`, because it yields outcomes and tables; the ranking cache, which needs a task, lives
here for the same reason. The package imports `explain` and the packages below it; it draws nothing.
"""
