"""Where each picture of a flight was taken, and whether to believe it: `retrieval` ranks windows of the map, `sequence` lets
frames correct each other, `registration` lays a photo over the map, `tracks` writes the result, and `measures` grades it.

It imports `core`, `datasets`, `maps`, `flights`, `models`, `descriptors`, and `retrieval`; `cli` and the explorer import it.
"""
