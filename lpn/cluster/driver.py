"""The driver of distributed inference: Ray Data maps partitions of the pictures to shards (`lpn.cluster.shards`).

A worker reads the pictures of a partition, describes them as `lpn describe` does on one machine, and writes the shard. Driver
and workers exchange names and counts only. If a worker is killed, another worker does its partition. If the driver is killed,
the next run does the missing partitions. A partition whose pictures were added, changed, or removed is rewritten, and
unchanged rows are copied. When a folder outgrows its partitions, their number is doubled: each old partition is split in two.
The new shard copies its rows from the old shard, which is rewritten without these rows afterwards.

A run marks the plan as unfinished first, and checks all shards before it marks it as finished. Two runs at once into one
folder are refused; in object storage, a run fails if another one has changed its shards.

Broken pictures do not stop a run, unlike on one machine: among millions there are always some. They are listed in
`broken.csv`, recorded in the shards, and counted at the end.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lpn.cluster.session import ray_session
from lpn.cluster.shards import (
    BROKEN,
    PLAN,
    FailedPicture,
    Plan,
    ShardItem,
    ShardMetadata,
    ShardPrecision,
    contents,
    digest,
    packed,
    read_notes,
)
from lpn.cluster.storage import Storage
from lpn.cluster.worker import DescribeWorker, PartitionTask
from lpn.core import images
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import DataError, InputError, StoreError
from lpn.core.files import exclusive_lock
from lpn.core.views import View
from lpn.datasets import geo
from lpn.models.contract import Role
from lpn.models.onnx_engine import Engine, graph_files
from lpn.models.shipped import model_file

# Seconds between two lines of progress.
_PROGRESS_SECONDS = 5.0
# Retries of a partition whose worker died. They are limited because the partition itself may kill its workers.
_RETRIES = 5
# Default number of pictures per shard.
_PICTURES_PER_SHARD = 256
# Maximum number of Ray Data blocks.
_MAX_BLOCKS = 4096


@dataclass(frozen=True)
class Summary:
    """The result of a run.

    Attributes:
        pictures: number of pictures.
        computed: number of pictures that were described by this run.
        broken: pictures that could not be described, in order of their names.
    """

    pictures: int
    computed: int
    broken: list[FailedPicture]


def describe_shards(
    model: Path,
    pictures: str | Path,
    view: View,
    out: str | Path,
    precision: ShardPrecision = "float32",
    address: str | None = None,
    workers: int | None = None,
    threads: int = 1,
    shard: int | None = None,
    positions: str | Path | None = None,
    say: Callable[[str], None] = print,
    worker: type[DescribeWorker] = DescribeWorker,
    role: Role | None = None,
) -> Summary:
    """Describe all pictures below a folder or prefix into shards, skipping those that are there already.

    Args:
        model: an exported model, `.onnx`; only this machine needs the file.
        pictures: a folder, or a URI such as s3://bucket/prefix; all machines of a cluster must see it.
        view: the view of the pictures.
        out: folder or URI of the shards; all machines must see it too.
        precision: of the numbers in the shards.
        address: of a Ray cluster, "auto" for the one of this machine; None starts workers on this machine.
        workers: number of workers; by default as many as fit the cores.
        threads: cores of a worker; each worker has its own copy of the model.
        shard: maximum average number of pictures per shard. A killed worker loses about one shard of work. The default
            is the value of the last run into `out`, else 256. If the folder of pictures grows, the number of shards is
            doubled as needed.
        positions: a file in the format of geo.csv; by default the `geo.csv` among the pictures. For how its paths are
            matched to the pictures, see `lpn.datasets.geo.Positions.match`.
        say: called with each line of progress.
        worker: the worker's class.
        role: of the branch, see `Model.in_role`.

    Raises:
        InputError: when an option is invalid, there is no such cluster, or `positions` match the pictures ambiguously.
        DataError: when there are no pictures, or some have no position.
        StoreError: when `out` cannot be written, holds shards of another model, view, or precision, or another run wrote there
            meanwhile.
    """
    model = model_file(model)
    if model.suffix != ".onnx":
        raise InputError(f"{model.name} is not an exported model, which workers need; make one with lpn export.")
    for name, number in (("workers", workers), ("threads", threads), ("pictures of a shard", shard)):
        if number is not None and number < 1:
            raise InputError(f"The number of {name} is {number}; expected 1 or more.")
    engine = Engine(model, threads=1).in_role(view, role)
    source, target = Storage(pictures), Storage(out)
    items = _items(source, positions)
    role = engine.role(view) if engine.contract.roles == "role" else None
    wanted = Plan(engine.fingerprint, view, engine.n_parts, engine.embedding, precision, 1, shard=shard, role=role)
    files = {path.name: path.read_bytes() for path in graph_files(model, list(engine.contract.groups))}
    del engine
    if target.folder is None:
        return _run(source, target, items, wanted, files, model.name, address, workers, threads, say, worker)
    try:
        target.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(
            f"{target.where} cannot be written ({error.strerror or error}); choose another folder."
        ) from error
    with exclusive_lock(target.folder, wait=False):
        return _run(source, target, items, wanted, files, model.name, address, workers, threads, say, worker)


def _items(source: Storage, positions: str | Path | None) -> list[ShardItem]:
    rows = source.files(images.SUFFIXES)
    if not rows:
        raise DataError(f"{source.where} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
    listed = _positions(source, positions)
    if listed is None:
        return [ShardItem(row) for row in rows]
    names, source_name = [row.file for row in rows], str(positions or geo.NAME)
    folder = source.folder or Path()
    if positions is not None:
        matched = zip(names, geo.Positions(folder, listed, source_name).match(names), strict=True)
        listed = {name: place for name, place in matched if place is not None}
    places = geo.Positions(folder, listed, source_name).below(names)
    return [ShardItem(row, (at.latitude, at.longitude)) for row, at in zip(rows, places, strict=True)]


def _positions(source: Storage, file: str | Path | None) -> dict[str, geo.Position] | None:
    try:
        if file is None:
            return geo.read_positions(source.read(geo.NAME))
        folder, _, name = str(file).rpartition("/")
        return geo.read_positions(Storage(folder or ".").read(name), str(file))
    except FileNotFoundError as error:
        if file is None:
            return None
        raise DataError(f"There is no file of positions at {file}; check the path.") from error
    except OSError as error:
        raise DataError(f"{file or geo.NAME} cannot be read ({error}); check your rights there.") from error


def _run(
    source: Storage,
    target: Storage,
    items: list[ShardItem],
    wanted: Plan,
    files: dict[str, bytes],
    model: str,
    address: str | None,
    workers: int | None,
    threads: int,
    say: Callable[[str], None],
    worker: type[DescribeWorker],
) -> Summary:
    plan = _plan(target, wanted, len(items))
    partitions: list[list[ShardItem]] = [[] for _ in range(plan.partitions)]
    for item in items:
        partitions[plan.partition(item.row.file)].append(item)
    digests = [digest(some) for some in partitions]
    held = read_notes(target, plan, range(plan.partitions))
    todo = [
        p
        for p, notes in enumerate(held)
        if notes is None or (notes.partitions, notes.digest) != (plan.partitions, digests[p]) or _retryable(notes)
    ]
    progress = _DriverProgress(len(items), sum(len(partitions[p]) for p in todo), say)
    notes = [one for one in held if one is not None]
    ended = not todo and plan.finished and plan.contents == contents(notes)
    if not ended:
        # Until the run ends, some shards may still describe an older version of the pictures.
        plan = replace(plan, finished=False, contents=None)
        target.write(PLAN, plan.to_json())
        if todo:
            sources = [_source_partition(p, held) for p in range(plan.partitions)]
            # Write the new shards before the shards they take rows from, so that a kill in between loses nothing.
            phases = [[p for p in todo if sources[p] != p], [p for p in todo if sources[p] == p]]
            rows = [
                [{"partition": p, "source": sources[p], "items": packed(partitions[p])} for p in phase]
                for phase in phases
            ]
            task = PartitionTask(source.where, target.where, plan, model, threads)
            with ray_session(address, workers, threads) as (data, count, put):
                progress.start()
                _hand_out(data, rows, worker, task, put(files), count, progress)
        notes = _checked_notes(target, plan, partitions, digests)
    all_broken = [broken for one in notes for broken in one.broken]
    broken = sorted(all_broken, key=lambda one: one.item.row.file.split("/"))
    _write_broken(target, broken)
    if not ended:
        target.write(PLAN, replace(plan, finished=True, contents=contents(notes)).to_json())
    progress.end()
    return Summary(len(items), progress.computed, broken)


def _hand_out(
    data: Any,
    phases: list[list[dict[str, Any]]],
    worker: type[DescribeWorker],
    task: PartitionTask,
    files: Any,
    count: int,
    progress: _DriverProgress,
) -> None:
    """Run the phases one after the other; raise StoreError if a worker fails."""
    for rows in filter(None, phases):
        handed_out = data.from_items(rows, override_num_blocks=min(len(rows), _MAX_BLOCKS))
        with warnings.catch_warnings():
            # Ray 2.60 warns that `ray_remote_args_fn` is deprecated, but has no replacement that limits retries.
            warnings.simplefilter("ignore")
            results = handed_out.map_batches(
                worker,
                fn_constructor_args=(task, files),
                batch_size=1,
                compute=data.ActorPoolStrategy(size=min(count, len(rows)), max_tasks_in_flight_per_actor=2),
                num_cpus=task.threads,
                ray_remote_args_fn=lambda: {"max_task_retries": _RETRIES},
            )
        for result in results.iter_rows():
            if result["error"]:
                raise StoreError(str(result["error"]))
            progress.add(result)


def _source_partition(partition: int, held: list[ShardMetadata | None]) -> int:
    """Return the partition to copy rows from: the same one, or the partition that it was split off from."""
    size = len(held)
    while held[partition] is None and size % 2 == 0:
        size //= 2
        parent = partition % size
        notes = held[parent]
        if notes is not None and partition % notes.partitions == parent:
            return parent
    return partition


def _plan(target: Storage, wanted: Plan, pictures: int) -> Plan:
    """Return the plan of `target`, with more partitions if this number of pictures needs them."""
    held = Plan.read(target)
    if held is not None and not held.comparable(wanted):
        raise StoreError(
            f"{target.where} holds shards of {held.view} descriptors of model {held.fingerprint} in {held.precision}, "
            f"but this run would write {wanted.view} descriptors of model {wanted.fingerprint} in {wanted.precision}; "
            "choose another place."
        )
    shard = wanted.shard or (held and held.shard) or _PICTURES_PER_SHARD
    least = max(1, -(-pictures // shard))
    if held is None:
        return replace(wanted, partitions=least, shard=shard)
    partitions = held.partitions
    while partitions < least:
        partitions *= 2
    same = (partitions, shard) == (held.partitions, held.shard)
    return replace(held, partitions=partitions, shard=shard, finished=held.finished and same)


def _retryable(notes: ShardMetadata) -> set[ShardItem]:
    """Return the broken pictures that are worth a retry."""
    return {broken.item for broken in notes.broken if not broken.settled}


def _checked_notes(
    target: Storage, plan: Plan, partitions: list[list[ShardItem]], digests: list[str]
) -> list[ShardMetadata]:
    """Read the notes of all shards."""
    notes = [one for one in read_notes(target, plan, range(plan.partitions)) if one is not None]
    if unseen := plan.partitions - len(notes):
        raise StoreError(
            f"{unseen} of {plan.partitions} shards in {target.where} are not visible from this machine; on a cluster give a "
            "folder that all machines share, or object storage."
        )
    for one, items, whole in zip(notes, partitions, digests, strict=True):
        if retryable := _retryable(one):
            whole = digest([item for item in items if item not in retryable])
        if (one.partitions, one.digest) != (plan.partitions, whole) or not retryable <= set(items):
            raise StoreError(
                f"Another run of lpn describe wrote to {target.where} meanwhile; run this again when it has ended."
            )
    return notes


def _write_broken(target: Storage, broken: list[FailedPicture]) -> None:
    rows = [("name", "reason"), *((one.item.row.file, one.reason) for one in broken)]
    target.write(BROKEN, csv_bytes(rows))


class _DriverProgress:
    """Prints lines of progress at intervals."""

    def __init__(self, pictures: int, todo: int, say: Callable[[str], None]) -> None:
        self._pictures, self._done, self._broken, self._say = pictures, pictures - todo, 0, say
        self._started = self._last_line = time.monotonic()
        self.computed = 0
        if self._done:
            say(f"{self._done:,} of {pictures:,} pictures are there already.")

    def start(self) -> None:
        """Start the clock when the workers have started."""
        self._started = self._last_line = time.monotonic()

    def add(self, result: Mapping[str, Any]) -> None:
        self.computed += int(result["computed"])
        self._broken += int(result["broken"])
        self._done += int(result["described"]) + int(result["broken"])
        if time.monotonic() - self._last_line >= _PROGRESS_SECONDS:
            self._line()

    def end(self) -> None:
        if self.computed:
            self._line()

    def _line(self) -> None:
        self._last_line = time.monotonic()
        speed = self.computed / max(self._last_line - self._started, 1e-9)
        broken = f", {self._broken:,} broken" if self._broken else ""
        self._say(f"{self._done:,} of {self._pictures:,} pictures, {speed:.1f} per second{broken}")
