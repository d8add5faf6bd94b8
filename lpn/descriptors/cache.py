"""Descriptors that exist already: in the user's cache, or shipped with the data set."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import NewerStoreError, OutputError, StoreError
from lpn.core.files import cache_folder, linked_folder, printable
from lpn.core.resources import FLOAT32_DEVICES
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors.store import DescriptorKind, Row, open_store, row_of
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.descriptors.writer import describe
from lpn.models.base import Model
from lpn.models.contract import Role

# The folder of a data set that may hold stores of its test split: `query_drone`, `gallery_satellite`, ... Stores of further
# models are in folders of their own, such as `baseline/query_drone`.
STORES = "descriptors"

# A source of descriptors (N, n, D) of transformed pictures, such as `cached_descriptors`.
Reader = Callable[[Model, Sequence[Picture], View, Change], Float32Array]


def cached_descriptors(
    model: Model, pictures: Sequence[Picture], view: View, change: Change = UNCHANGED
) -> Float32Array:
    """Return descriptors (N, n, D) of pictures within their boxes, from the user's cache if possible.

    The cache is `$LPN_CACHE`, else `lpn-explorer` in `$XDG_CACHE_HOME` or `~/.cache`; it may be deleted at any time.
    """
    files = _resolved(pictures)
    # The key contains the folder, not the list of files, so that the other rows are reused if one picture changes.
    common = os.path.commonpath({file.parent for file in files})
    boxes = [picture.box for picture in pictures]
    kind = DescriptorKind.of_model(model, view, change)
    device = "" if model.device in FLOAT32_DEVICES else model.device
    key = json.dumps([kind.digest, common, any(boxes), device]).encode()
    folder = cache_folder() / "descriptors" / hashlib.sha256(key).hexdigest()[:24]
    with in_cache():
        rows = [row_of(file, None, box) for file, box in zip(files, boxes, strict=True)]
        if (cached := _from_store(folder, kind, rows)) is not None:
            return cached
        store = describe(model, files, view, folder, change=change, boxes=boxes)
        return store.float32


@contextmanager
def in_cache() -> Iterator[None]:
    """Add a remedy to errors of the user's cache: LPN_CACHE selects another folder."""
    try:
        yield
    except (StoreError, OutputError) as error:
        raise StoreError(
            f"The cache of descriptors in {cache_folder()} cannot be used: {error} Set LPN_CACHE to a folder that "
            "can be written."
        ) from error


def _resolved(pictures: Sequence[Picture]) -> list[Path]:
    """Return each picture's file with links resolved; each folder is resolved once."""
    folders: dict[Path, Path] = {}
    files = []
    for picture in pictures:
        parent = picture.path.parent
        if parent not in folders:
            folders[parent] = Path(os.path.realpath(parent))
        file = folders[parent] / picture.path.name
        # Unlike resolve(), realpath does not raise on circular links.
        files.append(Path(os.path.realpath(file)) if file.is_symlink() else file)
    return files


def shipped_descriptors(
    model: Model, pictures: Sequence[Picture], view: View, store: Path, exact: bool = False
) -> Float32Array | None:
    """Return descriptors from a shipped store; None if its model or its pictures differ.

    Files are compared by name and size, as copies have other modification times.

    Args:
        exact: accept float32 only.
    """
    try:
        shipped = open_store(store)
    except StoreError:
        return None
    kind = DescriptorKind.of_model(model, view, UNCHANGED, shipped.kind.precision)
    if shipped.kind != kind or len(shipped) != len(pictures) or (exact and kind.precision != "float32"):
        return None
    rows = [(printable(row.file), row.size, row.box) for row in shipped.rows]
    these = [(f"{p.path.parent.name}/{p.path.name}", p.path.stat().st_size, p.box) for p in pictures]
    return shipped.float32 if rows == these else None


def shipped_or_cached(model: Model, pictures: Sequence[Picture], view: View, root: Path, role: Role) -> Float32Array:
    """Return the descriptors of queries or gallery that ship with the data set in `root`, else those of the cache."""
    shipped = shipped_only(model, pictures, view, root, role)
    return cached_descriptors(model, pictures, view) if shipped is None else shipped


def shipped_only(
    model: Model, pictures: Sequence[Picture], view: View, root: Path, role: Role | None, exact: bool = False
) -> Float32Array | None:
    """Return the descriptors of queries, of the gallery, or of either, that ship with the data set in `root`; None without them.

    Stores directly in `STORES` come before those in its subfolders. For `exact` see `shipped_descriptors`.
    """
    name = f"{role or '*'}_{view}"
    found = [store for pattern in (name, f"*/{name}") for store in sorted((root / STORES).glob(pattern))]
    stores = (
        shipped_descriptors(model, pictures, view, store, exact) for store in dict.fromkeys(map(linked_folder, found))
    )
    return next((shipped for shipped in stores if shipped is not None), None)


def descriptor_reader(root: Path) -> Reader:
    """Return a reader of descriptors of the data set in `root`: from its shipped stores, else from the cache.

    Only float32 stores are used, so that results do not depend on the shipped precision.
    """

    def read(model: Model, pictures: Sequence[Picture], view: View, change: Change = UNCHANGED) -> Float32Array:
        shipped = None if change else shipped_only(model, pictures, view, root, None, exact=True)
        return cached_descriptors(model, pictures, view, change) if shipped is None else shipped

    return read


def temporary_descriptors(
    model: Model, pictures: Sequence[Picture], view: View, change: Change = UNCHANGED
) -> Float32Array:
    """Describe pictures without the cache, for a changing model such as one in training."""
    files, boxes = [picture.path for picture in pictures], [picture.box for picture in pictures]
    with TemporaryDirectory(prefix="lpn-") as folder:
        store = describe(model, files, view, folder, change=change, boxes=boxes)
        return np.array(store.descriptors)


def _from_store(folder: Path, kind: DescriptorKind, wanted: Sequence[Row]) -> Float32Array | None:
    """Read descriptors from a store of the kind that has all of these rows, and perhaps more; None without such a store."""
    try:
        store = open_store(folder)
        held = store.rows
    except NewerStoreError:
        raise
    except StoreError:
        return None
    if store.kind != kind:
        return None
    if held == wanted:
        return store.float32
    place_of = {row: place for place, row in enumerate(held)}
    places = [place_of.get(row) for row in wanted]
    if None in places:
        return None
    return store.some(np.array(places, np.int64))
