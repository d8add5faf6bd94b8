"""Parts of descriptors: a folder or a prefix of immutable files that many workers write. Needs the extra `cluster`.

    plan.json            format, model fingerprint, view, n and D, precision; after a run, a digest of the parts' names
    part-<digest>.zip    pictures with size, time, box, and position; their descriptors; pictures that could not be described
    broken.csv           pictures that could not be described, and why

The digest in a part's name covers its pictures, so that repeated work writes the same file. An archive has a
CRC-32 of each of its two entries, which every reader checks.
"""

from __future__ import annotations

import hashlib
import io
import json
import re
import zipfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple, TypeVar

import msgspec
import numpy as np
import pyarrow as pa

from lpn.cluster.storage import Storage
from lpn.core.arrays import AnyArray, Float32Array, Float64Array
from lpn.core.errors import StoreError
from lpn.core.formats import decode_json
from lpn.descriptors import CropBox, Manifest, Row, Store
from lpn.descriptors.partial_store import PartialStore
from lpn.descriptors.writer import write_store
from lpn.models.contract import Role

FORMAT = "lpn-parts/1"
PLAN, BROKEN = "plan.json", "broken.csv"
PartPrecision = Literal["float32", "float16"]

_NAME = re.compile(r"part-[0-9a-f]{32}\.zip")
_NOTES, _VECTORS = "notes.json", "vectors.bin"
# Exceptions that reading a damaged part can raise, in our code or in libraries.
_DAMAGED = (OSError, ValueError, LookupError, RecursionError, EOFError, zipfile.BadZipFile, NotImplementedError)
# Files that are read concurrently, because storage is slow to answer, and the length of the queue.
_AT_ONCE, _QUEUED = 32, 1024

_T = TypeVar("_T")
_Positive = Annotated[int, msgspec.Meta(gt=0, lt=2**31)]


class PartItem(NamedTuple):
    """A picture to be described, and its latitude and longitude in degrees."""

    row: Row
    position: tuple[float, float] | None = None


class FailedPicture(NamedTuple):
    """A picture that could not be described.

    Attributes:
        reason: the end of a sentence, such as "is cut short or damaged".
        settled: the file itself is damaged, so a retry is useless until it changes; otherwise it could not be read.
    """

    item: PartItem
    reason: str
    settled: bool


@dataclass(frozen=True)
class Plan:
    """The contents of plan.json.

    Attributes:
        fingerprint: of the model; descriptors of different models cannot be compared.
        view: of the pictures.
        n_parts, embedding: n and D.
        precision: of the numbers.
        role: of the branch, if branches have roles.
        contents: digest of the names of all parts, see `contents_of`; None until a run has ended.
    """

    fingerprint: str
    view: str
    n_parts: _Positive
    embedding: _Positive
    precision: PartPrecision
    role: Role | None = None
    format: str = FORMAT
    contents: str | None = field(default=None, compare=False)

    @classmethod
    def read(cls, storage: Storage) -> Plan | None:
        """Read the plan of a folder, None if there is none; StoreError when its plan.json is invalid."""
        try:
            return decode_json(storage.read(PLAN), cls, f"{PLAN} in {storage.where}", FORMAT, StoreError)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            raise StoreError(
                f"{PLAN} in {storage.where} cannot be read or is not one of {FORMAT}; choose another place for the parts."
            ) from error

    def to_json(self) -> bytes:
        """Encode the plan."""
        return (json.dumps(asdict(self), indent=1) + "\n").encode()


class _Notes(msgspec.Struct):
    fingerprint: str
    view: str
    n_parts: int
    embedding: int
    precision: str
    role: str | None
    items: list[tuple[str, int, int, CropBox | None, tuple[float, float] | None]]
    broken: list[tuple[tuple[str, int, int, CropBox | None, tuple[float, float] | None], str, bool]]


class PartContents(NamedTuple):
    """The pictures of a part, in the order of its descriptors, and those that could not be described."""

    name: str
    items: list[PartItem]
    broken: list[FailedPicture]

    @property
    def positions(self) -> Float64Array:
        """Latitude and longitude in degrees, (B, 2), NaN for a tile without a position."""
        nowhere = (np.nan, np.nan)
        return np.array([nowhere if one.position is None else one.position for one in self.items]).reshape(-1, 2)


def part_names(storage: Storage) -> list[str]:
    """Return the names of all parts in a place, in order."""
    return [row.file for row in storage.files((".zip",)) if _NAME.fullmatch(row.file)]


def contents_of(names: Iterable[str]) -> str:
    """Hash the names of all parts, which identify their contents."""
    return hashlib.sha256("\n".join(sorted(names)).encode()).hexdigest()


def write_part(
    storage: Storage,
    plan: Plan,
    items: Sequence[PartItem],
    descriptors: Float32Array,
    broken: Sequence[FailedPicture] = (),
) -> str:
    """Write a part of described items, with descriptors (B, n, D) float32, and of broken pictures; return its name.

    Raises:
        OutputError: when it cannot be written.
    """
    kind = {name: value for name, value in asdict(plan).items() if name not in ("format", "contents")}
    failed = [(_plain(one.item), one.reason, one.settled) for one in broken]
    notes = msgspec.json.encode(_Notes(**kind, items=list(map(_plain, items)), broken=failed))
    name = f"part-{hashlib.sha256(notes).hexdigest()[:32]}.zip"
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        archive.writestr(zipfile.ZipInfo(_NOTES), notes)
        archive.writestr(zipfile.ZipInfo(_VECTORS), descriptors.astype(plan.precision).tobytes())
    storage.write(name, buffer.getvalue())
    return name


