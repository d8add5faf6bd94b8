"""Indexes of millions of tiles: names, descriptors, and positions, searched under any part weights.

    exact     a folder, searched in process without extras; exact (`lpn.index.exact`)
    faiss     a folder, for 10^6 to 10^7 tiles on one machine (`lpn.index.faiss`, the extra `search`)
    milvus    a collection on a server or a cluster (`lpn.index.milvus`, the extra `cluster`)

All implement the protocol `Index`, and `open_index` detects which one it opens. The package imports `retrieval` and the
packages below it; `lpn.index.tiles` also reads parts of `cluster`. `doctor` and `cli` import it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Literal, get_args

from lpn.core.errors import InputError, StoreError
from lpn.index.base import DegreeBox, DescriptorKind, Index, SearchResult, WindowsRecord, check_count
from lpn.index.exact import ExactIndex
from lpn.index.faiss import Codes, FaissIndex
from lpn.index.folder import MANIFEST, IndexManifest
from lpn.index.milvus import SCHEME, MilvusIndex, Structure

IndexEngine = Literal["exact", "faiss", "milvus"]
_SCHEME = f"{SCHEME}:"


def is_index(where: str) -> bool:
    """Return whether a folder or an address is that of an index, without opening it."""
    return where.startswith(_SCHEME) or (Path(where) / MANIFEST).is_file()


def open_index(
    where: str | Path, fingerprint: str | None = None, effort: int | None = None, depth: int | None = None
) -> Index:
    """Open an index.

    Args:
        where: its folder, or milvus://host:port/collection.
        fingerprint: fingerprint of the model that describes the queries, checked against the index; None skips the check.
        effort: for approximate searches, the number of lists (faiss) or neighbours (hnsw of milvus) to visit, 1 or more;
            None means 64 (faiss) or 128 (milvus).
        depth: for faiss, the number of candidates to score as a multiple of k, 1 or more; None means 16.

    Raises:
        StoreError: when there is no index, it is damaged, or it holds descriptors of another model.
        InputError: when the address is malformed, or effort or depth is out of range or does not apply to this index.
        ModuleNotFoundError: when the package of its engine is not installed.
    """
    index = _opened(where, check_effort(effort, depth))
    if fingerprint is not None:
        try:
            index.check_model(fingerprint)
        except StoreError:
            index.close()
            raise
    return index


def check_effort(effort: int | None, depth: int | None) -> dict[str, int]:
    """Return those of the two that are not None, by name; InputError unless they are whole numbers of 1 or more."""
    options = {name: value for name, value in (("effort", effort), ("depth", depth)) if value is not None}
    return {name: check_count(value, name) for name, value in options.items()}


def create_index(
    where: str | Path,
    kind: DescriptorKind,
    engine: IndexEngine | None = None,
    codes: Codes | None = None,
    structure: Structure | None = None,
) -> Index:
    """Make an empty index, or open an existing one of the same kind.

    Args:
        where: a folder, or milvus://host:port/collection.
        engine: by default milvus for its addresses, and exact for folders.
        codes: codes of `faiss`; by default pq, or sq8 for descriptors that pq cannot encode.
        structure: index structure of `milvus`; by default flat.

    Raises:
        StoreError: if `where` holds something else or cannot be written.
        InputError: if `where`, engine, and options do not fit together.
    """
    is_url = str(where).startswith(_SCHEME)
    engine = engine or ("milvus" if is_url else "exact")
    if engine not in get_args(IndexEngine):
        raise InputError(f"There is no engine {engine!r}; expected one of {', '.join(get_args(IndexEngine))}.")
    if is_url != (engine == "milvus"):
        raise InputError(
            f"The engine {engine} does not go with this place; milvus takes milvus://host:port/collection, others a folder."
        )
    for option_engine, what, value in (("faiss", "codes", codes), ("milvus", "structure", structure)):
        if value is not None and engine != option_engine:
            raise InputError(
                f"The engine {engine} has no {what} to choose; leave {value} out, or use the engine {option_engine}."
            )
    if engine == "exact":
        return ExactIndex.create(where, kind)
    if engine == "faiss":
        return FaissIndex.create(where, kind, codes)
    return MilvusIndex.create(str(where), kind, structure or "flat")


def _opened(where: str | Path, options: dict[str, int]) -> Index:
    if str(where).startswith(_SCHEME):
        _refuse(options, ("depth",), "only faiss has this option")
        collection = MilvusIndex(str(where), **options)
        if collection.structure == "flat":
            try:
                _refuse(options, ("effort",), "a flat collection compares every vector")
            except InputError:
                collection.close()
                raise
        return collection
    manifest = IndexManifest.read(Path(where))
    if manifest.engine == ExactIndex.engine:
        _refuse(options, ("effort", "depth"), "an exact index compares every tile")
        return ExactIndex(where)
    if manifest.settings.get("codes") == "flat":
        _refuse(options, ("effort",), "an index of the codes flat compares every vector")
    names = {"effort": "nprobe", "depth": "depth"}
    return FaissIndex(where, **{names[name]: value for name, value in options.items()})


def _refuse(options: dict[str, int], names: tuple[str, ...], why: str) -> None:
    """Raise InputError for an option that an index does not have."""
    for name in names:
        if name in options:
            raise InputError(f"There is no {name} to choose here, as {why}; leave {name} {options[name]} out.")


__all__ = [
    "Codes",
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
    "check_effort",
    "create_index",
    "open_index",
]
