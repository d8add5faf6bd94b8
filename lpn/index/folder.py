"""An index in a folder: a manifest and immutable parts.

    index.json       format, engine, model fingerprint, n, D, the parts, oldest first, and a checksum
    0000012/ ...     parts, see `lpn.index.parts`

An add first writes a part that the manifest does not name yet, and replaces the manifest last. After a kill, the index is
unchanged, and the next add deletes the leftovers. A name in a newer part wins.
"""

from __future__ import annotations

import json
import os
import re
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from msgspec.structs import replace

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from lpn.core.checksums import crc_of_values
from lpn.core.errors import OutputError, StoreError
from lpn.core.files import (
    exclusive_lock,
    printable,
    raise_open_file_limit,
    space_remedy,
    unreadable_error,
    write_atomic,
)
from lpn.core.formats import decode_json
from lpn.index.base import (
    DegreeBox,
    DescriptorKind,
    Index,
    SearchResult,
    WindowsRecord,
    best,
    no_such_tile,
    scores_of,
    within,
)
from lpn.index.parts import FILES, Part, identity_of, readable, sum_of, write_part

FORMAT = "lpn-index/3"
MANIFEST = "index.json"
_UNFINISHED = re.compile(re.escape(MANIFEST) + r"\.\d+-\d+\.part")
_PART, _CODES = re.compile(r"\d{7,}"), re.compile(r"\d{7,}\.faiss")
_ATTEMPTS = 20
_ROWS_PER_READ = 1024
# Up to 1 / _FEW of a part's rows are read one by one; for more, all of its rows are read.
_FEW = 4


class PartEntry(msgspec.Struct, frozen=True):
    """A part of an index.

    Attributes:
        name: its folder.
        rows: number of its tiles.
        replaced: number of tiles whose names are in newer parts.
        sums: SHA-256 of each file.
    """

    name: str
    rows: int
    sums: dict[str, str]
    replaced: int = 0


class EngineFile(msgspec.Struct, frozen=True):
    """A file of an engine beside the parts.

    Attributes:
        name: of the file.
        parts: number of the oldest parts, which it covers.
        sum: its SHA-256.
    """

    name: str
    parts: tuple[str, ...]
    sum: str


class IndexManifest(msgspec.Struct, frozen=True, kw_only=True):
    """The contents of index.json.

    Attributes:
        engine: "exact" or "faiss".
        fingerprint, n_parts, embedding: the descriptors, see `DescriptorKind`.
        next: number of the next part to be written.
        parts: oldest first.
        codes: file of the engine, if it has one.
        windows: of a map, see `DescriptorKind`; None for other tiles.
        checksum: CRC-32 of all other values.
    """

    format: str = FORMAT
    engine: str
    fingerprint: str
    n_parts: int
    embedding: int
    next: int = 1
    parts: tuple[PartEntry, ...] = ()
    codes: EngineFile | None = None
    windows: WindowsRecord | None = None
    checksum: int | None = None

    @property
    def kind(self) -> DescriptorKind:
        """The kind of descriptors."""
        return DescriptorKind(self.fingerprint, self.n_parts, self.embedding, self.windows)

    @property
    def tiles(self) -> int:
        """Number of tiles."""
        return sum(part.rows - part.replaced for part in self.parts)

    def to_json(self) -> bytes:
        """Encode the manifest with its checksum."""
        return json.dumps(msgspec.to_builtins(replace(self, checksum=self._crc())), indent=1).encode()

    @classmethod
    def read(cls, folder: Path) -> IndexManifest:
        """Read the manifest of an index; StoreError when the folder is not an index or its manifest is damaged."""
        try:
            data = (folder / MANIFEST).read_bytes()
            manifest = decode_json(data, cls, f"{MANIFEST} in {folder}", FORMAT, StoreError)
            if manifest.checksum != manifest._crc():
                raise ValueError("the checksum does not match")
            return manifest
        except FileNotFoundError as error:
            raise StoreError(f"{folder} has no {MANIFEST}, so it is not an index; make one with lpn index.") from error
        except NotADirectoryError as error:
            raise StoreError(
                f"{folder} is a file; expected the folder of an index, so make one with lpn index."
            ) from error
        except OSError as error:
            raise unreadable_error(folder / MANIFEST, error) from error
        except (ValueError, RecursionError) as error:
            raise StoreError(
                f"{MANIFEST} in {folder} is damaged or not of the format {FORMAT}; make the index again with lpn index."
            ) from error

    def _crc(self) -> int:
        values = msgspec.to_builtins(self)
        del values["checksum"]
        return crc_of_values(values)


def is_manifest(name: str) -> bool:
    """Return whether a file of this name is an index's manifest, complete or interrupted."""
    return name == MANIFEST or _UNFINISHED.fullmatch(name) is not None


