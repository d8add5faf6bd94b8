"""The failure laboratory: all queries of a task as a table, charts, and maps.

`service` computes tables and maps once for all browsers, `state` and `messages` are pure functions of one browser's choices, the
pages render them, and `window` shows them. Only `explorer.client` and `explorer.app` import this package.
"""
