"""Adapters for published models of other methods: FSRA, MCCG, SDPL, Sample4Geo, DAC, CAMP, Game4Loc, and DenseUAV's baseline.

Each recognises its checkpoint by the names of its entries (`recognise`), and describes pictures as the released test code does,
with an account of every part (`lpn.models.contract`). This face needs no torch; `load` does, and timm where a network comes from
there.
"""

from lpn.models.adapters.recognise import KINDS, Kind

__all__ = ["KINDS", "Kind"]
