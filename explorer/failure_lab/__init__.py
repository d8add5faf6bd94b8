"""The failure laboratory: all queries of a task as a table, charts, and maps."""
