"""Descriptors past one machine: a folder or a prefix of Parquet files, written by many workers. Needs the extra `ray`.

    plan.json         format, model fingerprint, view, n and D, precision, the number of partitions, pictures of one shard, a
                      random id of the last run, whether that ended (from before its first shard to its end a run leaves that at
                      false), and then the digest of all shards
    000000.parquet    one file for each partition, which is all pictures whose name's hash falls to it:
                      file, size, time_ns, box (or null), latitude, longitude (or null), descriptor (n D numbers in a row)
    broken.csv        pictures that could not be described, with what is wrong

A shard is written whole or not at all, and a partition has one name whoever writes it and however often: no picture is there
twice. Its metadata, under the key `lpn`, hold what plan.json holds, which pictures could not be described, and a digest of the
pictures that it settles, by which a later run tells a finished partition without reading its rows. `lpn.cluster.gather` reads what is
complete.

As pictures become more, partitions are doubled: of those of a partition, about half fall to a new one then, whose number is
higher by as many as there were. A run ends when each shard has the plan's number of partitions and the digest of its pictures.
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

FORMAT = "lpn-shards/2"
PLAN = "plan.json"
BROKEN = "broken.csv"
Precision = Literal["float32", "float16"]
Position = tuple[float, float] | None
"""Latitude and longitude in degrees."""

ITEM = ("file", "size", "time_ns", "box", "latitude", "longitude")
"""Columns of a shard: all but the descriptor."""
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
"""What is raised on a file that is no shard, by whoever notices."""
_AT_ONCE = 32
"""Files that are looked into at once: it is the latency of the storage that takes the time."""
_QUEUED = 1024
"""Files that are waited for at most, so that those of any number take no memory."""

_T = TypeVar("_T")


class ShardItem(NamedTuple):
    """A picture to be described, and where it is."""

    row: Row
    position: Position = None


class BrokenPicture(NamedTuple):
    """A picture that could not be described.

    Attributes:
        item: the picture.
        reason: the end of a sentence, such as "is cut short or damaged".
        settled: the file itself is damaged, so that trying again is of no use until it changes; otherwise it could not be read.
    """

    item: ShardItem
    reason: str
    settled: bool


_Positive = Annotated[int, msgspec.Meta(gt=0, lt=2**31)]


@dataclass(frozen=True)
class Plan:
    """What a folder of shards holds.

    Attributes:
        fingerprint: of the model; descriptors of another model cannot be compared with these.
        view: the branch used.
        n_parts, embedding: n and D.
        precision: of the numbers in the files.
        partitions: how many shards there are when it is complete.
        finished: whether the last run ended, so that all shards are of one state of the pictures.
        contents: see the function `contents`; None before a run ended, and of an earlier version.
        run: a random id of the last run, by which it knows whether the place is still its own; None of an earlier version.
        shard: pictures of one shard, on average at most; None of an earlier version.
    """

    fingerprint: str
    view: str
    n_parts: _Positive
    embedding: _Positive
    precision: Precision
    partitions: _Positive
    format: str = FORMAT
    finished: bool = field(default=False, compare=False)
    contents: str | None = field(default=None, compare=False)
    run: str | None = field(default=None, compare=False)
    shard: _Positive | None = field(default=None, compare=False)

    @classmethod
    def read(cls, storage: Storage) -> Plan | None:
        """The plan of a folder, None where there is none; StoreError when its plan.json is something else."""
        try:
            return decode_json(storage.read(PLAN), cls, f"{PLAN} in {storage.where}", FORMAT, StoreError)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            raise StoreError(
                f"{PLAN} in {storage.where} cannot be read or is not one of {FORMAT}; choose another place for the shards."
            ) from error

    def to_json(self) -> bytes:
        """The plan as a JSON file."""
        return (json.dumps(asdict(self), indent=1) + "\n").encode()

    def partition(self, name: str) -> int:
        """The partition that a picture falls to, by its name alone."""
        return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8]) % self.partitions

    def comparable(self, other: Plan) -> bool:
        """Whether shards of the other may lie beside these."""
        return _kind(self) == _kind(other)

    def check_own(self, storage: Storage) -> None:
        """Nothing, as long as the place is this run's; StoreError when another run began there since."""
        held = Plan.read(storage)
        if held is not None and held.run != self.run:
            raise StoreError(overtaken(storage))


def overtaken(storage: Storage) -> str:
    """One sentence about a place that two runs wrote to."""
    return f"Another run of lpn describe wrote to {storage.where} meanwhile; run this again when it has ended."