def verify(folder: Path) -> tuple[int, int]:
    """Read an index in full and compare it with its checksums; return its tiles and its unfinished parts.

    An unfinished part belongs to an interrupted or running add; its tiles are not in the index.

    Raises:
        StoreError: when the folder is not an index, or a file of it is damaged.
    """
    if not (folder / MANIFEST).exists() and any(is_manifest(path.name) for path in folder.iterdir()):
        raise StoreError(
            f"{folder} is an index whose making was interrupted, and holds nothing; make it again with lpn index."
        )
    manifest = IndexManifest.read(folder)
    sums = {folder / part.name / name: wanted for part in manifest.parts for name, wanted in part.sums.items()}
    if manifest.codes is not None:
        sums[folder / manifest.codes.name] = manifest.codes.sum
    for file, wanted in sums.items():
        with readable(file):
            found = sum_of(file)
        if found != wanted:
            raise StoreError(
                f"{file.name} in {file.parent} does not match its checksum; delete the index and make it again."
            )
    known = {part.name for part in manifest.parts}
    unfinished = sum(_PART.fullmatch(path.name) is not None and path.name not in known for path in folder.iterdir())
    return manifest.tiles, unfinished


def create(folder: Path, manifest: IndexManifest) -> IndexManifest:
    """Make an empty index in a folder, or check that an existing one is of the same kind and return its manifest.

    Raises:
        StoreError: when the folder holds something else, or cannot be written.
    """
    try:
        if folder.exists() and not folder.is_dir():
            raise StoreError(f"{folder} is a file; choose another place for the index.")
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / MANIFEST).exists():  # a whole index may lie in a folder that cannot be written
            return _check_same_kind(folder, IndexManifest.read(folder), manifest)
        with exclusive_lock(folder, wait=True):
            if (folder / MANIFEST).exists():
                return _check_same_kind(folder, IndexManifest.read(folder), manifest)
            # A process that was killed before it wrote the manifest leaves at most the manifest's temporary file.
            others = [file.name for file in folder.iterdir() if not _UNFINISHED.fullmatch(file.name)]
            if others:
                raise StoreError(
                    f"{folder} holds other files, such as {printable(min(others))}, and no {MANIFEST}; choose another folder "
                    "for the index."
                )
            write_atomic(folder / MANIFEST, manifest.to_json())
    except (OSError, OutputError) as error:
        raise _unwritable(folder, error) from error
    return manifest


@dataclass(frozen=True, eq=False)
class IndexSnapshot:
    """One version of an index.

    Attributes:
        alive: masks of the rows of each part that no newer part replaced, (B,); None for all.
        stamp: identifies the version of the manifest's file.
    """

    manifest: IndexManifest
    parts: list[Part]
    alive: list[BoolArray | None]
    stamp: tuple[int, ...]

    @property
    def starts(self) -> Int64Array:
        """The position of each part's first row among all rows, and the number of all rows, (P + 1,)."""
        return np.cumsum([0, *(part.rows for part in self.parts)], dtype=np.int64)

    def chosen(self, number: int, box: DegreeBox | None) -> Int64Array | None:
        """Return the searched rows of a part, ascending; None for all."""
        alive = self.alive[number]
        if box is None:
            return None if alive is None else np.flatnonzero(alive)
        inside = within(self.parts[number].positions, box)
        return np.flatnonzero(inside if alive is None else inside & alive)

    def scores(
        self, numbers: Sequence[int], asked: Float32Array, box: DegreeBox | None
    ) -> tuple[Int64Array, Float32Array]:
        """Score the searched rows of some parts in float32; return their positions among all rows, (C,), and scores, (C,)."""
        places, scores = [np.zeros(0, np.int64)], [np.zeros(0, np.float32)]
        starts = self.starts
        for number in numbers:
            part, rows = self.parts[number], self.chosen(number, box)
            if rows is None:
                found, rows = part.vectors @ asked, np.arange(part.rows)
            else:
                few = len(rows) * _FEW <= part.rows
                found = part.vectors[rows] @ asked if few else (part.vectors @ asked)[rows]
            places.append(starts[number] + rows)
            scores.append(found)
        return np.concatenate(places), np.concatenate(scores)


