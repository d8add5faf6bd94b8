"""The one screen at `/`: photo, tile, and a row for each ring, all drawn from one result.

`fields` is the table of the user's choices, `loop` analyses the newest state, `result` describes an analysis as JSON,
and `channel` carries both over one websocket. Nothing below this package imports it but `app` and `cli`.
"""
