"""Ray, started quietly on this machine or joined where a cluster runs, and shut down whatever happens. Needs the extra `ray`."""

from __future__ import annotations

import importlib
import logging
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from lpn.errors import InputError
from lpn.streams import cores

_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    "RAY_DATA_DISABLE_PROGRESS_BARS": "1",
}
_OBJECTS = 512 << 20
"""Bytes of the store that workers on one machine share: the model's files and lists of names."""


@contextmanager
def started(address: str | None, workers: int | None, threads: int) -> Iterator[tuple[Any, int, Callable[[Any], Any]]]:
    """Ray Data, how many workers there are to be, and Ray's `put`; what runs already in this process is used as it is.

    Args:
        address: of a cluster, or "auto"; None starts workers on this machine.
        workers: how many; by default as many as there are cores for.
        threads: cores of one worker.

    Raises:
        InputError: when there is no cluster at the address, or none of its machines has so many cores.
    """
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    ray: Any = importlib.import_module("ray")
    if ray.is_initialized():
        yield _data(), workers or _room(ray, threads), ray.put
        return
    # Sockets lie in it, whose paths may have 107 characters.
    short = Path("/tmp") if Path("/tmp").is_dir() else None
    folder = tempfile.mkdtemp(prefix="lpn-ray-", dir=short) if address is None else None
    quiet = {"logging_level": logging.ERROR, "log_to_driver": False}
    try:
        if address is None:
            count = workers or max(1, cores() // threads)
            ray.init(
                address="local",
                num_cpus=count * threads,
                include_dashboard=False,
                object_store_memory=_OBJECTS,
                _temp_dir=folder,
                **quiet,
            )
        else:
            try:
                ray.init(address=address, **quiet)
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise InputError(
                    f"There is no Ray cluster at {address}; start one with ray start, or check it."
                ) from error
            count = workers or _room(ray, threads)
        yield _data(), count, ray.put
    finally:
        ray.shutdown()
        if folder is not None:
            shutil.rmtree(folder, ignore_errors=True)


def _data() -> Any:
    data: Any = importlib.import_module("ray.data")
    logging.getLogger("ray.data").setLevel(logging.ERROR)
    context = data.DataContext.get_current()
    context.enable_progress_bars = False
    context.print_on_execution_start = False
    return data


def _room(ray: Any, threads: int) -> int:
    """How many workers the cluster's machines have cores for."""
    sizes = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
    count = sum(size // threads for size in sizes)
    if count < 1:
        raise InputError(f"No machine of the cluster has {threads} cores; give fewer --threads.")
    return count