class FolderIndex(Index):
    """An index in a folder; subclasses define the search.

    Any number of processes may search while one adds, and see the new tiles at their next search. Adds take turns.

    Raises:
        StoreError: when the folder is not an index of this engine, or is damaged.
    """

    def __init__(self, folder: str | Path) -> None:
        self.folder = Path(folder)
        raise_open_file_limit()
        self._state = self._read()
        self.kind = self._state.manifest.kind
        if self._state.manifest.engine != self.engine:
            raise StoreError(
                f"{self.folder} is an index of the engine {self._state.manifest.engine}; open it with that engine, not with "
                f"{self.engine}."
            )

    def _add(self, names: list[str], vectors: Float32Array, places: Float64Array) -> None:
        """Add tiles; atomic, even if the process is killed."""
        self._change(lambda: self._with_engine_file(self._write(names, vectors, places)))

    def tiles(self) -> tuple[list[str], Float32Array, Float64Array]:
        """See `Index.tiles`; the descriptors of a single part stay on disk."""
        state = self._current()
        rows = [state.chosen(number, None) for number in range(len(state.parts))]
        kept = [slice(None) if some is None else some for some in rows]
        pairs = list(zip(state.parts, kept, strict=True))
        names = [name for part, some in pairs for name in np.array(part.names, object)[some].tolist()]
        vectors = [np.zeros((0, self.kind.numbers), np.float32), *(part.vectors[some] for part, some in pairs)]
        positions = [np.zeros((0, 2)), *(part.positions[some] for part, some in pairs)]
        joined = vectors[1] if len(vectors) == 2 else np.concatenate(vectors)
        return names, joined.reshape(-1, self.kind.n_parts, self.kind.embedding), np.concatenate(positions)

    def read(self, ids: Sequence[str]) -> tuple[Float32Array, Float64Array]:
        """See `Index.read`."""
        vectors = np.empty((len(ids), self.kind.numbers), np.float32)
        positions, held = np.full((len(ids), 2), np.nan), np.zeros(len(ids), np.bool_)
        for part in self._current().parts:  # a newer part replaces an older one's tile
            rows = part.find(ids)
            here = np.flatnonzero(rows >= 0)
            vectors[here], positions[here], held[here] = part.vectors[rows[here]], part.positions[rows[here]], True
        if not held.all():
            raise no_such_tile(ids[int(np.argmin(held))])
        return vectors.reshape(-1, self.kind.n_parts, self.kind.embedding), positions

    def holds(self, ids: Sequence[str]) -> BoolArray:
        """See `Index.holds`."""
        held = np.zeros(len(ids), np.bool_)
        for part in self._current().parts:
            held |= part.find(ids) >= 0
        return held

    def count(self) -> int:
        """See `Index.count`."""
        return self._current().manifest.tiles

    def close(self) -> None:
        """See `Index.close`."""
        self._state = IndexSnapshot(self._state.manifest, [], [], ())

    @abstractmethod
    def _with_engine_file(self, manifest: IndexManifest) -> IndexManifest:
        """Return the manifest of an add with the engine's own file, which this method may write."""

    def _change(self, change: Callable[[], IndexManifest]) -> None:
        """Apply `change` to the newest manifest; processes take turns."""
        try:
            with exclusive_lock(self.folder, wait=True):
                self._state = self._read()
                self._clear()
                write_atomic(self.folder / MANIFEST, change().to_json())
                self._state = self._read()
                self._clear()
        except (OSError, OutputError) as error:
            raise _unwritable(self.folder, error) from error

    def _current(self) -> IndexSnapshot:
        """Return the newest version of the index, whichever process wrote it."""
        if self._stamp() != self._state.stamp:
            self._state = self._read()
        return self._state

    def _result(self, state: IndexSnapshot, places: Int64Array, wanted: Float64Array, k: int) -> SearchResult:
        """Score candidates, by their positions (C,) among all rows, and return the k best."""
        places = np.sort(places)  # in their order on the disk
        scores = np.empty(len(places))
        for part, start, mine in _by_part(state, places):
            for i in range(0, len(mine), _ROWS_PER_READ):
                some = mine[i : i + _ROWS_PER_READ]
                scores[some] = scores_of(part.vectors[places[some] - start], wanted)
        chosen = best(scores, places, k)
        places, scores = places[chosen], scores[chosen]
        names = [""] * len(places)
        vectors = np.empty((len(places), self.kind.numbers), np.float32)
        positions = np.empty((len(places), 2))
        for part, start, mine in _by_part(state, places):
            rows = places[mine] - start
            vectors[mine], positions[mine] = part.vectors[rows], part.positions[rows]
            for position, row in zip(mine.tolist(), rows.tolist(), strict=True):
                names[position] = part.names[row]
        return SearchResult(names, scores, vectors.reshape(-1, self.kind.n_parts, self.kind.embedding), positions)

    def _stamp(self) -> tuple[int, ...]:
        """Identify the version of the manifest's file; empty if there is none."""
        try:
            stat = (self.folder / MANIFEST).stat()
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise unreadable_error(self.folder / MANIFEST, error) from error
        return stat.st_ino, stat.st_mtime_ns, stat.st_size

    def _read(self) -> IndexSnapshot:
        """Read the manifest and open its parts, reusing those that are open."""
        for attempt in range(_ATTEMPTS):
            stamp = self._stamp()
            manifest = IndexManifest.read(self.folder)
            try:
                return self._opened(manifest, stamp)
            except StoreError:
                # Another process may have removed a part since the manifest was read.
                if attempt + 1 == _ATTEMPTS or self._stamp() == stamp:
                    raise
        raise AssertionError

    def _opened(self, manifest: IndexManifest, stamp: tuple[int, ...]) -> IndexSnapshot:
        held = getattr(self, "_state", None)
        before: dict[str, tuple[Part, int, BoolArray | None]] = {}
        if held is not None:
            entries = zip(held.manifest.parts, held.parts, held.alive, strict=False)
            before = {entry.name: (part, entry.replaced, alive) for entry, part, alive in entries}
        parts, alive = [], []
        for entry in manifest.parts:
            folder, (part, *_) = self.folder / entry.name, before.get(entry.name, (None,))
            if part is None or (part.rows, part.identity) != (entry.rows, identity_of(folder)):
                part = Part(folder, manifest.kind, entry.rows)
            parts.append(part)
        for number, (entry, part) in enumerate(zip(manifest.parts, parts, strict=True)):
            known, replaced, mask = before.get(entry.name, (None, 0, None))
            if known is not part or replaced != entry.replaced:
                mask = _alive(part, parts[number + 1 :]) if entry.replaced else None
            alive.append(mask)
        return IndexSnapshot(manifest, parts, alive, stamp)

    def _write(self, names: list[str], vectors: Float32Array, places: Float64Array) -> IndexManifest:
        """Write the part of an add, and return the manifest with it."""
        manifest, state = self._state.manifest, self._state
        covered = () if manifest.codes is None else manifest.codes.parts
        left, entries = set(names), []
        for entry, part in zip(reversed(manifest.parts), reversed(state.parts), strict=True):
            replaced = left & part.row_of.keys()
            left -= replaced
            entry = replace(entry, replaced=entry.replaced + len(replaced))
            if entry.replaced < entry.rows or entry.name in covered:
                entries.append(entry)
        number = manifest.next
        while os.path.lexists(self.folder / f"{number:07d}"):
            number += 1
        name = f"{number:07d}"
        sums = write_part(self.folder / name, names, vectors, places)
        added = PartEntry(name, len(names), sums)
        return replace(manifest, parts=(*reversed(entries), added), next=number + 1)

    def _clear(self) -> None:
        """Delete files that the manifest does not name, unless the folder also holds files of other programs."""
        manifest = self._state.manifest
        named = {part.name for part in manifest.parts} | {manifest.codes.name if manifest.codes else MANIFEST}
        for path in self.folder.iterdir():
            if path.name in named:
                continue
            if _UNFINISHED.fullmatch(path.name) or _CODES.fullmatch(path.name):
                path.unlink(missing_ok=True)
            elif _PART.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                files = list(path.iterdir())
                if all(file.name in FILES and file.is_file() and not file.is_symlink() for file in files):
                    # Some systems cannot delete files that another process has open.
                    with suppress(OSError):
                        for file in files:
                            file.unlink()
                        path.rmdir()


