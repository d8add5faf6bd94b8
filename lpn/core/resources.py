"""The cores and ports that this process can use, and the return of freed memory."""

from __future__ import annotations

import ctypes
import errno
import math
import os
import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from ipaddress import ip_address
from pathlib import Path
from typing import Any

# "auto" (a GPU if one works, else the CPU), "cpu", "cuda", or another execution provider of ONNX Runtime: "coreml" is its
# CoreMLExecutionProvider.
ProviderName = str
PROVIDER_ENDING = "ExecutionProvider"
# Devices whose descriptors agree to 1e-4: both compute in float32.
FLOAT32_DEVICES = ("cpu", "cuda")
# A remedy in messages. It names the variable too, because some commands have no --provider, see `resolve_provider`.
COMPUTE_ON_CPU = "compute on the CPU (--provider cpu, or LPN_PROVIDER=cpu)"

_CGROUPS, _OWN_CGROUP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")
# Options of mallopt in <malloc.h>: at most two arenas (M_ARENA_MAX); arrays from 4 MiB on are mapped (M_MMAP_THRESHOLD), since
# mapping smaller ones would cost a page fault for each 4 kB; 8 MiB at the end of an arena may stay unused (M_TRIM_THRESHOLD).
_MALLOC_OPTIONS = {-8: 2, -3: 1 << 22, -1: 1 << 23}
# Niceness of a yielding thread: it gets a tenth of a core that another thread wants.
_YIELDING = 10


def resolve_provider(provider: ProviderName) -> ProviderName:
    """Return a provider's short name in lower case; LPN_PROVIDER, if set, replaces "auto"."""
    chosen = (os.environ.get("LPN_PROVIDER") if provider == "auto" else None) or provider
    return chosen.lower().removesuffix(PROVIDER_ENDING.lower())


def usable_cores() -> int:
    """Return the number of cores available to this process, within its CPU affinity and its container's quota."""
    affinity = getattr(os, "sched_getaffinity", None)  # missing on some systems
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    for group in _cgroups():
        try:
            quota, period = (int(value) for value in (group / "cpu.max").read_text().split())
            cores = min(cores, max(math.ceil(quota / period), 1))
        except (OSError, ValueError, ZeroDivisionError):  # "max" means no limit
            continue
    return cores


def _cgroups() -> list[Path]:
    """Return this process's control group (version 2) and its ancestors."""
    try:
        own = next(line[3:] for line in _OWN_CGROUP.read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        return []
    names = [name for name in own.split("/") if name not in ("", "..")]  # ".." leads out of a container
    return [_CGROUPS.joinpath(*names[:depth]) for depth in range(len(names) + 1)]


def yield_cores() -> None:
    """Let this thread, and those that it starts, yield to the other threads of this process; has an effect on Linux only."""
    if sys.platform.startswith("linux"):
        thread = threading.get_native_id()
        with suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, min(os.getpriority(os.PRIO_PROCESS, thread) + _YIELDING, 19))


@contextmanager
def one_thread_a_library() -> Iterator[bool]:
    """Let NumPy's and PyTorch's libraries compute with one thread each, unless OMP_NUM_THREADS is set.

    After short computations their threads spin for a while, and take cores from the library that computes next. PyTorch keeps the
    limit afterwards if it is loaded in the context.

    Yields:
        False if NumPy's threads cannot be limited because threadpoolctl is not installed, else True.
    """
    if os.environ.get("OMP_NUM_THREADS"):
        yield True
        return
    torch = sys.modules.get("torch")
    threads = None if torch is None else torch.get_num_threads()
    try:
        from threadpoolctl import threadpool_limits

        limits: AbstractContextManager[object] = threadpool_limits(1)
        limited = True
    except ModuleNotFoundError:
        limits, limited = nullcontext(), False
    os.environ["OMP_NUM_THREADS"] = "1"  # for libraries that are loaded later
    try:
        with limits:
            if torch is not None:
                torch.set_num_threads(1)
            yield limited
    finally:
        del os.environ["OMP_NUM_THREADS"]
        if torch is not None:
            torch.set_num_threads(threads)


def limit_malloc_arenas() -> bool:
    """Limit glibc's memory arenas, for a long-running process with many threads; return whether that is possible.

    By default glibc creates an arena for each of many threads and places arrays between small, long-lived objects, so
    much of the freed memory stays with the process. See also `return_memory`.
    """
    mallopt = _glibc_function("mallopt")
    return mallopt is not None and all(mallopt(option, value) for option, value in _MALLOC_OPTIONS.items())


def return_memory() -> bool:
    """Return freed memory to the system, which takes some milliseconds; False without glibc."""
    trim = _glibc_function("malloc_trim")
    return trim is not None and bool(trim(0))


def _glibc_function(name: str) -> Any:
    if not sys.platform.startswith("linux"):
        return None
    try:
        return getattr(ctypes.CDLL(None), name)
    except (OSError, AttributeError):  # another C library
        return None


def port_error(host: str, port: int) -> str | None:
    """Return the reason why a port cannot be listened on, as a sentence without its full stop; None if it can."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        used = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        return f"Port {port} on {host} is in use" if used else f"Port {port} on {host} cannot be listened on ({error})"
    return None


def is_loopback(host: str) -> bool:
    """Return whether only this machine can reach a listening address."""
    if host.lower() == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return False
