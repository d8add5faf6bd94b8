"""A store that is being filled, and its folder after a kill.

Finished rows are appended to `descriptors.log`. Its first line is JSON with the store's kind. Each row has the lengths of the
JSON of its file and of its numbers, these two, and their CRC-32. Rows are found again by their files, whatever else is
described by now; a row that a kill cut off is skipped. The log is deleted once the store is complete.
"""

from __future__ import annotations

import json
import struct
import time
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from lpn.core.arrays import AnyArray, BoolArray, Float32Array
from lpn.core.errors import LPNError, NewerStoreError, StoreError
from lpn.descriptors.store import FORMAT, Manifest, Row, Store, encode, float_box, open_array

LOG = "descriptors.log"
# A kill loses the work of this many seconds.
_SAVE_SECONDS = 1.0
_LENGTHS, _SUM = struct.Struct("<II"), struct.Struct("<I")


class PartialStore:
    """The rows of a future store, with those of an interrupted run or of an earlier store."""

    def __init__(self, out: Path, manifest: Manifest, before: Store | None) -> None:
        self._manifest, self._path = manifest, out / LOG
        logged, end = _read(self._path, manifest)
        # Offset of each row's numbers in the log; -1 for an unfinished row.
        self._places = np.array([logged.get(row, -1) for row in manifest.rows], np.int64)
        self._file = self._path.open("r+b" if end else "wb")
        try:
            self._begin(end, before)
        except BaseException:
            self._file.close()
            raise

    def _begin(self, end: int, before: Store | None) -> None:
        """Append to the log's whole rows: its first line, if it is new, and the reused rows of a store."""
        self._file.truncate(end)
        self._file.seek(end)
        if not end:
            self._file.write(replace(self._manifest, rows=(), checksums=None).to_json() + b"\n")
        if before is not None:
            pairs = zip(before.manifest.rows, before.damaged(), strict=True)
            whole = {row: place for place, (row, damaged) in enumerate(pairs) if not damaged}
            for i, row in enumerate(self._manifest.rows):
                if row in whole and self._places[i] < 0:
                    self._append(i, before.descriptors[whole[row]])
        self.save()

    @property
    def good(self) -> BoolArray:
        """The finished rows, (N,)."""
        return self._places >= 0

    def put(self, rows: Sequence[int], descriptors: Float32Array) -> None:
        """Set rows from descriptors (B, n, D) float32; they are saved about once a second."""
        for row, numbers in zip(rows, encode(descriptors, self._manifest.precision), strict=True):
            self._append(row, numbers)
        if time.monotonic() - self._saved >= _SAVE_SECONDS:
            self.save()

    def save(self) -> None:
        """Write all finished rows to the disk."""
        self._file.flush()
        self._saved = time.monotonic()

    def close(self) -> None:
        """Save, and close the log."""
        with self._file:
            self.save()

    def rows(self) -> AnyArray:
        """Return all rows, (N, n, D); unfinished ones are 0."""
        rows = np.zeros((len(self._places), *self._shape), self._manifest.precision)
        for i, numbers in self._numbers():
            rows[i] = np.frombuffer(numbers, rows.dtype).reshape(self._shape)
        return rows

    def write(self, array: Path) -> None:
        """Write the array of a store whose rows are all finished."""
        with array.open("wb") as file:
            shape = (len(self._places), *self._shape)
            descr = np.lib.format.dtype_to_descr(np.dtype(self._manifest.precision))
            np.lib.format.write_array_header_1_0(file, {"descr": descr, "fortran_order": False, "shape": shape})
            for _, numbers in self._numbers():
                file.write(numbers)

    @property
    def _shape(self) -> tuple[int, int]:
        return self._manifest.n_parts, self._manifest.embedding

    def _append(self, row: int, numbers: AnyArray) -> None:
        name, content = json.dumps(asdict(self._manifest.rows[row])).encode(), numbers.tobytes()
        lengths = _LENGTHS.pack(len(name), len(content))
        self._places[row] = self._file.tell() + len(lengths) + len(name)
        self._file.write(lengths + name + content + _SUM.pack(zlib.crc32(name + content)))

    def _numbers(self) -> Iterator[tuple[int, bytes]]:
        """Yield each finished row and its numbers."""
        self.save()
        length = np.dtype(self._manifest.precision).itemsize * self._shape[0] * self._shape[1]
        with self._path.open("rb") as file:
            for i in np.flatnonzero(self.good).tolist():
                file.seek(self._places[i])
                yield i, file.read(length)


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
    if (folder / "descriptors.npy").exists() and not (folder / LOG).exists():
        raise StoreError(
            f"{folder} has a descriptors.npy without a manifest.json, so lpn did not make it; choose another folder."
        )
    return None


def _read(log: Path, manifest: Manifest) -> tuple[dict[Row, int], int]:
    """Return the offsets of each row's numbers in a log of comparable rows, and its end; nothing without such a log."""
    places: dict[Row, int] = {}
    try:
        with log.open("rb") as file:
            if not manifest.comparable(Manifest.from_json(file.readline(), log.name)):
                return {}, 0
            end = file.tell()
            while len(lengths := file.read(_LENGTHS.size)) == _LENGTHS.size:
                of_name, of_content = _LENGTHS.unpack(lengths)
                content = file.read(of_name + of_content)
                if file.read(_SUM.size) != _SUM.pack(zlib.crc32(content)):
                    break
                values = json.loads(content[:of_name])
                row = Row(values["file"], values["size"], values["time_ns"], float_box(values["box"]))
                places[row] = end + _LENGTHS.size + of_name
                end = file.tell()
            return places, end
    except NewerStoreError:
        raise
    except (OSError, ValueError, LookupError, TypeError, RecursionError, LPNError):
        return {}, 0
