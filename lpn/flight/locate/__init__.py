"""The place of each picture of a flight, and a verdict on it: `retrieval` ranks windows of the map, `sequence` smooths the track,
`registration` lays a photo over the map, `tracks` writes the result, `errors` measures it, and `task` makes it a task for the
explorer.

It imports `analysis` and the packages below it; `cli` and the explorer import it.
"""
