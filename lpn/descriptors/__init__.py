"""Descriptors of many pictures on disk: `store` defines the format, `writer` fills a store, `partial_store` resumes one
after a kill, and `cache` finds existing stores.

The package imports `core`, `datasets`, and `models`.
"""

from __future__ import annotations

from lpn.descriptors.cache import (
    STORES,
    Reader,
    StoredDescriptors,
    cached_descriptors,
    descriptor_reader,
    shipped_descriptors,
    shipped_only,
    shipped_or_cached,
    temporary_descriptors,
)
from lpn.descriptors.store import FORMAT, CropBox, Manifest, Precision, Row, Store, open_store
from lpn.descriptors.writer import describe, pictures_below

__all__ = [
    "FORMAT",
    "STORES",
    "CropBox",
    "Manifest",
    "Precision",
    "Reader",
    "Row",
    "Store",
    "StoredDescriptors",
    "cached_descriptors",
    "describe",
    "descriptor_reader",
    "open_store",
    "pictures_below",
    "shipped_descriptors",
    "shipped_only",
    "shipped_or_cached",
    "temporary_descriptors",
]