def digest(items: Sequence[ShardItem]) -> str:
    """What tells whether a shard settles just these pictures, in any order."""
    return hashlib.sha256(json.dumps(sorted(map(_plain, items), key=lambda values: values[0])).encode()).hexdigest()


def shard_name(partition: int) -> str:
    """The file of a partition."""
    return f"{partition:06d}.parquet"


def write_shard(
    storage: Storage,
    plan: Plan,
    partition: int,
    items: Sequence[ShardItem],
    descriptors: Float32Array,
    broken: Sequence[BrokenPicture] = (),
) -> None:
    """Write a partition: the items that were described, with descriptors (B, n, D) float32, and those that could not be.

    Raises:
        OutputError: when it cannot be written; what was there before is there still.
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
    # Descriptors are as good as random: compressing them takes time and saves nothing.
    pq.write_table(table, buffer, compression="NONE", use_dictionary=False, write_page_checksum=True)
    storage.write(shard_name(partition), buffer.getvalue())


class ShardContents(NamedTuple):
    """A shard as it was written; descriptors (B, n, D) in its precision."""

    items: list[ShardItem]
    descriptors: AnyArray
    notes: ShardMetadata


def read_shard(storage: Storage, plan: Plan, partition: int) -> ShardContents | None:
    """A partition's shard, None where there is none or it is damaged or of another plan."""
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
    """The items of a shard's rows, from a table that has the columns of `ITEM`; one of `DAMAGED` where it is none."""
    return [_item(one) for one in zip(*(table.column(name).to_pylist() for name in ITEM), strict=True)]


class ShardMetadata(NamedTuple):
    """What a shard says of itself.

    Attributes:
        digest: of the pictures that it settles, see the function `digest`.
        broken: the pictures that could not be described.
        partitions: how many there were when it was written.
    """

    digest: str
    broken: list[BrokenPicture]
    partitions: int


def contents(notes: Iterable[ShardMetadata]) -> str:
    """What tells whether shards are those of one run's end: a digest of their digests, in order of the partitions."""
    return hashlib.sha256("\n".join(one.digest for one in notes).encode()).hexdigest()


def each(task: Callable[[int], _T], partitions: Sequence[int]) -> Iterator[_T]:
    """What a task that waits for the storage gives for each partition, in order; several are waited for at once."""
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        for start in range(0, len(partitions), _QUEUED):
            yield from pool.map(task, partitions[start : start + _QUEUED])


def read_notes(storage: Storage, plan: Plan, partitions: Sequence[int]) -> list[ShardMetadata | None]:
    """The notes of partitions' shards, without reading their rows; None for a shard that is missing or damaged."""

    def read(partition: int) -> ShardMetadata | None:
        try:
            with storage.open(shard_name(partition)) as file:
                return notes_of(pq.read_schema(file), plan, partition)
        except DAMAGED:
            return None

    return list(each(read, partitions))


def notes_of(schema: pa.Schema, plan: Plan, partition: int) -> ShardMetadata | None:
    """The notes in a file's schema, None where they are of another plan or partition; one of `DAMAGED` where they are none."""
    notes = json.loads((schema.metadata or {}).get(b"lpn", b"{}"))
    wanted = {**_noted(plan), "partition": partition, "partitions": (partitions := notes.get("partitions"))}
    if {key: notes.get(key) for key in wanted} != wanted or type(partitions) is not int or partitions < 1:
        return None
    broken = [BrokenPicture(_item(item), str(reason), bool(settled)) for item, reason, settled in notes["broken"]]
    return ShardMetadata(str(notes["digest"]), broken, partitions)


def _noted(plan: Plan) -> dict[str, Any]:
    """What every shard repeats of its plan."""
    return {name: value for name, value in asdict(plan).items() if name not in ("finished", "contents", "run", "shard")}


def _kind(plan: Plan) -> tuple[object, ...]:
    return plan.fingerprint, plan.view, plan.n_parts, plan.embedding, plan.precision


def _plain(item: ShardItem) -> list[Any]:
    row, place = item
    return [row.file, row.size, row.time_ns, row.box and list(row.box), *(place or (None, None))]


def _item(values: Sequence[Any]) -> ShardItem:
    file, size, time_ns, box, latitude, longitude = values
    kept = None if box is None else cast("tuple[float, float, float, float]", tuple(float(side) for side in box))
    return ShardItem(Row(file, size, time_ns, kept), None if latitude is None else (latitude, longitude))


def packed(items: Sequence[ShardItem]) -> str:
    """Items as text, to send them to a worker."""
    return json.dumps([_plain(item) for item in items])


def unpacked(text: str) -> list[ShardItem]:
    """What `packed` wrote."""
    return [_item(values) for values in json.loads(text)]
