"""What is in a store's folder while it is being filled, and after a kill.

Rows lie in `descriptors.part`, `planned.json` is the manifest to be, and `progress.json` says which rows are good: a list of
ranges, each with its first row and the one after its last.

When the list of files has changed, all three are made anew under names that end in `.new`, `progress.json.new` last, and then
take the place of the old ones, progress last: while it is there, what is new is whole, under one name or the other, and the
next run ends the change. A kill at any step loses no row.
"""

from __future__ import annotations

import json
import os
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float32Array
from lpn.core.errors import LPNError, NewerStoreError, StoreError
from lpn.core.files import open_memmap, write_atomic
from lpn.descriptors.store import FORMAT, Manifest, Store, stored, with_array

_SECONDS = 1.0
"""What is computed between two saves, and so what a kill costs."""

_NAMES = ("descriptors.part", "planned.json", "progress.json")
"""In the order in which new files take the place of old ones."""


class PartialStore:
    """The rows of a store to be; those that an interrupted run or an earlier store has are there from the start.

    Attributes:
        good: which rows are there, (N,) bool.
    """

    def __init__(self, out: Path, manifest: Manifest, before: Store | None) -> None:
        self._part, planned, self._progress = (out / name for name in _NAMES)
        self._precision = manifest.precision
        _take_place(out)
        left = _interrupted(manifest, self._part, planned, self._progress)
        known = {} if before is None else _known(manifest, before.manifest, before.descriptors, ~before.damaged())
        if left is not None and left[0] == manifest:
            self.good = left[2]
            self._array = np.lib.format.open_memmap(self._part, mode="r+")
            self._take(known)
        else:
            known |= {} if left is None else _known(manifest, *left)
            self.good = np.zeros(len(manifest.rows), np.bool_)
            shape = (len(manifest.rows), manifest.n_parts, manifest.embedding)
            self._array = _reserved(_new(self._part), manifest.precision, shape)
            self._take(known)
            self._array.flush()
            write_atomic(_new(planned), manifest.to_json())
            write_atomic(_new(self._progress), self._good_ranges())
            _take_place(out)
        self.save()

    def put(self, rows: Sequence[int], descriptors: Float32Array) -> None:
        """Set rows from descriptors (B, n, D) float32; saved about once a second."""
        self._array[rows] = stored(descriptors, self._precision)
        self.good[rows] = True
        if time.monotonic() - self._saved >= _SECONDS:
            self.save()

    def save(self) -> None:
        """Bring the rows to the disk, then say so."""
        self._array.flush()
        write_atomic(self._progress, self._good_ranges())
        self._saved = time.monotonic()

    def _good_ranges(self) -> bytes:
        edges = np.flatnonzero(np.diff(self.good, prepend=False, append=False))
        return json.dumps({"done": edges.reshape(-1, 2).tolist()}).encode()

    def _take(self, known: dict[int, AnyArray]) -> None:
        for i, row in known.items():
            if not self.good[i]:
                self._array[i] = row
                self.good[i] = True


def _new(path: Path) -> Path:
    return path.with_name(path.name + ".new")


def _take_place(out: Path) -> None:
    """Give new files their names where all of them are whole, and delete them where the run was killed before they were."""
    files = [out / name for name in _NAMES]
    whole = _new(files[-1]).exists()
    for file in files:
        if not whole:
            _new(file).unlink(missing_ok=True)
        elif _new(file).exists():
            os.replace(_new(file), file)


def _reserved(path: Path, precision: str, shape: tuple[int, ...]) -> np.memmap[Any, Any]:
    """A new array on disk that has its room there: a disk that fills up under a mapped file ends the process without a word."""
    try:
        array: np.memmap[Any, Any] = np.lib.format.open_memmap(path, mode="w+", dtype=precision, shape=shape)
        if hasattr(os, "posix_fallocate"):
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    except OSError:
        path.unlink(missing_ok=True)
        raise
    return array


def renamed_only(folder: Path) -> bool:
    """Whether a run was killed after its rows got their name and before its manifest was written."""
    there = [
        (folder / name).exists() for name in ("progress.json", "descriptors.npy", "descriptors.part", "manifest.json")
    ]
    return there == [True, True, False, False]


def usable(out: Path, manifest: Manifest) -> Store | None:
    """The complete store in `out` whose rows may be taken over; StoreError when they are of another kind."""
    store = complete(out)
    if store is not None and not manifest.comparable(store.manifest):
        held = store.manifest
        raise StoreError(
            f"{out} holds {held.view} descriptors of model {held.fingerprint}, {held.change.describe() or 'unchanged'}, in "
            f"{held.precision}, and these would be {manifest.view} of {manifest.fingerprint}, "
            f"{manifest.change.describe() or 'unchanged'}, in {manifest.precision}; choose another folder, or delete that one."
        )
    return store


def complete(folder: Path) -> Store | None:
    """The complete store in a folder, or None when there is none or its array is damaged.

    Raises:
        StoreError: when the folder holds files of other origin under a store's names.
    """
    manifest = folder / "manifest.json"
    if manifest.exists():
        try:
            written = manifest.read_bytes()
            read = Manifest.from_json(written, manifest.name)
        except NewerStoreError:
            raise
        except (StoreError, OSError) as error:
            raise StoreError(
                f"{folder} has a manifest.json that is not one of {FORMAT}; choose another folder, or delete that file if it "
                "is of no use."
            ) from error
        try:
            return with_array(folder, read, written)
        except StoreError:
            return None
    if (folder / "descriptors.npy").exists() and not (folder / "planned.json").exists():
        raise StoreError(
            f"{folder} has a descriptors.npy without a manifest.json, so it is not ours to replace; choose another folder."
        )
    return None


def _interrupted(
    manifest: Manifest, part: Path, planned: Path, progress: Path
) -> tuple[Manifest, AnyArray, BoolArray] | None:
    """What an interrupted run with this model, view, and change left: the manifest it planned, the rows, and which are good."""
    try:
        plan = Manifest.from_json(planned.read_bytes(), planned.name)
        array = open_memmap(part)
        expected = (len(plan.rows), manifest.n_parts, manifest.embedding)
        fits = array.shape == expected and array.dtype == np.dtype(manifest.precision)
        if not fits or not manifest.comparable(plan):
            return None
        done: Any = json.loads(progress.read_bytes())["done"]
        good = np.zeros(len(plan.rows), np.bool_)
        # A number in older folders: that many rows from the first.
        for start, end in [(0, done)] if isinstance(done, int) else done:
            if not 0 <= start < end <= len(good):
                return None
            good[start:end] = True
        return plan, array, good
    except NewerStoreError:
        raise
    except (OSError, ValueError, OverflowError, KeyError, TypeError, AttributeError, RecursionError, LPNError):
        return None


def _known(
    manifest: Manifest, other: Manifest, descriptors: AnyArray, good: BoolArray | None = None
) -> dict[int, AnyArray]:
    """Rows of the same files that another manifest's descriptors have, all of them or the good ones."""
    if not manifest.comparable(other):
        return {}
    have = {row: i for i, row in enumerate(other.rows) if good is None or good[i]}
    return {i: descriptors[have[row]] for i, row in enumerate(manifest.rows) if row in have}
