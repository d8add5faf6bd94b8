"""Where each picture of a flight was taken, and whether to believe it: `retrieval` ranks windows of the map, `sequence` lets
frames correct each other, `registration` lays a photo over the map, `tracks` writes the result, `measures` grades it, and `task`
makes a task of it for the explorer.

It imports `analysis` and the packages below it; `cli` and the explorer import it.
"""
