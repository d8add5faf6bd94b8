"""Descriptors of many pictures on disk: `store` defines the folder of parts, `writer` fills it, `cache` finds existing ones,
and `many_machines` lets Ray's workers fill it.

The package imports `core`, `datasets`, and `models`.
"""

from __future__ import annotations

from lpn.descriptors.cache import (
    STORES,
    Reader,
    cached_descriptors,
    descriptor_reader,
    shipped_descriptors,
    shipped_only,
    shipped_or_cached,
    temporary_descriptors,
)
from lpn.descriptors.store import DescriptorKind, Precision, Row, Store, open_store, row_of
from lpn.descriptors.writer import PartialStore, describe, describe_share, pictures_below, write_store

__all__ = [
    "STORES",
    "DescriptorKind",
    "PartialStore",
    "Precision",
    "Reader",
    "Row",
    "Store",
    "cached_descriptors",
    "describe",
    "describe_share",
    "descriptor_reader",
    "open_store",
    "pictures_below",
    "row_of",
    "shipped_descriptors",
    "shipped_only",
    "shipped_or_cached",
    "temporary_descriptors",
    "write_store",
]
