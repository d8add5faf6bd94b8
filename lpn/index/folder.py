"""An index in a folder: a manifest and segments of tiles, with atomic adds.

    index.json       format, engine and its settings, model fingerprint, n, D, the segments, oldest first, and a checksum
    0000012/ ...     segments, see `lpn.index.segments`, each with checksums.json: CRC-32 of every block of its files

An add writes folders that the manifest does not name yet, and replaces the manifest last. If it is killed, the index is as it
was before, and the next add deletes the leftovers.

Segments are merged as in a log-structured merge tree, so that many small adds do not slow searches down. An add
starts with its own tiles. It then merges older segments, the newest first, while the next one has at most twice as many
tiles as are merged so far. Up to `max_segment_bytes`, each segment is then more than twice as large as the next newer
one. The number of segments, and how often a tile is rewritten, grow with the logarithm of the number of tiles.
"""

from __future__ import annotations

import json
import os
import re
import zlib
from abc import abstractmethod
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from dataclasses import replace as replace_fields
from pathlib import Path
from typing import Annotated

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
    DescriptorKind,
    Index,
    SearchResult,
    WindowsRecord,
    best,
    no_such_tile,
    scores_of,
)
from lpn.index.segment_checksums import NAME, changed_files, write_checksums
from lpn.index.segments import DEAD, FILES, Segment, TileBatch, identity_of, keys_of, write_segment

FORMAT = "lpn-index/1"
MANIFEST = "index.json"
_TEMPORARY_SUFFIX = r"\.\d+-\d+\.part"
_UNFINISHED = re.compile(re.escape(MANIFEST) + _TEMPORARY_SUFFIX)
_SUMS = re.compile(f"{re.escape(NAME)}({_TEMPORARY_SUFFIX})?")
_SEGMENT = re.compile(r"\d{7,}")
_REMEDY = "delete the index and make it again"
_ATTEMPTS = 20
_ROWS_PER_READ = 1024


class ManifestEntry(msgspec.Struct, frozen=True):
    """A segment of an index.

    Attributes:
        name: its folder.
        rows: number of tiles, including replaced ones.
        dead: name of the file that marks replaced tiles; None if no tile was replaced.
        dead_crc: CRC-32 of the file `dead`.
    """

    name: str
    rows: Annotated[int, msgspec.Meta(ge=0)]
    dead: str | None = None
    dead_crc: int | None = None


class IndexManifest(msgspec.Struct, frozen=True, kw_only=True):
    """The contents of index.json.

    Attributes:
        engine: "exact" or "faiss".
        fingerprint, n_parts, embedding: the descriptors, see `DescriptorKind`.
        settings: settings of the engine.
        next: number of the next folder or file to be written.
        segments: oldest first.
        windows: of a map, see `DescriptorKind`; None for other tiles.
        checksum: CRC-32 of all other values.
    """

    format: str = FORMAT
    engine: str
    fingerprint: str
    n_parts: int
    embedding: int
    settings: dict[str, str] = {}
    next: int = 1
    segments: tuple[ManifestEntry, ...] = ()
    windows: WindowsRecord | None = None
    checksum: int | None = None

    @property
    def kind(self) -> DescriptorKind:
        """The kind of descriptors."""
        return DescriptorKind(self.fingerprint, self.n_parts, self.embedding, self.windows)

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
    """Return whether a file of this name is an index's manifest, or one whose writing was interrupted."""
    return name == MANIFEST or _UNFINISHED.fullmatch(name) is not None


@dataclass(frozen=True)
class IndexContents:
    """The verified contents of an index.

    Attributes:
        tiles: number of tiles.
        unfinished: segments of an add that was interrupted or is still running, whose tiles are not in the index.
    """

    tiles: int
    unfinished: int


