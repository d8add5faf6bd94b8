"""Shards of descriptors: a folder or a prefix of Parquet files that many workers write. Needs the extra `cluster`.

    plan.json         format, model fingerprint, view, n and D, precision, the number of partitions, pictures of a shard,
                      whether the last run finished, and a digest of all shards
    000000.parquet    one file for each partition, which has the pictures whose names hash to it:
                      file, size, time_ns, box (or null), latitude, longitude (or null), descriptor (n D numbers in a row)
    broken.csv        pictures that could not be described, and why

A shard is written atomically, and its name depends on the partition alone, so no picture is there twice. Its metadata, under
the key `lpn`, repeat plan.json and hold the broken pictures and a digest of all its pictures; a later run recognises a
finished partition by the digest, without reading its rows. `lpn.cluster.gather` reads complete folders.

The number of partitions can be doubled: about half the pictures of partition p then move to partition p + the former number.
A run is finished when each shard has the plan's number of partitions and the digest of its pictures.
"""

from __future__ import annotations

import hashlib
import io
import json
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from typing import Annotated, Any, Literal, NamedTuple, TypeVar, cast

import msgspec
import pyarrow as pa
import pyarrow.parquet as pq

from lpn.cluster.storage import Storage
from lpn.core.arrays import AnyArray, Float32Array
from lpn.core.errors import StoreError
from lpn.core.formats import decode_json
from lpn.descriptors import Row
from lpn.models.contract import Role

FORMAT = "lpn-shards/2"
PLAN = "plan.json"
BROKEN = "broken.csv"
ShardPrecision = Literal["float32", "float16"]

# Columns of a shard other than the descriptor.
ITEM = ("file", "size", "time_ns", "box", "latitude", "longitude")
# Exceptions that reading a damaged shard can raise, in our code or in libraries.
DAMAGED = (
    OSError,
    ValueError,
    LookupError,
    TypeError,
    AttributeError,
    ArithmeticError,
    RecursionError,
    pa.ArrowException,
)
# Files that are read concurrently, because storage is slow to answer.
_AT_ONCE = 32
# Files that are queued at once, to limit memory.
_QUEUED = 1024

_T = TypeVar("_T")


class ShardItem(NamedTuple):
    """A picture to be described, and its position."""

    row: Row
    position: tuple[float, float] | None = None


class FailedPicture(NamedTuple):
    """A picture that could not be described.

    Attributes:
        item: the picture.
        reason: the end of a sentence, such as "is cut short or damaged".
        settled: the file itself is damaged, so a retry is useless until it changes; otherwise it could not be read.
    """

    item: ShardItem
    reason: str
    settled: bool


_Positive = Annotated[int, msgspec.Meta(gt=0, lt=2**31)]


@dataclass(frozen=True)
class Plan:
    """The contents of plan.json.

    Attributes:
        fingerprint: of the model; descriptors of different models cannot be compared.
        view: the view of the pictures.
        n_parts, embedding: n and D.
        precision: of the numbers in the shards.
        partitions: number of shards of the complete folder.
        finished: the last run finished, so all shards are of one state of the pictures.
        contents: see the function `contents`; None until a run finishes.
        shard: average number of pictures of a shard, at most.
        role: of the branch, where branches have roles.
    """

    fingerprint: str
    view: str
    n_parts: _Positive
    embedding: _Positive
    precision: ShardPrecision
    partitions: _Positive
    format: str = FORMAT
    finished: bool = field(default=False, compare=False)
    contents: str | None = field(default=None, compare=False)
    shard: _Positive | None = field(default=None, compare=False)
    role: Role | None = None

    @classmethod
    def read(cls, storage: Storage) -> Plan | None:
        """Read the plan of a folder, None if there is none; StoreError when its plan.json is something else."""
        try:
            return decode_json(storage.read(PLAN), cls, f"{PLAN} in {storage.where}", FORMAT, StoreError)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            raise StoreError(
                f"{PLAN} in {storage.where} cannot be read or is not one of {FORMAT}; choose another place for the shards."
            ) from error

    def to_json(self) -> bytes:
        """Encode the plan."""
        return (json.dumps(asdict(self), indent=1) + "\n").encode()

    def partition(self, name: str) -> int:
        """Return the partition of a picture, by its name alone."""
        return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) % self.partitions

    def comparable(self, other: Plan) -> bool:
        """Return whether shards of the other plan can be compared with these."""
        return _kind(self) == _kind(other)


def digest(items: Sequence[ShardItem]) -> str:
    """Hash the pictures of a shard, in any order."""
    return hashlib.sha256(json.dumps(sorted(map(_plain, items), key=lambda values: values[0])).encode()).hexdigest()


def shard_name(partition: int) -> str:
    """Return the file name of a partition."""
    return f"{partition:06d}.parquet"


