"""Descriptors of many pictures, kept on disk: `store` is what is kept, `describing` fills it, `unfinished` is what a kill
leaves, and `cache` finds what was described before."""

from __future__ import annotations

from lpn.descriptors.cache import (
    STORES,
    Reader,
    Side,
    cache_folder,
    cached_descriptors,
    known_descriptors,
    known_side,
    passing_descriptors,
    reader,
    shipped_descriptors,
)
from lpn.descriptors.store import BEFORE, FORMAT, Box, Manifest, Precision, Row, Store, open_store
from lpn.descriptors.writer import describe, pictures_below

__all__ = [
    "BEFORE",
    "FORMAT",
    "STORES",
    "Box",
    "Manifest",
    "Precision",
    "Reader",
    "Row",
    "Side",
    "Store",
    "cache_folder",
    "cached_descriptors",
    "describe",
    "known_descriptors",
    "known_side",
    "open_store",
    "passing_descriptors",
    "pictures_below",
    "reader",
    "shipped_descriptors",
]
