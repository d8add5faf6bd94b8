"""A store that is being filled, and its folder after a kill.

`descriptors.part` holds the rows, `planned.json` the future manifest, and `progress.json` the finished rows, as a list of
ranges [first, end).

If the list of files changes, all three are written anew under names that end in `.new`, `progress.json.new` last, and then
replace the old ones, progress last. While `progress.json.new` exists, all new files are complete, with or without
`.new`, and the next run finishes the replacement. A kill at any step loses no row.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float32Array
from lpn.core.errors import LPNError, NewerStoreError, StoreError
from lpn.core.files import open_memmap, write_atomic
from lpn.descriptors.store import FORMAT, Manifest, Store, encode, open_array

# A kill loses the work of this many seconds.
_SAVE_SECONDS = 1.0
# The files, in the order in which new ones replace old ones.
_NAMES = ("descriptors.part", "planned.json", "progress.json")


class _Progress(msgspec.Struct):
    done: list[tuple[int, int]]


class PartialStore:
    """The rows of a future store; rows of an interrupted run or of an earlier store are reused.

    Attributes:
        good: the finished rows, (N,) bool.
    """

    def __init__(self, out: Path, manifest: Manifest, before: Store | None) -> None:
        self._part, planned, self._progress = (out / name for name in _NAMES)
        self._precision = manifest.precision
        _replace_old(out)
        interrupted = _interrupted(manifest, self._part, planned, self._progress)
        known = {} if before is None else _known(manifest, before.manifest, before.descriptors, ~before.damaged())
        if interrupted is not None and interrupted[0] == manifest:
            self.good = interrupted[2]
            self._array = np.lib.format.open_memmap(self._part, mode="r+")
            self._copy(known)
        else:
            known |= {} if interrupted is None else _known(manifest, *interrupted)
            self.good = np.zeros(len(manifest.rows), np.bool_)
            shape = (len(manifest.rows), manifest.n_parts, manifest.embedding)
            self._array = _allocate(_new(self._part), manifest.precision, shape)
            self._copy(known)
            self._array.flush()
            write_atomic(_new(planned), manifest.to_json())
            write_atomic(_new(self._progress), self._good_ranges())
            _replace_old(out)
        self.save()

    def put(self, rows: Sequence[int], descriptors: Float32Array) -> None:
        """Set rows from descriptors (B, n, D) float32; they are saved about once a second."""
        self._array[rows] = encode(descriptors, self._precision)
        self.good[rows] = True
        if time.monotonic() - self._saved >= _SAVE_SECONDS:
            self.save()

    def rows(self) -> AnyArray:
        """Return a copy of all rows, (N, n, D); those that are not finished are 0."""
        rows = np.array(self._array)
        rows[~self.good] = 0
        return rows

    def save(self) -> None:
        """Write the rows to disk, then record them as finished."""
        self._array.flush()
        write_atomic(self._progress, self._good_ranges())
        self._saved = time.monotonic()

    def _good_ranges(self) -> bytes:
        edges = np.flatnonzero(np.diff(self.good, prepend=False, append=False))
        return json.dumps({"done": edges.reshape(-1, 2).tolist()}).encode()

    def _copy(self, known: dict[int, AnyArray]) -> None:
        for i, row in known.items():
            if not self.good[i]:
                self._array[i] = row
                self.good[i] = True


def _new(path: Path) -> Path:
    return path.with_name(path.name + ".new")


def _replace_old(out: Path) -> None:
    """Replace the old files if all new ones are complete, else delete the new ones."""
    files = [out / name for name in _NAMES]
    complete = _new(files[-1]).exists()
    for file in files:
        if not complete:
            _new(file).unlink(missing_ok=True)
        elif _new(file).exists():
            os.replace(_new(file), file)


def _allocate(path: Path, precision: str, shape: tuple[int, ...]) -> np.memmap[Any, Any]:
    """Create an array and reserve its disk space; a disk that fills up under a memory map kills the process."""
    try:
        array: np.memmap[Any, Any] = np.lib.format.open_memmap(path, mode="w+", dtype=precision, shape=shape)
        if hasattr(os, "posix_fallocate"):
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    except OSError:
        path.unlink(missing_ok=True)
        raise
    return array


def lacks_manifest_only(folder: Path) -> bool:
    """Return whether a run was killed between renaming its array and writing its manifest."""
    there = [
        (folder / name).exists() for name in ("progress.json", "descriptors.npy", "descriptors.part", "manifest.json")
    ]
    return there == [True, True, False, False]


def reusable_store(out: Path, manifest: Manifest) -> Store | None:
    """Return the complete store in `out` whose rows can be reused.

    Raises:
        StoreError: if its descriptors are of another model, view, transform, or precision.
    """
    store = complete_store(out)
    if store is not None and not manifest.comparable(store.manifest):
        held = store.manifest
        raise StoreError(
            f"{out} holds {held.view} descriptors of model {held.fingerprint}, {held.change.describe() or 'unchanged'}, in "
            f"{held.precision}, and these would be {manifest.view} of {manifest.fingerprint}, "
            f"{manifest.change.describe() or 'unchanged'}, in {manifest.precision}; choose another folder, or delete that one."
        )
    return store


def complete_store(folder: Path) -> Store | None:
    """Return the complete store in a folder, or None if there is none or its array is damaged.

    Raises:
        StoreError: if the folder has files with a store's names that lpn did not make.
    """
    file = folder / "manifest.json"
    if file.exists():
        try:
            written = file.read_bytes()
            manifest = Manifest.from_json(written, file.name)
        except NewerStoreError:
            raise
        except (StoreError, OSError) as error:
            raise StoreError(
                f"{folder} has a manifest.json that is not one of {FORMAT}; choose another folder, or delete that file."
            ) from error
        try:
            return open_array(folder, manifest, written)
        except StoreError:
            return None
    if (folder / "descriptors.npy").exists() and not (folder / "planned.json").exists():
        raise StoreError(
            f"{folder} has a descriptors.npy without a manifest.json, so lpn did not make it; choose another folder."
        )
    return None


def _interrupted(
    manifest: Manifest, part: Path, planned: Path, progress: Path
) -> tuple[Manifest, AnyArray, BoolArray] | None:
    """Return the planned manifest, the rows, and the finished rows of an interrupted run with comparable rows."""
    try:
        plan = Manifest.from_json(planned.read_bytes(), planned.name)
        array = open_memmap(part)
        expected = (len(plan.rows), manifest.n_parts, manifest.embedding)
        fits = array.shape == expected and array.dtype == np.dtype(manifest.precision)
        if not fits or not manifest.comparable(plan):
            return None
        good = np.zeros(len(plan.rows), np.bool_)
        for start, end in msgspec.json.decode(progress.read_bytes(), type=_Progress).done:
            if not 0 <= start < end <= len(good):
                return None
            good[start:end] = True
        return plan, array, good
    except NewerStoreError:
        raise
    except (OSError, ValueError, RecursionError, msgspec.MsgspecError, LPNError):
        return None


def _known(
    manifest: Manifest, other: Manifest, descriptors: AnyArray, good: BoolArray | None = None
) -> dict[int, AnyArray]:
    """Return the good rows of another store's descriptors for files that did not change, by new row number."""
    if not manifest.comparable(other):
        return {}
    have = {row: i for i, row in enumerate(other.rows) if good is None or good[i]}
    return {i: descriptors[have[row]] for i, row in enumerate(manifest.rows) if row in have}
