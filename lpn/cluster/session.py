"""Ray, started quietly on this machine or joined where a cluster runs, and shut down whatever happens. Needs the extra `ray`."""

from __future__ import annotations

import importlib
import logging
import os
import re
import socket
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

from lpn.core.errors import InputError, StoreError
from lpn.core.resources import usable_cores

_QUIET = {
    "RAY_USAGE_STATS_ENABLED": "0",
    "RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO": "0",
    "RAY_BACKEND_LOG_LEVEL": "fatal",
    "RAY_DATA_DISABLE_PROGRESS_BARS": "1",
}
_NO_CLUSTER = "There is no Ray cluster at {}; start one with ray start, or check the address."
_HELLO, _SETTINGS = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"\0\0\0\4\0\0\0\0\0"
"""What an HTTP/2 client, such as Ray's, begins with; and the frame that both sides begin with, its kind being the fourth byte."""
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
        StoreError: when Ray does not start on this machine, or gives up in the body.
    """
    for name, value in _QUIET.items():
        os.environ.setdefault(name, value)
    ray: Any = importlib.import_module("ray")
    if ray.is_initialized():
        with _in_words(ray):
            yield _data(), workers or _room(ray, threads), ray.put
        return
    quiet = {"logging_level": logging.ERROR, "log_to_driver": False}
    with ExitStack() as ending:
        if address is None:
            count = workers or max(1, usable_cores() // threads)
            # The paths of Ray's sockets may have 107 characters at most.
            parent = "/tmp" if Path("/tmp").is_dir() else tempfile.gettempdir()
            folder = ending.enter_context(
                tempfile.TemporaryDirectory(prefix="lpn-ray-", dir=parent, ignore_cleanup_errors=True)
            )
            ending.callback(ray.shutdown)
            try:
                with _silent():
                    ray.init(
                        address="local",
                        num_cpus=count * threads,
                        include_dashboard=False,
                        object_store_memory=_OBJECTS,
                        _temp_dir=folder,
                        **quiet,
                    )
            except Exception as error:  # Ray raises plain ones, too
                said = (str(error).strip().splitlines() or [type(error).__name__])[0]
                raise StoreError(
                    f"Ray does not start on this machine ({said[:200]}); see whether there are memory, processes, and room in "
                    f"{parent} enough, or describe without --engine ray."
                ) from error
        else:
            ending.callback(ray.shutdown)
            _check_address(address)
            try:
                with _silent():
                    ray.init(address=address, **quiet)
            except (OSError, ValueError, RuntimeError) as error:
                raise InputError(_NO_CLUSTER.format(address)) from error
            count = workers or _room(ray, threads)
        with _in_words(ray):
            yield _data(), count, ray.put


@contextmanager
def _in_words(ray: Any) -> Iterator[None]:
    """What makes Ray give up, as one sentence; its own are pages."""
    try:
        yield
    except ray.exceptions.RayError as error:
        # The first exception in the traceback that it carries is the worker's own.
        found = re.search(r"^\w+(?:Error|Exception): .+$", str(error), re.MULTILINE)
        cause = found.group() if found else type(error).__name__
        raise StoreError(
            f"The workers failed ({cause[:200]}); what they wrote is kept, so see whether they have memory and disk enough, and "
            "run this again."
        ) from error


def _check_address(address: str) -> None:
    """Ray itself waits for minutes for a machine that is not there, and for a server that is not Ray's."""
    host, colon, port = address.rpartition(":")
    if colon and port.isdecimal() and "/" not in host:
        try:
            with socket.create_connection((host, int(port)), timeout=10) as connection:
                answer = _SETTINGS
                if os.environ.get("RAY_USE_TLS", "0") == "0":
                    connection.sendall(_HELLO + _SETTINGS)
                    answer = connection.makefile("rb").read(len(_SETTINGS))
        except (OSError, OverflowError) as error:
            raise InputError(_NO_CLUSTER.format(address)) from error
        if answer[3:4] != _SETTINGS[3:4]:
            raise InputError(_NO_CLUSTER.format(address))


@contextmanager
def _silent() -> Iterator[None]:
    """What Ray's native code says on stderr while it starts, such as how much it is going to say, is not said."""
    kept, nothing = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nothing, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nothing)


def _data() -> Any:
    data: Any = importlib.import_module("ray.data")
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
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
