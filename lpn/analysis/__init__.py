"""All queries of a task at once: outcomes, failure rates, annotations, and embedding maps.

It imports `explain` and the packages below it; it draws nothing."""
