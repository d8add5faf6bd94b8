"""Pictures described by Ray's workers (the extra `cluster`), on this machine or on many, into one store.

A worker reads the pictures of a part, describes them as `lpn describe` on one machine does, and writes the part. Pictures and
descriptors never pass through the driver. Ray repeats the part of a killed worker; after a killed driver, the next run describes
the rest. At its end a run names the parts in store.json. Folders may be addresses (`lpn.descriptors.places`).

Broken pictures do not stop a run, unlike on one machine: among millions, some are always broken. They are listed in broken.csv.
"""

from __future__ import annotations

import importlib
import io
import json
import logging
import os
import re
import shutil
import socket
import tempfile
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import InputError, LPNError, PictureError, StoreError
from lpn.core.files import exclusive_lock
from lpn.core.progress import report_progress
from lpn.core.resources import usable_cores
from lpn.core.views import View
from lpn.datasets.integrity import DAMAGED, stream_error
from lpn.descriptors.parallel_inference import describe_each
from lpn.descriptors.places import Storage, first_line
from lpn.descriptors.store import (
    MANIFEST,
    ROWS,
    VECTORS,
    DescriptorKind,
    Manifest,
    PartEntry,
    Precision,
    Row,
    check_replaceable,
    encode,
    entry_of,
    parts_of,
    unwritable,
    vectors_size,
    whole_parts,
    write_part,
)
from lpn.descriptors.transforms import UNCHANGED
from lpn.descriptors.writer import prepare_row
from lpn.models.contract import Role
from lpn.models.onnx_engine import Engine, graph_files
from lpn.models.shipped import model_file

BROKEN = "broken.csv"
# Pictures of a part, which a killed worker loses, and retries of a part whose worker died.
_PICTURES, _RETRIES = 256, 5
_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    "RAY_DATA_DISABLE_PROGRESS_BARS": "1",
}


class Summary(msgspec.Struct):
    """The result of a run.

    Attributes:
        pictures: number of pictures.
        computed: number of pictures that were described by this run.
        broken: the reason of each picture that could not be described, by its name.
    """

    pictures: int
    computed: int = 0
    broken: dict[str, str] = {}


def describe_by_many(
    model: Path,
    pictures: str | Path,
    view: View,
    out: str | Path,
    precision: Precision = "float32",
    address: str | None = None,
    workers: int | None = None,
    threads: int = 1,
    role: Role | None = None,
    size: int = _PICTURES,
    worker: type[DescribeWorker] | None = None,
) -> Summary:
    """Add descriptors of all pictures below a folder or prefix to a store, except those that it has; report the progress.

    Args:
        model: an exported model, `.onnx`; only this machine needs the file.
        pictures, out: folders, or addresses such as s3://bucket/prefix; all machines must see them.
        address: of a Ray cluster, "auto" for this machine's; None starts workers on this machine.
        workers: number of workers; by default the number that the cores allow.
        threads: cores of a worker; each worker has its own copy of the model.
        role: of the branch, see `Model.in_role`.
        size: pictures of a part.
        worker: the worker's class.

    Raises:
        InputError: when an option is invalid, or there is no such cluster.
        DataError: when there are no pictures.
        StoreError: when `out` cannot be written, or holds other descriptors.
    """
    model = model_file(model)
    if model.suffix != ".onnx":
        raise InputError(f"{model.name} is not an exported model, which workers need; make one with lpn export.")
    for name, number in (("workers", workers), ("threads", threads)):
        if number is not None and number < 1:
            raise InputError(f"The number of {name} is {number}; expected 1 or more.")
    kind = DescriptorKind.of_model(Engine(model, threads=1).in_role(view, role), view, UNCHANGED, precision)
    source, target = Storage(pictures), Storage(out)
    rows = source.rows()
    local = None if "://" in target.where else Path(target.where)
    # The end of another run would delete the parts of this one.
    with nullcontext() if local is None else _locked(local):
        entries, missing, number = _held(target, kind, rows)
        summary, there, stage = Summary(len(rows)), len(rows) - len(missing), f"Describing {view} pictures"
        report_progress(stage, there, len(rows))
        if missing:
            tasks = [
                {"number": number + i, "rows": json.dumps(missing[start : start + size])}
                for i, start in enumerate(range(0, len(missing), size))
            ]
            files = {path.name: path.read_bytes() for path in graph_files(model, list(Engine(model).contract.groups))}
            task = WorkerTask(source.where, target.where, kind, model.name, threads)
            with _ray_session(address, workers, threads) as (ray, count):
                for result in _results(ray, worker or DescribeWorker, task, tasks, files, min(count, len(tasks))):
                    if result["error"]:
                        raise StoreError(str(result["error"]))
                    summary.computed += int(result["described"])
                    summary.broken |= json.loads(result["broken"])
                    report_progress(stage, there + summary.computed + len(summary.broken), len(rows))
            entries, missing, _ = _held(target, kind, rows)
        if lost := [row.file for row in missing if row.file not in summary.broken]:
            raise StoreError(
                f"{len(lost)} of {len(rows)} pictures are in no part in {target.where} that this machine sees; on a cluster give "
                "a folder that all machines share, or object storage."
            )
        manifest = Manifest(kind=kind, parts=tuple(entries))
        if local is None:
            target.write(MANIFEST, manifest.encoded())
        else:
            manifest.write(local)
        target.write(BROKEN, csv_bytes([("name", "reason"), *sorted(summary.broken.items())]))
    return summary