def read_part(storage: Storage, plan: Plan, name: str) -> PartContents | None:
    """Read the pictures of a part without its descriptors; None if it is missing, damaged, or of another plan."""
    try:
        with storage.open(name) as file, zipfile.ZipFile(file) as archive:
            notes = msgspec.json.decode(_entry(archive, _NOTES), type=_Notes)
    except (*_DAMAGED, pa.ArrowException):
        return None
    kind = (notes.fingerprint, notes.view, notes.n_parts, notes.embedding, notes.precision, notes.role)
    if kind != (plan.fingerprint, plan.view, plan.n_parts, plan.embedding, plan.precision, plan.role):
        return None
    broken = [FailedPicture(_item(*item), reason, settled) for item, reason, settled in notes.broken]
    return PartContents(name, [_item(*item) for item in notes.items], broken)


def read_vectors(storage: Storage, plan: Plan, part: PartContents) -> Float32Array:
    """Read the descriptors of a part, (B, n, D) float32; StoreError when it is damaged, or was removed meanwhile."""
    try:
        with storage.open(part.name) as file, zipfile.ZipFile(file) as archive:
            numbers: AnyArray = np.frombuffer(_entry(archive, _VECTORS), plan.precision)
        return numbers.reshape(len(part.items), plan.n_parts, plan.embedding).astype(np.float32)
    except FileNotFoundError as error:
        raise StoreError(
            f"{part.name} in {storage.where} was written anew while it was read; run this again when lpn describe has ended."
        ) from error
    except (*_DAMAGED, pa.ArrowException) as error:
        raise StoreError(
            f"{part.name} in {storage.where} is damaged; run lpn describe --engine ray again, which computes it."
        ) from error


@dataclass(frozen=True)
class Parts:
    """The parts of a run that has ended; each picture is in exactly one of them.

    Attributes:
        storage: the folder or prefix.
        plan: the contents of plan.json.
        parts: all parts.
    """

    storage: Storage
    plan: Plan
    parts: list[PartContents]

    @property
    def broken(self) -> list[FailedPicture]:
        """The pictures that could not be described, also listed in `broken.csv`."""
        return [one for part in self.parts for one in part.broken]

    def vectors(self, part: PartContents) -> Float32Array:
        """Read the descriptors of a part, see `read_vectors`."""
        return read_vectors(self.storage, self.plan, part)


def open_parts(where: str | Path) -> Parts:
    """Open the parts of a run that has ended; StoreError if none are there, one is missing or damaged, or a run goes on."""
    storage = Storage(where)
    plan = Plan.read(storage)
    if plan is None:
        raise StoreError(
            f"{storage.where} has no {PLAN}, so it is no folder of parts; write them with lpn describe --engine ray."
        )
    names = part_names(storage)
    again = "run lpn describe --engine ray again, which computes only what is missing"
    if plan.contents is None:
        raise StoreError(f"The run that writes the parts in {where} has not ended; wait for it, or {again}.")
    if contents_of(names) != plan.contents:
        raise StoreError(f"The parts in {where} are not those of the run that ended last; {again}.")
    found = list(each(lambda name: read_part(storage, plan, name), names))
    parts = [part for part in found if part is not None]
    if len(parts) < len(found):
        raise StoreError(f"{len(found) - len(parts)} of {len(found)} parts in {where} are damaged; {again}.")
    return Parts(storage, plan, parts)


def to_store(parts: Parts, out: str | Path) -> Store:
    """Gather parts into a store of descriptors on this machine, in order of the pictures' names and without positions.

    The store equals the output of `lpn.descriptors.describe` for the same pictures, which can continue it.

    Raises:
        StoreError: when a part is damaged or was removed, or `out` cannot be written or holds something else.
    """
    plan = parts.plan
    rows = sorted((one.row for part in parts.parts for one in part.items), key=lambda row: row.file.split("/"))
    if not rows:
        raise StoreError(f"The parts in {parts.storage.where} hold no picture, all being broken; see {BROKEN} there.")
    place = {row: i for i, row in enumerate(rows)}
    size = plan.n_parts, plan.embedding
    manifest = Manifest(plan.fingerprint, plan.view, 0.0, *size, tuple(rows), plan.precision, role=plan.role)

    def fill(unfinished: PartialStore) -> None:
        for part in parts.parts:
            if part.items:
                unfinished.put([place[one.row] for one in part.items], parts.vectors(part))

    return write_store(Path(out), manifest, fill)


def each(task: Callable[[str], _T], names: Sequence[str]) -> Iterator[_T]:
    """Map a function that waits for the storage over names, several at once; yield the results in order."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for start in range(0, len(names), _QUEUED):
            yield from pool.map(task, names[start : start + _QUEUED])


def packed(items: Sequence[PartItem]) -> str:
    """Encode items as text for a worker."""
    return json.dumps(list(map(_plain, items)))


def unpacked(text: str) -> list[PartItem]:
    """Decode the text of `packed`."""
    return [_item(*values) for values in json.loads(text)]


def _entry(archive: zipfile.ZipFile, name: str) -> bytes:
    """Read an entry of at most the stated size; its CRC-32 is checked."""
    info = archive.getinfo(name)
    if info.compress_type != zipfile.ZIP_STORED or info.file_size != info.compress_size:
        raise ValueError("a packed entry")
    return archive.read(info)


def _plain(item: PartItem) -> tuple[Any, ...]:
    row, position = item
    return row.file, row.size, row.time_ns, row.box, position


def _item(
    file: str, size: int, time_ns: int, box: Sequence[float] | None, position: Sequence[float] | None
) -> PartItem:
    row = Row(file, size, time_ns, None if box is None else (box[0], box[1], box[2], box[3]))
    return PartItem(row, None if position is None else (position[0], position[1]))
