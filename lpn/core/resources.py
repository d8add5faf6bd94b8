"""What this process may use of the machine: cores, memory, ports."""

from __future__ import annotations

import ctypes
import errno
import math
import os
import socket
import sys
from pathlib import Path
from typing import Any


def usable_cores() -> int:
    """Cores that this process may use: fewer than the machine has where it is confined to some, or to so much time of them, as
    in a container or a job."""
    confined = getattr(os, "sched_getaffinity", None)  # not on every system
    cores = len(confined(0)) if confined else os.cpu_count() or 1
    for group in _groups():
        try:
            quota, period = (int(value) for value in (group / "cpu.max").read_text().split())
            cores = min(cores, max(math.ceil(quota / period), 1))
        except (OSError, ValueError, ZeroDivisionError):  # "max", which is no limit
            continue
    return cores


def memory() -> tuple[int, int] | None:
    """Bytes of memory that this process may use, and that are free of it by now; None where the system does not say.

    What is kept of files that were read is free, as the system drops it for whoever needs room.
    """
    try:
        told = dict(line.split(":", 1) for line in Path("/proc/meminfo").read_text().splitlines())
        total, free = (int(told[name].split()[0]) * 1024 for name in ("MemTotal", "MemAvailable"))
    except (OSError, ValueError, KeyError, IndexError):
        return None
    for group in _groups():  # a container's, or a job's
        try:
            most, used = (int((group / name).read_text()) for name in ("memory.max", "memory.current"))
            told = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
            kept = sum(int(told[name]) for name in ("active_file", "inactive_file"))
        except (OSError, ValueError, KeyError):  # "max", which is no limit
            continue
        total, free = min(total, most), min(free, max(most - used + kept, 0))
    return total, free


_GROUPS, _OWN = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def _groups() -> list[Path]:
    """This process's control group of version 2, and those that it is within."""
    try:
        own = next(line[3:] for line in _OWN.read_text().splitlines() if line.startswith("0::"))
    except (OSError, StopIteration):
        return []
    names = [name for name in own.split("/") if name not in ("", "..")]  # "..": of a group outside a container
    return [_GROUPS.joinpath(*names[:depth]) for depth in range(len(names) + 1)]


def pool_memory() -> bool:
    """Have memory taken from few pools, for a process that runs for long and has many threads.

    glibc otherwise makes a pool for each of many threads, and, once a few large arrays were freed, takes further ones from these
    pools, between smaller things that live on: much of what is freed then stays with the process. See `return_memory`.

    Returns:
        Whether that could be asked for, which is with glibc alone.
    """
    tell = _of_glibc("mallopt")
    return tell is not None and all(tell(option, value) for option, value in _POOLS.items())


_POOLS = {-8: 2, -3: 1 << 22, -1: 1 << 23}
"""Of <malloc.h>: pools at most (M_ARENA_MAX); bytes from which an array has memory of its own (M_MMAP_THRESHOLD), smaller ones
would cost a page fault for each 4 kB; bytes at the end of a pool that may stay unused (M_TRIM_THRESHOLD)."""


def return_memory() -> bool:
    """Give what was freed back to the system, where that can be asked for; some milliseconds."""
    trim = _of_glibc("malloc_trim")
    return trim is not None and bool(trim(0))


def _of_glibc(name: str) -> Any:
    if not sys.platform.startswith("linux"):
        return None
    try:
        return getattr(ctypes.CDLL(None), name)
    except (OSError, AttributeError):  # another C library
        return None


def port_taken(host: str, port: int) -> str | None:
    """Why a port cannot be listened on, as a sentence without its end; None when it can."""
    try:
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        with socket.socket(family, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind((host, port))
    except (OSError, OverflowError) as error:
        used = isinstance(error, OSError) and error.errno == errno.EADDRINUSE
        return f"Port {port} on {host} is in use" if used else f"Port {port} on {host} cannot be listened on ({error})"
    return None