@contextmanager
def _locked(folder: Path) -> Iterator[None]:
    """Make a folder, and lock it against other runs; StoreError if it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise unwritable(folder, error) from error
    with exclusive_lock(folder, wait=True):
        yield


def _held(target: Storage, kind: DescriptorKind, rows: Sequence[Row]) -> tuple[list[PartEntry], list[Row], int]:
    """Return the parts in `target` with some of the rows, each row once; the rows in no part; and the next part's number."""
    left, found, number = {row: i for i, row in enumerate(rows)}, [], 1
    with tempfile.TemporaryDirectory(prefix="lpn-") as name, suppress(FileNotFoundError):
        folder = Path(name)
        sizes = target.copy(folder, vectors=False)
        parts = [*whole_parts(folder)]
        with suppress(FileNotFoundError):
            (folder / MANIFEST).write_bytes(target.read(MANIFEST))
            check_replaceable(Manifest.read(folder), parts, kind, target.where)
        number += max((int(part.name.split("-")[1]) for part in parts_of(folder)), default=0)
        for part, notes in parts:
            described = notes.rows() if notes.kind == kind.digest else []
            if sizes.get(f"{part.name}/{VECTORS}") == vectors_size(kind, len(described)):
                places = [left.pop(row, -1) for row in described]
                if max(places, default=-1) >= 0:
                    unused = tuple(i for i, place in enumerate(places) if place < 0)
                    found.append((max(places), msgspec.structs.replace(entry_of(part), replaced=unused)))
    return [entry for _, entry in sorted(found, key=lambda one: one[0])], list(left), number


def _results(
    ray: Any,
    worker: type[DescribeWorker],
    task: WorkerTask,
    tasks: list[dict[str, Any]],
    files: dict[str, bytes],
    count: int,
) -> Iterator[Mapping[str, Any]]:
    """Let workers describe the rows of each task, and yield their results."""
    with warnings.catch_warnings():
        # Ray 2.60 warns that `ray_remote_args_fn` is deprecated, but has no replacement that limits retries.
        warnings.simplefilter("ignore")
        results = ray.data.from_items(tasks, override_num_blocks=min(len(tasks), 4096)).map_batches(
            worker,
            fn_constructor_args=(task, ray.put(files)),
            batch_size=1,
            compute=ray.data.ActorPoolStrategy(size=count, max_tasks_in_flight_per_actor=2),
            num_cpus=task.threads,
            ray_remote_args_fn=lambda: {"max_task_retries": _RETRIES},
        )
    try:
        yield from results.iter_rows()
    except ray.exceptions.RayError as error:
        # Ray's errors are pages long. The first exception in the traceback is the worker's own.
        match = re.search(r"^\w+(?:Error|Exception): .+$", str(error), re.MULTILINE)
        cause = match.group() if match else type(error).__name__
        raise StoreError(
            f"The workers failed ({cause[:200]}); what they wrote is kept, so check their memory and disk, and run this again."
        ) from error


@dataclass(frozen=True)
class WorkerTask:
    """The settings of all workers: addresses of pictures and store, kind, name of the model's first file, cores of a worker."""

    images: str
    out: str
    kind: DescriptorKind
    model: str
    threads: int


