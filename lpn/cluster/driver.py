"""The driver of distributed inference: Ray Data hands pictures to workers, which write parts (`lpn.cluster.parts`).

A worker reads the pictures of a part, describes them like `lpn describe` on one machine, and writes the part. Driver and
workers exchange names and counts only. If a worker is killed, another worker repeats its part. If the driver is killed, the
next run describes the missing, added, and changed pictures. At its end, a run rewrites parts that hold deleted pictures.

A run first marks the plan as unfinished. Two concurrent runs into one folder are refused. In object storage, a reader
refuses parts that do not belong to the last completed run.

Broken pictures do not stop a run, unlike on one machine: among millions, some are always broken. They are listed in
`broken.csv`, recorded in the parts, and counted at the end.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lpn.cluster.parts import (
    BROKEN,
    PLAN,
    FailedPicture,
    PartContents,
    PartItem,
    PartPrecision,
    Plan,
    contents_of,
    each,
    packed,
    part_names,
    read_part,
    read_vectors,
    write_part,
)
from lpn.cluster.session import ray_session
from lpn.cluster.storage import Storage
from lpn.cluster.worker import DescribeWorker, WorkerTask
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
# Retries of a part whose worker died. They are limited because its pictures may kill workers.
_RETRIES = 5
# Default number of pictures of a part.
_PICTURES = 256
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


def describe_parts(
    model: Path,
    pictures: str | Path,
    view: View,
    out: str | Path,
    precision: PartPrecision = "float32",
    address: str | None = None,
    workers: int | None = None,
    threads: int = 1,
    size: int | None = None,
    positions: str | Path | None = None,
    say: Callable[[str], None] = print,
    worker: type[DescribeWorker] = DescribeWorker,
    role: Role | None = None,
) -> Summary:
    """Describe all pictures below a folder or prefix into parts, except for those that are there already.

    Args:
        model: an exported model, `.onnx`; only this machine needs the file.
        pictures: a folder, or a URI such as s3://bucket/prefix; all machines of a cluster must see it.
        view: the view of the pictures.
        out: folder or URI of the parts; all machines must see it, too.
        precision: of the numbers in the parts.
        address: of a Ray cluster, "auto" for this machine's; None starts workers on this machine.
        workers: number of workers; by default as many as fit the cores.
        threads: cores of a worker; each worker has its own copy of the model.
        size: maximum of pictures of a part, 256 by default; a killed worker loses one part of work.
        positions: a file in the format of geo.csv; by default the `geo.csv` among the pictures. For how its paths are
            matched to the pictures, see `lpn.datasets.geo.Positions.match`.
        say: called with each line of progress.
        worker: the worker's class.
        role: of the branch, see `Model.in_role`.

    Raises:
        InputError: when an option is invalid, there is no such cluster, or `positions` match the pictures ambiguously.
        DataError: when there are no pictures, or some have no position.
        StoreError: when `out` cannot be written, or holds descriptors of another model, view, or precision.
    """
    model = model_file(model)
    if model.suffix != ".onnx":
        raise InputError(f"{model.name} is not an exported model, which workers need; make one with lpn export.")
    for name, number in (("workers", workers), ("threads", threads), ("pictures of a part", size)):
        if number is not None and number < 1:
            raise InputError(f"The number of {name} is {number}; expected 1 or more.")
    engine = Engine(model, threads=1).in_role(view, role)
    source, target = Storage(pictures), Storage(out)
    items = _items(source, positions)
    role = engine.role(view) if engine.contract.roles == "role" else None
    wanted = Plan(engine.fingerprint, view, engine.n_parts, engine.embedding, precision, role)
    files = {path.name: path.read_bytes() for path in graph_files(model, list(engine.contract.groups))}
    del engine
    if target.folder is None:
        return _run(
            source, target, items, wanted, files, model.name, address, workers, threads, size or _PICTURES, say, worker
        )
    try:
        target.folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise StoreError(
            f"{target.where} cannot be written ({error.strerror or error}); choose another folder."
        ) from error
    with exclusive_lock(target.folder, wait=False):
        return _run(
            source, target, items, wanted, files, model.name, address, workers, threads, size or _PICTURES, say, worker
        )


def _items(source: Storage, positions: str | Path | None) -> list[PartItem]:
    rows = source.files(images.SUFFIXES)
    if not rows:
        raise DataError(f"{source.where} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
    listed = _positions(source, positions)
    if listed is None:
        return [PartItem(row) for row in rows]
    names, source_name = [row.file for row in rows], str(positions or geo.NAME)
    folder = source.folder or Path()
    if positions is not None:
        matched = zip(names, geo.Positions(folder, listed, source_name).match(names), strict=True)
        listed = {name: place for name, place in matched if place is not None}
    places = geo.Positions(folder, listed, source_name).below(names)
    return [PartItem(row, (at.latitude, at.longitude)) for row, at in zip(rows, places, strict=True)]


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
    items: list[PartItem],
    wanted: Plan,
    files: dict[str, bytes],
    model: str,
    address: str | None,
    workers: int | None,
    threads: int,
    size: int,
    say: Callable[[str], None],
    worker: type[DescribeWorker],
) -> Summary:
    plan = _plan(target, wanted)
    held = _Held.read(target, plan, items)
    progress = _DriverProgress(len(items), len(held.missing), say)
    if held.missing or held.stale or contents_of(held.names) != plan.contents:
        plan = replace(plan, contents=None)  # until the run ends, parts may hold older states of the pictures
        target.write(PLAN, plan.to_json())
        rows = [{"items": packed(held.missing[i : i + size])} for i in range(0, len(held.missing), size)]
        if rows:
            task = WorkerTask(source.where, target.where, plan, model, threads)
            with ray_session(address, workers, threads) as (data, count, put):
                progress.start()
                _hand_out(data, rows, worker, task, put(files), count, progress)
            held = _Held.read(target, plan, items, retry=False)
        if held.missing:
            raise StoreError(
                f"{len(held.missing)} of {len(items)} pictures are in no part in {target.where} that this machine sees; on a "
                "cluster give a folder that all machines share, or object storage."
            )
        held = held.cleaned(target, plan)
        target.write(PLAN, replace(plan, contents=contents_of(held.names)).to_json())
    broken = sorted(held.broken, key=lambda one: one.item.row.file.split("/"))
    target.write(BROKEN, csv_bytes([("name", "reason"), *((one.item.row.file, one.reason) for one in broken)]))
    progress.end()
    return Summary(len(items), progress.computed, broken)


def _hand_out(
    data: Any,
    rows: list[dict[str, Any]],
    worker: type[DescribeWorker],
    task: WorkerTask,
    files: Any,
    count: int,
    progress: _DriverProgress,
) -> None:
    """Let workers describe the pictures of each row; raise StoreError if one fails."""
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


@dataclass(frozen=True)
class _Held:
    """The existing parts of a place, compared with the wanted pictures.

    Attributes:
        names: of all parts, damaged ones included.
        kept: the pictures to keep of each readable part; each picture is kept in one part only.
        stale: parts that hold anything else.
        missing: wanted pictures that are in no part.
    """

    names: list[str]
    kept: list[tuple[PartContents, list[PartItem | None], list[FailedPicture]]]
    stale: list[str]
    missing: list[PartItem]

    @classmethod
    def read(cls, target: Storage, plan: Plan, items: list[PartItem], retry: bool = True) -> _Held:
        """Read the notes of all parts; with `retry`, pictures that could not be read count as missing."""
        names = part_names(target)
        left = {item.row: item for item in items}
        parts = [part for part in each(lambda name: read_part(target, plan, name), names) if part is not None]
        described = [[left.pop(one.row, None) for one in part.items] for part in parts]
        kept = []
        for part, found in zip(
            parts, described, strict=True
        ):  # another part may hold a picture that this one failed to describe
            settled = [one for one in part.broken if one.settled or not retry]
            broken = [one._replace(item=item) for one in settled if (item := left.pop(one.item.row, None)) is not None]
            kept.append((part, found, broken))
        whole = {part.name for part, found, broken in kept if found == part.items and broken == part.broken}
        return cls(names, kept, [name for name in names if name not in whole], list(left.values()))

    @property
    def broken(self) -> list[FailedPicture]:
        return [one for _, _, broken in self.kept for one in broken]

    def cleaned(self, target: Storage, plan: Plan) -> _Held:
        """Rewrite stale parts with their kept pictures, and delete the old ones."""
        names = [name for name in self.names if name not in self.stale]
        for part, found, broken in self.kept:
            if part.name in self.stale:
                some = [i for i, item in enumerate(found) if item is not None]
                if some or broken:
                    vectors = read_vectors(target, plan, part)[some]
                    names.append(
                        write_part(target, plan, [item for item in found if item is not None], vectors, broken)
                    )
        for name in set(self.stale) - set(names):
            target.delete(name)
        return replace(self, names=names, stale=[])


def _plan(target: Storage, wanted: Plan) -> Plan:
    """Return the plan of `target`; StoreError if it holds other descriptors."""
    held = Plan.read(target)
    if held is not None and held != wanted:
        raise StoreError(
            f"{target.where} holds {held.view} descriptors of model {held.fingerprint} in {held.precision}, but this run would "
            f"write {wanted.view} descriptors of model {wanted.fingerprint} in {wanted.precision}; choose another place."
        )
    if held is None:
        target.write(PLAN, wanted.to_json())  # creates the place
    return held or wanted


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
        self.computed += int(result["described"])
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
