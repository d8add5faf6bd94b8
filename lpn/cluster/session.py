"""A Ray session, quietly started on this machine or joined on a cluster, and always shut down. Needs the extra `cluster`."""

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
# The preface of an HTTP/2 client such as Ray's, and the first frame of both sides, SETTINGS; byte 3 is the frame's type.
_HELLO, _SETTINGS = b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n", b"\0\0\0\4\0\0\0\0\0"
# Size of the object store of a local session: the model's files and lists of names.
_OBJECTS = 512 << 20


@contextmanager
def ray_session(
    address: str | None, workers: int | None, threads: int
) -> Iterator[tuple[Any, int, Callable[[Any], Any]]]:
    """Yield Ray Data, the number of workers, and Ray's `put`; an existing session of this process is used.

    Args:
        address: of a cluster, or "auto"; None starts workers on this machine.
        workers: number of workers; by default as many as fit the cores.
        threads: cores of a worker.

    Raises:
        InputError: when there is no cluster at the address, or none of its machines has enough cores.
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
            # The paths of Ray's sockets have 107 characters at most.
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
            except Exception as error:  # Ray raises plain Exception, too
                message = (str(error).strip().splitlines() or [type(error).__name__])[0]
                raise StoreError(
                    f"Ray does not start on this machine ({message[:200]}); check memory, processes, and space in "
                    f"{parent}, or describe without --engine ray."
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
    """Turn Ray's errors, which are pages long, into one sentence."""
    try:
        yield
    except ray.exceptions.RayError as error:
        # The first exception in the traceback is the worker's own.
        match = re.search(r"^\w+(?:Error|Exception): .+$", str(error), re.MULTILINE)
        cause = match.group() if match else type(error).__name__
        raise StoreError(
            f"The workers failed ({cause[:200]}); what they wrote is kept, so check their memory and disk, and run this again."
        ) from error


def _check_address(address: str) -> None:
    """Check that a Ray server listens at an address; Ray itself would wait for minutes."""
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
    """Discard the messages that Ray's native code prints to stderr at its start."""
    stderr, devnull = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(devnull, 2)
        yield
    finally:
        os.dup2(stderr, 2)
        os.close(stderr)
        os.close(devnull)


def _data() -> Any:
    data: Any = importlib.import_module("ray.data")
    logging.getLogger("ray.data").setLevel(logging.CRITICAL)
    context = data.DataContext.get_current()
    context.enable_progress_bars = False
    context.print_on_execution_start = False
    return data


def _room(ray: Any, threads: int) -> int:
    """Return the number of workers that fit the cores of the cluster's machines."""
    sizes = [int(node["Resources"].get("CPU", 0)) for node in ray.nodes() if node["Alive"]]
    count = sum(size // threads for size in sizes)
    if count < 1:
        raise InputError(f"No machine of the cluster has {threads} cores; give fewer --threads.")
    return count