class DescribeWorker:
    """Describes pictures with one loaded model.

    Args:
        task: the settings of all workers.
        files: Ray's reference to the contents of the model's files by name, so that other machines need no copy.
    """

    def __init__(self, task: WorkerTask, files: Any) -> None:
        import cv2
        import ray

        cv2.setNumThreads(1)
        self.task, self.images, self.out = task, Storage(task.images), Storage(task.out)
        self.view = cast(View, task.kind.view)
        with tempfile.TemporaryDirectory(prefix="lpn-") as folder:
            for name, data in ray.get(files).items():
                Path(folder, name).write_bytes(data)
            self.model = Engine(Path(folder, task.model), threads=1).in_role(self.view, task.kind.role)

    def __call__(self, batch: Mapping[str, Any]) -> dict[str, list[Any]]:
        """Describe the pictures of Ray Data's batch of one row; the result is one row, with an error as a sentence."""
        rows = msgspec.convert(json.loads(str(batch["rows"][0])), list[Row])
        try:
            described, broken = self.describe(int(batch["number"][0]), rows)
        except LPNError as error:
            return {"described": [0], "broken": ["{}"], "error": [str(error)]}
        return {"described": [described], "broken": [json.dumps(broken)], "error": [""]}

    def describe(self, number: int, rows: list[Row]) -> tuple[int, dict[str, str]]:
        """Write a part of some pictures; return the number of described ones, and the reasons of broken ones."""
        kind, found, broken = self.task.kind, dict[int, Float32Array](), dict[str, str]()
        for some in describe_each(self.model, rows, self._prepare, self.view, self.task.threads + 1):
            found |= zip(some.items, some.descriptors, strict=True)
            broken |= {rows[i].file: str(error) for i, error in some.broken}
        if found:
            order = sorted(found)
            vectors = encode(np.array([found[i] for i in order], np.float32), kind.precision)
            with tempfile.TemporaryDirectory(prefix="lpn-") as folder:
                entry = write_part(Path(folder), kind, [rows[i] for i in order], [vectors], number=number)
                for name in (VECTORS, ROWS):
                    self.out.write(f"{entry.name}/{name}", Path(folder, entry.name, name).read_bytes())
        return len(found), broken

    def _prepare(self, row: Row) -> Float32Array:
        try:
            data = self.images.read(row.file)
        except OSError as error:
            raise PictureError(f"cannot be read ({first_line(error)})") from error
        if (flaw := stream_error(io.BytesIO(data))) is not None:
            raise PictureError(flaw)
        try:
            return prepare_row(self.model, images.decode_picture(data, row.file), row, UNCHANGED, self.view)
        except PictureError as error:
            raise PictureError(DAMAGED) from error


@contextmanager
def _ray_session(address: str | None, workers: int | None, threads: int) -> Iterator[tuple[Any, int]]:
    """Yield Ray, started on this machine or joined on a cluster, and the number of workers; a session in progress is used."""
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    ray: Any = importlib.import_module("ray")
    importlib.import_module("ray.data")
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    context = ray.data.DataContext.get_current()
    context.enable_progress_bars = context.print_on_execution_start = False
    if ray.is_initialized():
        yield ray, workers or _room(ray, threads)
        return
    options: dict[str, Any] = {"logging_level": logging.ERROR, "log_to_driver": False}
    # The paths of Ray's sockets have 107 characters at most.
    folder = tempfile.mkdtemp(prefix="lpn-ray-", dir="/tmp" if Path("/tmp").is_dir() else None)
    try:
        if address is None:
            count = (workers or max(1, usable_cores() // threads)) * threads
            options |= {
                "num_cpus": count,
                "include_dashboard": False,
                "object_store_memory": 512 << 20,
                "_temp_dir": folder,
            }
        try:
            host, _, port = (address or "").rpartition(":")
            if port.isdecimal():
                socket.create_connection((host, int(port)), timeout=10).close()  # Ray itself would wait for minutes
            with _silent():
                ray.init(address=address or "local", **options)
        except Exception as error:  # Ray raises plain Exception, too
            if address is not None:
                raise InputError(
                    f"There is no Ray cluster at {address}; start one with ray start, or check the address."
                ) from error
            raise StoreError(
                f"Ray does not start on this machine ({first_line(error)[:200]}); check memory, processes, and space in "
                f"{Path(folder).parent}, or describe without --engine ray."
            ) from error
        yield ray, workers or _room(ray, threads)
    finally:
        ray.shutdown()
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def _silent() -> Iterator[None]:
    """Discard the messages that Ray's native code prints to stderr at its start."""
    stderr, devnull = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(devnull, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(devnull)


def _room(ray: Any, threads: int) -> int:
    """Return the number of workers that fit the cores of the cluster's machines."""
    count = sum(int(node["Resources"].get("CPU", 0)) // threads for node in ray.nodes() if node["Alive"])
    if count < 1:
        raise InputError(f"No machine of the cluster has {threads} cores; give fewer --threads.")
    return count