def _by_part(state: IndexSnapshot, places: Int64Array) -> Iterator[tuple[Part, int, Int64Array]]:
    """Yield each part that holds some of the positions, its first row's position, and a mask of the positions in it."""
    owners = np.searchsorted(state.starts, places, "right") - 1
    for number in np.unique(owners).tolist():
        yield state.parts[number], int(state.starts[number]), np.flatnonzero(owners == number)


def _alive(part: Part, newer: Sequence[Part]) -> BoolArray:
    alive = np.ones(part.rows, np.bool_)
    for other in newer:
        alive[[part.row_of[name] for name in part.row_of.keys() & other.row_of.keys()]] = False
    return alive


def _check_same_kind(folder: Path, existing: IndexManifest, wanted: IndexManifest) -> IndexManifest:
    kind = "{0.n_parts} x {0.embedding} numbers of model {0.fingerprint}"
    for text in ("the engine {0.engine}", kind, "windows of {0.windows}"):
        present, new = text.format(existing), text.format(wanted)
        if present != new:
            raise StoreError(
                f"{folder} holds an index with {present}, but the new one has {new}; choose another folder, or delete the old "
                "index."
            )
    return existing


def _unwritable(folder: Path, error: OSError | OutputError) -> StoreError:
    why = error.strerror or str(error) if isinstance(error, OSError) else str(error)
    remedy = space_remedy(error) if isinstance(error, OSError) else ""
    return StoreError(f"The index {folder} cannot be written ({why}); {remedy}choose another folder.")
