"""Descriptors of many pictures on disk: `store` defines the folder of parts, `writer` fills it, `cache` finds existing ones,
and `many_machines` lets Ray's workers fill it.

The package imports `core`, `datasets`, and `models`.
"""

from __future__ import annotations

from lpn.descriptors.cache import STORES as STORES
from lpn.descriptors.cache import Reader as Reader
from lpn.descriptors.cache import StoredDescriptors as StoredDescriptors
from lpn.descriptors.cache import cached_descriptors as cached_descriptors
from lpn.descriptors.cache import descriptor_reader as descriptor_reader
from lpn.descriptors.cache import shipped_descriptors as shipped_descriptors
from lpn.descriptors.cache import shipped_only as shipped_only
from lpn.descriptors.cache import shipped_or_cached as shipped_or_cached
from lpn.descriptors.cache import temporary_descriptors as temporary_descriptors
from lpn.descriptors.store import DescriptorKind as DescriptorKind
from lpn.descriptors.store import Precision as Precision
from lpn.descriptors.store import Row as Row
from lpn.descriptors.store import Store as Store
from lpn.descriptors.store import open_store as open_store
from lpn.descriptors.store import row_of as row_of
from lpn.descriptors.writer import PartialStore as PartialStore
from lpn.descriptors.writer import describe as describe
from lpn.descriptors.writer import describe_share as describe_share
from lpn.descriptors.writer import pictures_below as pictures_below
from lpn.descriptors.writer import write_store as write_store
