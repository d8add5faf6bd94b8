"""Indexes of millions of tiles: names, descriptors, and positions, searched under any part weights.

    exact     a folder, searched in process without extras; exact (`lpn.index.exact`)
    faiss     a folder, for 10^6 to 10^7 tiles on one machine (`lpn.index.faiss`, the extra `search`)
    milvus    a collection on a server or a cluster (`lpn.index.milvus`, the extra `cluster`)

All implement the protocol `Index`, and `open_index` detects which one it opens. The package imports `retrieval` and the
packages below it; `doctor` and `cli` import it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from lpn.core.errors import InputError, StoreError
from lpn.index.base import DegreeBox, DescriptorKind, Index, SearchResult, WindowsRecord
from lpn.index.exact import ExactIndex
from lpn.index.faiss import FaissIndex
from lpn.index.folder import MANIFEST, IndexManifest
from lpn.index.milvus import SCHEME, MilvusIndex, Structure

IndexEngine = Literal["exact", "faiss", "milvus"]
_SCHEME = f"{SCHEME}:"


def is_index(where: str) -> bool:
    """Return whether a folder or an address belongs to an index, without opening it."""
    return where.startswith(_SCHEME) or (Path(where) / MANIFEST).is_file()


def open_index(where: str | Path, fingerprint: str | None = None) -> Index:
    """Open an index.

    Args:
        where: its folder, or milvus://host:port/collection.
        fingerprint: fingerprint of the model that describes the queries, checked against the index; None skips the check.

    Raises:
        StoreError: when there is no index, it is damaged, or it holds descriptors of another model.
        InputError: when the address is malformed.
        ModuleNotFoundError: when the package of its engine is not installed.
    """
    index: Index
    if str(where).startswith(_SCHEME):
        index = MilvusIndex(str(where))
    else:
        engine = IndexManifest.read(Path(where)).engine
        index = FaissIndex(where) if engine == FaissIndex.engine else ExactIndex(where)
    if fingerprint is not None:
        try:
            index.check_model(fingerprint)
        except StoreError:
            index.close()
            raise
    return index


def create_index(
    where: str | Path, kind: DescriptorKind, engine: IndexEngine | None = None, structure: Structure | None = None
) -> Index:
    """Create an empty index, or open an existing one of the same kind.

    Args:
        where: a folder, or milvus://host:port/collection.
        engine: by default milvus for its addresses, and exact for folders.
        structure: index structure of `milvus`; by default flat.

    Raises:
        StoreError: if `where` holds something else or cannot be written.
        InputError: if `where`, engine, and structure do not fit together.
    """
    is_url = str(where).startswith(_SCHEME)
    engine = engine or ("milvus" if is_url else "exact")
    if engine not in get_args(IndexEngine):
        raise InputError(f"There is no engine {engine!r}; expected one of {', '.join(get_args(IndexEngine))}.")
    if is_url != (engine == "milvus"):
        raise InputError(
            f"The engine {engine} does not go with this place; milvus takes milvus://host:port/collection, others a folder."
        )
    if engine == "milvus":
        return MilvusIndex.create(str(where), kind, structure or "flat")
    if structure is not None:
        raise InputError(
            f"The engine {engine} has no structure to choose; leave {structure} out, or use the engine milvus."
        )
    return FaissIndex.create(where, kind) if engine == "faiss" else ExactIndex.create(where, kind)


__all__ = [
    "DegreeBox",
    "DescriptorKind",
    "ExactIndex",
    "FaissIndex",
    "Index",
    "IndexEngine",
    "MilvusIndex",
    "SearchResult",
    "Structure",
    "WindowsRecord",
    "create_index",
    "open_index",
]
