"""Indexes of millions of tiles: names, descriptors, and positions, searched under any part weights.

    exact     a store's folder, searched in process without extras; exact (`lpn.index.folder`)
    faiss     the same with codes beside it, for 10^6 to 10^7 tiles on one machine (`lpn.index.faiss`, the extra `search`)
    milvus    milvus://..., a collection on a server or a cluster (`lpn.index.milvus`, the extra `cluster`)

An engine is an entry point of the group `lpn.indexes`, a subclass of `Index`. A folder's store.json names its engine, and so does
the scheme of an address. The package imports `retrieval` and the packages below it; `doctor` and `cli` import it.
"""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path
from typing import Any

from lpn.core.errors import InputError, StoreError
from lpn.descriptors.store import MANIFEST, DescriptorKind, Manifest, WindowsRecord
from lpn.index.base import DegreeBox, Index, SearchResult
from lpn.index.folder import FolderIndex, check_role


def is_index(where: str) -> bool:
    """Return whether a folder or an address belongs to an index, without opening it."""
    scheme, is_url, _ = where.partition("://")
    return scheme in _engines() if is_url else (Path(where) / MANIFEST).is_file()


def open_index(where: str | Path, fingerprint: str | None = None) -> Index:
    """Open an index.

    Args:
        where: the folder of a store, or an address such as milvus://host:port/collection.
        fingerprint: fingerprint of the model that describes the queries, checked against the index; None skips the check.

    Raises:
        StoreError: when there is no index, it is damaged, or it holds descriptors of another model.
        InputError: when the address is malformed, or the index contains descriptors of queries.
        ModuleNotFoundError: when the package of its engine is not installed.
    """
    scheme, is_url, _ = str(where).partition("://")
    index: Index = _engine(scheme if is_url else Manifest.read(Path(where)).engine)(where)
    try:
        check_role(index.kind, where)
        if fingerprint is not None:
            index.check_model(fingerprint)
    except (InputError, StoreError):
        index.close()
        raise
    return index


def create_index(where: str | Path, kind: DescriptorKind, engine: str | None = None) -> Index:
    """Create an empty index, or open an existing one of the same kind.

    Args:
        where: a folder, or an address such as milvus://host:port/collection.
        engine: "exact" or "faiss" for a folder, exact by default; an address names its engine.

    Raises:
        StoreError: if `where` holds something else or cannot be written.
        InputError: if there is no such engine, or it does not fit `where`.
    """
    scheme, is_url, _ = str(where).partition("://")
    made = _engine(scheme if is_url else engine or "exact")
    if bool(is_url) == issubclass(made, FolderIndex) or (is_url and engine not in (None, scheme)):
        raise InputError(
            f"The engine {engine or scheme} does not fit this address; milvus takes milvus://host:port/collection, exact and "
            "faiss a folder."
        )
    index: Index = made.create(where, kind) if issubclass(made, FolderIndex) else made(where, kind)
    return index


def _engines() -> dict[str, Any]:
    return {"exact": FolderIndex} | {point.name: point for point in entry_points(group="lpn.indexes")}


def _engine(name: str) -> Any:
    """Return the class of an engine; InputError if there is none of this name."""
    engines = _engines()
    if name not in engines:
        raise InputError(f"There is no engine {name!r}; expected one of {', '.join(sorted(engines))}.")
    return FolderIndex if name == "exact" else engines[name].load()


__all__ = ["DegreeBox", "DescriptorKind", "Index", "SearchResult", "WindowsRecord", "create_index", "open_index"]
