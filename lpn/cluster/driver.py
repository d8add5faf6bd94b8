"""The driver of distributed inference: Ray Data hands pictures to workers, and their descriptors go into a store.

The store is that of `lpn.descriptors.describe` for the same pictures, which either can continue. A worker reads and describes
some pictures; if it is killed, another one does them. What the driver was given is in the store's log, so that a killed driver
is resumed by the next run.

Broken pictures do not stop a run, unlike on one machine: among millions there are always some. They are left out of the store
and listed in its `broken.csv`, and the next run tries them again.
"""

from __future__ import annotations

import json
import warnings
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lpn.cluster.session import ray_session
from lpn.cluster.storage import Storage
from lpn.cluster.worker import DescribeWorker, WorkerTask
from lpn.core import images
from lpn.core.csv_cells import csv_bytes
from lpn.core.errors import DataError, InputError
from lpn.core.files import write_atomic
from lpn.core.progress import report_progress
from lpn.core.views import View
from lpn.descriptors.partial_store import PartialStore
from lpn.descriptors.store import Manifest, Precision
from lpn.descriptors.transforms import UNCHANGED
from lpn.descriptors.writer import write_store
from lpn.models.contract import Role
from lpn.models.onnx_engine import Engine, graph_files
from lpn.models.shipped import model_file

BROKEN = "broken.csv"
# Retries of a list of pictures whose worker died. They are limited because a picture may kill workers.
_RETRIES = 5
# Pictures that a worker is handed at once by default; a killed worker loses them.
_PICTURES = 256
# Maximum number of Ray Data blocks.
_MAX_BLOCKS = 4096


@dataclass(frozen=True)
class Summary:
    """The result of a run.

    Attributes:
        pictures: number of pictures.
        computed: number of pictures that were described by this run.
        broken: why a picture could not be described, such as "is damaged", by its name.
    """

    pictures: int
    computed: int
    broken: dict[str, str]


class _BrokenError(Exception):
    """Pictures without descriptors remain; all others are in the store's log."""


def describe_on_workers(
    model: Path,
    pictures: str | Path,
    view: View,
    out: Path,
    precision: Precision = "float32",
    address: str | None = None,
    workers: int | None = None,
    threads: int = 1,
    size: int | None = None,
    role: Role | None = None,
    worker: type[DescribeWorker] = DescribeWorker,
) -> Summary:
    """Describe all pictures below a folder or prefix into a store, skipping those that it holds already.

    It reports its progress (`lpn.core.progress`).

    Args:
        model: an exported model, `.onnx`; only this machine needs the file.
        pictures: a folder, or a URI such as s3://bucket/prefix; all machines of a cluster must see it.
        view: the view of the pictures.
        out: folder of the store, on this machine.
        precision: of the numbers in the store.
        address: of a Ray cluster, "auto" for the one of this machine; None starts workers on this machine.
        workers: number of workers; by default as many as fit the cores.
        threads: cores of a worker; each worker has its own copy of the model.
        size: pictures that a worker is handed at once, 256 by default.
        role: of the branch, see `Model.in_role`.
        worker: the worker's class.

    Raises:
        InputError: when an option is invalid, or there is no such cluster.
        DataError: when there are no pictures, or none that can be described.
        StoreError: when the workers fail, or `out` cannot be written or holds other descriptors.
    """
    model = model_file(model)
    if model.suffix != ".onnx":
        raise InputError(f"{model.name} is not an exported model, which workers need; make one with lpn export.")
    for name, number in (("workers", workers), ("threads", threads), ("pictures of a part", size)):
        if number is not None and number < 1:
            raise InputError(f"The number of {name} is {number}; expected 1 or more.")
    engine = Engine(model, threads=1).in_role(view, role)
    source = Storage(pictures)
    rows = tuple(source.files(images.SUFFIXES))
    if not rows:
        raise DataError(f"{source.where} holds no pictures; expected files ending in {', '.join(images.SUFFIXES)}.")
    manifest = Manifest.for_model(engine, view, UNCHANGED, rows, precision)
    files = {path.name: path.read_bytes() for path in graph_files(model, list(engine.contract.groups))}
    broken: dict[int, str] = {}
    computed = 0

    def fill(store: PartialStore) -> None:
        nonlocal computed
        missing = np.flatnonzero(~store.good)
        lists = np.split(missing, range(size or _PICTURES, len(missing), size or _PICTURES))
        given = [{"start": i, "names": json.dumps([rows[j].file for j in some])} for i, some in enumerate(lists)]
        task = WorkerTask(source.where, model.name, view, role, threads)
        done = len(rows) - len(missing)
        report_progress(f"Describing {view} pictures", done, len(rows))
        with ray_session(address, workers, threads) as (data, count, put):
            for result in _results(data, given, worker, task, put(files), count):
                some = lists[result["start"]]
                described = np.frombuffer(result["described"], np.float32)
                reasons = {int(i): reason for i, reason in json.loads(result["broken"]).items()}
                good = [i for i in range(len(some)) if i not in reasons]
                store.put(some[good].tolist(), described.reshape(len(some), engine.n_parts, engine.embedding)[good])
                broken.update({int(some[i]): reason for i, reason in reasons.items()})
                computed, done = computed + len(good), done + len(some)
                report_progress(f"Describing {view} pictures", done, len(rows))
        if broken:
            raise _BrokenError

    with suppress(_BrokenError):
        write_store(out, manifest, fill)
    if len(broken) == len(rows):
        raise DataError(
            f"None of {len(rows)} pictures in {source.where} can be described; the first, {rows[0].file}, {broken[0]}."
        )
    reasons = {rows[i].file: broken[i] for i in sorted(broken)}
    if broken:
        whole = tuple(row for i, row in enumerate(rows) if i not in broken)
        write_store(out, replace(manifest, rows=whole), lambda _: None)
        write_atomic(out / BROKEN, csv_bytes([("name", "reason"), *reasons.items()]))
    else:
        (out / BROKEN).unlink(missing_ok=True)
    return Summary(len(rows), computed, reasons)


def _results(
    data: Any, given: list[dict[str, Any]], worker: type[DescribeWorker], task: WorkerTask, files: Any, count: int
) -> Iterator[dict[str, Any]]:
    """Let workers describe the pictures of each row, and yield their rows as they come."""
    with warnings.catch_warnings():
        # Ray 2.60 warns that `ray_remote_args_fn` is deprecated, but has no replacement that limits retries.
        warnings.simplefilter("ignore")
        results = data.from_items(given, override_num_blocks=min(len(given), _MAX_BLOCKS)).map_batches(
            worker,
            fn_constructor_args=(task, files),
            batch_size=1,
            compute=data.ActorPoolStrategy(size=min(count, len(given)), max_tasks_in_flight_per_actor=2),
            num_cpus=task.threads,
            ray_remote_args_fn=lambda: {"max_task_retries": _RETRIES},
        )
    yield from results.iter_rows()