def verify(folder: Path) -> IndexContents:
    """Read an index in full and compare it with its checksums.

    Raises:
        StoreError: when the folder is not an index, or a file of it is damaged.
    """
    if not (folder / MANIFEST).exists() and any(is_manifest(path.name) for path in folder.iterdir()):
        raise StoreError(
            f"{folder} is an index whose making was interrupted, and holds nothing; make it again with lpn index."
        )
    manifest = IndexManifest.read(folder)
    tiles = 0
    for entry in manifest.segments:
        segment = folder / entry.name
        changed = changed_files(segment)
        try:
            tiles += Segment(segment, manifest.kind, entry.rows, entry.dead).size
            if entry.dead is not None and zlib.crc32((segment / entry.dead).read_bytes()) != entry.dead_crc:
                changed.append(entry.dead)
        except FileNotFoundError as error:
            raise StoreError(f"{error.filename} is missing; {_REMEDY}.") from error
        except OSError as error:
            raise unreadable_error(Path(error.filename or segment), error) from error
        if changed:
            raise StoreError(f"{changed[0]} in {segment} does not match its checksums; {_REMEDY}.")
    known = {entry.name for entry in manifest.segments}
    unfinished = sum(
        bool(_SEGMENT.fullmatch(path.name)) and path.is_dir() and path.name not in known for path in folder.iterdir()
    )
    return IndexContents(tiles, unfinished)


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
        stamp: identifies the version of the manifest's file.
    """

    manifest: IndexManifest
    segments: list[Segment]
    stamp: tuple[int, ...]


class FolderIndex(Index):
    """An index in a folder; subclasses define how it is searched.

    Any number of processes may search while one adds, and see the new tiles at their next search. Adds take turns.

    Raises:
        StoreError: when the folder is not an index of this engine, or is damaged.
    """

    # Maximum size of the vectors of a merged segment.
    max_segment_bytes = 1 << 30
    # Name of the file that `_finish` writes into a segment's folder, if any.
    engine_file: str | None = None

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
        self._change(lambda: self._write(TileBatch(names, vectors, places)))

    def tiles(self) -> tuple[list[str], Float32Array, Float64Array]:
        """See `Index.tiles`; the descriptors of a single segment stay on disk."""
        segments = self._current().segments
        rows, on_disk = sum(one.size for one in segments), len(segments) == 1 and segments[0].alive is None
        vectors = segments[0].in_order if on_disk else np.empty((rows, self.kind.numbers), np.float32)
        names: list[str] = []
        positions = [np.zeros((0, 2))]
        for batch in (batch for segment in segments for batch in segment.batches(segment.alive)):
            if not on_disk:
                vectors[len(names) : len(names) + len(batch.names)] = batch.vectors
            names += batch.names
            positions.append(batch.positions)
        return names, vectors.reshape(rows, self.kind.n_parts, self.kind.embedding), np.concatenate(positions)

    def read(self, ids: Sequence[str]) -> tuple[Float32Array, Float64Array]:
        """See `Index.read`."""
        vectors = np.empty((len(ids), self.kind.n_parts, self.kind.embedding), np.float32)
        positions, held = np.full((len(ids), 2), np.nan), np.zeros(len(ids), np.bool_)
        keys = keys_of(ids)
        for segment in self._current().segments:
            rows = segment.find(ids, keys)
            here = np.flatnonzero(rows >= 0)
            vectors[here] = segment.vectors[rows[here]].reshape(-1, *vectors.shape[1:])
            positions[here], held[here] = segment.positions[rows[here]], True
        if not held.all():
            raise no_such_tile(ids[int(np.argmin(held))])
        return vectors, positions

    def holds(self, ids: Sequence[str]) -> BoolArray:
        """See `Index.holds`."""
        held = np.zeros(len(ids), np.bool_)
        keys = keys_of(ids)
        for segment in self._current().segments:
            held |= segment.find(ids, keys) >= 0
        return held

    def count(self) -> int:
        """See `Index.count`."""
        return sum(segment.size for segment in self._current().segments)

    def close(self) -> None:
        """See `Index.close`."""
        self._state = replace_fields(self._state, segments=[])

    @abstractmethod
    def _finish(self, folder: Path, rows: int) -> None:
        """Write the engine's own file into a new segment's folder."""

    def _change(self, change: Callable[[], IndexManifest]) -> None:
        """Replace the manifest by what `change` returns for the newest one; processes take turns."""
        try:
            with exclusive_lock(self.folder, wait=True):
                self._state = self._read(self._state.segments)
                self._clear()
                write_atomic(self.folder / MANIFEST, change().to_json())
                self._state = self._read(self._state.segments)
                self._clear()
        except (OSError, OutputError) as error:
            raise _unwritable(self.folder, error) from error

    def _current(self) -> IndexSnapshot:
        """Return the newest version of the index, whichever process wrote it."""
        state = self._state
        if self._stamp() != state.stamp or not state.segments:
            state = self._state = self._read(state.segments)
        return state

    def _result(self, segments: list[Segment], places: Int64Array, wanted: Float64Array, k: int) -> SearchResult:
        """Score candidates, by their places (C,) among the rows of all segments, and return the k best."""
        starts = np.cumsum([0, *(segment.rows for segment in segments)])
        # Read rows in the order in which they lie on disk.
        places = np.sort(places)
        scores = np.empty(len(places))
        ends = np.searchsorted(places, starts)
        for segment, start, first, last in zip(segments, starts, ends, ends[1:], strict=False):
            for i in range(first, last, _ROWS_PER_READ):
                some = slice(i, min(i + _ROWS_PER_READ, last))
                scores[some] = scores_of(segment.vectors[places[some] - start], wanted)
        chosen = best(scores, places, k)
        places, scores = places[chosen], scores[chosen]
        names = [""] * len(places)
        vectors = np.empty((len(places), self.kind.numbers), np.float32)
        positions = np.empty((len(places), 2))
        for segment, start in zip(segments, starts, strict=False):
            mine = np.flatnonzero((places >= start) & (places < start + segment.rows))
            rows = places[mine] - start
            vectors[mine], positions[mine] = segment.vectors[rows], segment.positions[rows]
            for position, name in zip(mine.tolist(), segment.names(rows), strict=True):
                names[position] = name
        shaped = vectors.reshape(len(places), self.kind.n_parts, self.kind.embedding)
        return SearchResult(names, scores, shaped, positions)

    def _stamp(self) -> tuple[int, ...]:
        """Identify the version of the manifest's file; empty if there is none."""
        try:
            stat = (self.folder / MANIFEST).stat()
        except FileNotFoundError:
            return ()
        except OSError as error:
            raise unreadable_error(self.folder / MANIFEST, error) from error
        return stat.st_ino, stat.st_mtime_ns, stat.st_size

    def _read(self, held: Sequence[Segment] = ()) -> IndexSnapshot:
        """Read the manifest and open its segments, reusing held ones that have not changed."""
        open_now = {segment.folder.name: segment for segment in held}
        for attempt in range(_ATTEMPTS):
            stamp = self._stamp()
            manifest = IndexManifest.read(self.folder)
            try:
                segments = [
                    self._opened_segment(manifest, entry, open_now.get(entry.name)) for entry in manifest.segments
                ]
                return IndexSnapshot(manifest, segments, stamp)
            except FileNotFoundError as error:
                # Another process may have replaced a segment since the manifest was read.
                if attempt + 1 == _ATTEMPTS or self._stamp() == stamp:
                    raise StoreError(
                        f"{error.filename} is missing; the index is damaged, so delete it and make it again."
                    ) from error
        raise AssertionError

    def _opened_segment(self, manifest: IndexManifest, entry: ManifestEntry, held: Segment | None) -> Segment:
        folder = self.folder / entry.name
        if held is not None and (held.rows, held.dead, held.identity) == (entry.rows, entry.dead, identity_of(folder)):
            return held
        return Segment(folder, manifest.kind, entry.rows, entry.dead)

    def _write(self, batch: TileBatch) -> IndexManifest:
        """Write the files of an add, and return the manifest that lists them."""
        manifest, segments = self._state.manifest, self._state.segments
        keys = keys_of(batch.names)
        masks: list[BoolArray | None] = []
        for segment in segments:
            rows = segment.find(batch.names, keys)
            alive = segment.alive
            if (rows >= 0).any():
                alive = np.ones(segment.rows, np.bool_) if alive is None else alive.copy()
                alive[rows[rows >= 0]] = False
            masks.append(alive)
        sizes = [
            segment.rows if mask is None else int(mask.sum()) for segment, mask in zip(segments, masks, strict=True)
        ]
        unmerged, rows_new = self._plan_merge(sizes, len(batch.names))
        entries: list[ManifestEntry] = []
        number = self._unused_number(manifest.next)
        for entry, segment, mask, size in zip(manifest.segments[:unmerged], segments, masks, sizes, strict=False):
            if 2 * size < segment.rows:
                if size:
                    entries.append(self._segment(number, segment.batches(mask), size))
                    number = self._unused_number(number + 1)
            elif mask is not segment.alive:
                assert mask is not None
                dead = f"dead-{number:07d}.npy"
                np.save(segment.folder / dead, ~mask)
                entries.append(replace(entry, dead=dead, dead_crc=zlib.crc32((segment.folder / dead).read_bytes())))
                number = self._unused_number(number + 1)
            else:
                entries.append(entry)

        def gathered() -> Iterator[TileBatch]:
            for segment, mask in zip(segments[unmerged:], masks[unmerged:], strict=True):
                yield from segment.batches(mask)
            yield batch

        entries.append(self._segment(number, gathered(), rows_new))
        return replace(manifest, segments=tuple(entries), next=number + 1)

    def _plan_merge(self, sizes: Sequence[int], rows: int) -> tuple[int, int]:
        """Choose the segments that an add of `rows` tiles merges.

        Returns:
            The number of older segments that stay as they are, and the size of the merged one.
        """
        unmerged = len(sizes)
        most = self.max_segment_bytes // (4 * self.kind.numbers)
        while unmerged and sizes[unmerged - 1] <= 2 * rows and rows + sizes[unmerged - 1] <= most:
            unmerged -= 1
            rows += sizes[unmerged]
        return unmerged, rows

    def _segment(self, number: int, batches: Iterator[TileBatch], rows: int) -> ManifestEntry:
        name = f"{number:07d}"
        write_segment(self.folder / name, self.kind, batches, rows)
        self._finish(self.folder / name, rows)
        write_checksums(self.folder / name)
        return ManifestEntry(name, rows)

    def _unused_number(self, number: int) -> int:
        """Return the first unused number from this one on."""
        while os.path.lexists(self.folder / f"{number:07d}"):
            number += 1
        return number

    def _clear(self) -> None:
        """Delete files that the manifest does not list: merged segments, and leftovers of a killed add.

        A folder that also holds files of other programs is not touched.
        """
        entries = {entry.name: entry for entry in self._state.manifest.segments}
        for path in self.folder.iterdir():
            if path.name in entries:
                for file in path.glob("dead-*.npy"):
                    if file.name != entries[path.name].dead and DEAD.fullmatch(file.name):
                        file.unlink(missing_ok=True)
            elif _UNFINISHED.fullmatch(path.name):
                path.unlink(missing_ok=True)
            elif _SEGMENT.fullmatch(path.name) and path.is_dir() and not path.is_symlink():
                # Some systems do not delete files that another process has open.
                with suppress(OSError):
                    self._remove(path)

    def _remove(self, segment: Path) -> None:
        files = list(segment.iterdir())
        if all(self._is_own(file) for file in files):
            for file in files:
                file.unlink()
            segment.rmdir()

    def _is_own(self, file: Path) -> bool:
        named = file.name == self.engine_file or any(names.fullmatch(file.name) for names in (FILES, _SUMS))
        return named and file.is_file() and not file.is_symlink()


def _check_same_kind(folder: Path, existing: IndexManifest, wanted: IndexManifest) -> IndexManifest:
    kind = "{0.n_parts} x {0.embedding} numbers of model {0.fingerprint}"
    for text in ("the engine {0.engine}", kind, "settings {0.settings}", "windows of {0.windows}"):
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