def write_shard(
    storage: Storage,
    plan: Plan,
    partition: int,
    items: Sequence[ShardItem],
    descriptors: Float32Array,
    broken: Sequence[FailedPicture] = (),
) -> None:
    """Write a partition: described items with descriptors (B, n, D) float32, and broken pictures.

    Raises:
        OutputError: when it cannot be written; the former shard is then unchanged.
    """
    settled = [*items, *(one.item for one in broken if one.settled)]
    notes = {
        **_noted(plan),
        "partition": partition,
        "digest": digest(settled),
        "broken": [[_plain(one.item), one.reason, one.settled] for one in broken],
    }
    numbers = descriptors.astype(plan.precision).reshape(-1)
    columns = {
        "file": pa.array([item.row.file for item in items], pa.string()),
        "size": pa.array([item.row.size for item in items], pa.int64()),
        "time_ns": pa.array([item.row.time_ns for item in items], pa.int64()),
        "box": pa.array([item.row.box for item in items], pa.list_(pa.float64(), 4)),
        "latitude": pa.array([item.position and item.position[0] for item in items], pa.float64()),
        "longitude": pa.array([item.position and item.position[1] for item in items], pa.float64()),
        "descriptor": pa.FixedSizeListArray.from_arrays(pa.array(numbers), plan.n_parts * plan.embedding),
    }
    table = pa.table(columns).replace_schema_metadata({"lpn": json.dumps(notes)})
    buffer = io.BytesIO()
    # Descriptors are incompressible.
    pq.write_table(table, buffer, compression="NONE", use_dictionary=False, write_page_checksum=True)
    storage.write(shard_name(partition), buffer.getvalue())


class ShardContents(NamedTuple):
    """A whole shard; descriptors (B, n, D) are in its precision."""

    items: list[ShardItem]
    descriptors: AnyArray
    notes: ShardMetadata


def read_shard(storage: Storage, plan: Plan, partition: int) -> ShardContents | None:
    """Read a partition's shard; None if it is missing, damaged, or of another plan."""
    try:
        table = pq.read_table(pa.BufferReader(storage.read(shard_name(partition))), page_checksum_verification=True)
        notes = notes_of(table.schema, plan, partition)
        if notes is None:
            return None
        column = table.column("descriptor").combine_chunks()
        numbers = column.flatten().to_numpy(zero_copy_only=False).reshape(-1, plan.n_parts, plan.embedding)
        return ShardContents(items_of(table), numbers, notes)
    except DAMAGED:
        return None


def items_of(table: pa.Table) -> list[ShardItem]:
    """Read the items from a table with the columns `ITEM`; one of `DAMAGED` if it has none."""
    return [_item(one) for one in zip(*(table.column(name).to_pylist() for name in ITEM), strict=True)]


class ShardMetadata(NamedTuple):
    """The metadata of a shard.

    Attributes:
        digest: of its pictures, see the function `digest`.
        broken: the pictures that could not be described.
        partitions: number of partitions when it was written.
    """

    digest: str
    broken: list[FailedPicture]
    partitions: int


def contents(notes: Iterable[ShardMetadata]) -> str:
    """Hash the digests of all shards in order, to recognise the shards of one finished run."""
    return hashlib.sha256("\n".join(one.digest for one in notes).encode()).hexdigest()


def each(task: Callable[[int], _T], partitions: Sequence[int]) -> Iterator[_T]:
    """Map a function that waits for the storage over partitions, several at once; yield the results in order."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for start in range(0, len(partitions), _QUEUED):
            yield from pool.map(task, partitions[start : start + _QUEUED])


def read_notes(storage: Storage, plan: Plan, partitions: Sequence[int]) -> list[ShardMetadata | None]:
    """Read the metadata of shards without their rows; None for a missing or damaged shard."""

    def read(partition: int) -> ShardMetadata | None:
        try:
            with storage.open(shard_name(partition)) as file:
                return notes_of(pq.read_schema(file), plan, partition)
        except DAMAGED:
            return None

    return list(each(read, partitions))


def notes_of(schema: pa.Schema, plan: Plan, partition: int) -> ShardMetadata | None:
    """Read the metadata of a schema; None if it is of another plan or partition, one of `DAMAGED` if there is none."""
    notes = json.loads((schema.metadata or {}).get(b"lpn", b"{}"))
    wanted = {**_noted(plan), "partition": partition, "partitions": (partitions := notes.get("partitions"))}
    if {key: notes.get(key) for key in wanted} != wanted or type(partitions) is not int or partitions < 1:
        return None
    broken = [FailedPicture(_item(item), str(reason), bool(settled)) for item, reason, settled in notes["broken"]]
    return ShardMetadata(str(notes["digest"]), broken, partitions)


def _noted(plan: Plan) -> dict[str, Any]:
    """The entries of a plan that every shard repeats."""
    return {name: value for name, value in asdict(plan).items() if name not in ("finished", "contents", "shard")}


def _kind(plan: Plan) -> tuple[object, ...]:
    return plan.fingerprint, plan.view, plan.n_parts, plan.embedding, plan.precision


def _plain(item: ShardItem) -> list[Any]:
    row, place = item
    return [row.file, row.size, row.time_ns, row.box and list(row.box), *(place or (None, None))]


def _item(values: Sequence[Any]) -> ShardItem:
    file, size, time_ns, box, latitude, longitude = values
    box_sides = None if box is None else cast("tuple[float, float, float, float]", tuple(float(side) for side in box))
    return ShardItem(Row(file, size, time_ns, box_sides), None if latitude is None else (latitude, longitude))


def packed(items: Sequence[ShardItem]) -> str:
    """Encode items as text for a worker."""
    return json.dumps([_plain(item) for item in items])


def unpacked(text: str) -> list[ShardItem]:
    """Decode the text of `packed`."""
    return [_item(values) for values in json.loads(text)]
