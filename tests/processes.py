"""Commands in processes of their own that are asked to stop, as a terminal (Ctrl-C) or a service manager (SIGTERM) asks."""

from __future__ import annotations

import os
import random
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Self

SOON = 10.0
"""Seconds that a process which was asked to stop may take on a busy machine; it takes 2 at most by itself."""


def free_port() -> int:
    """A port that nobody has, and that the system gives nobody for a connection either, while the server is down."""
    return free_ports(1)[0]


def free_ports(count: int) -> list[int]:
    """As many different ones."""
    found: list[int] = []
    for port in random.sample(range(21000, 32000), 1000):
        with socket.socket() as probe, suppress(OSError):
            probe.bind(("127.0.0.1", port))
            found.append(port)
        if len(found) == count:
            return found
    raise RuntimeError(f"there are {len(found)} free ports, not {count}")


class Process:
    """`lpn` with some arguments, after some code of ours in the same process, which may make things slow.

    Args:
        cache: its cache.
        before: Python that runs first.
    """

    def __init__(self, arguments: list[object], cache: Path, before: str = "", **environment: str) -> None:
        code = f"import sys\n{before}\nfrom lpn.cli.main import run\nsys.argv[0] = 'lpn'\nrun()\n"
        command = [sys.executable, "-c", code, *map(str, arguments)]
        environ = {**os.environ, "LPN_CACHE": str(cache), **environment}
        self._files = [cache.with_name(f"{cache.name}-{name}.txt") for name in ("out", "err")]
        out, err = (file.open("w") for file in self._files)
        # A session of its own: Ctrl-C reaches all that belong to it, and not the tests.
        self._process = subprocess.Popen(command, stdout=out, stderr=err, env=environ, start_new_session=True)
        out.close()
        err.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if self._process.poll() is None:
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    @property
    def out(self) -> str:
        return self._files[0].read_text(errors="replace")

    @property
    def err(self) -> str:
        return self._files[1].read_text(errors="replace")

    def until(self, holds: Callable[[], object], seconds: float = 60) -> None:
        """Wait until something holds while the process runs."""
        end = time.monotonic() + seconds
        while not holds():
            assert self._process.poll() is None, self.out + self.err
            assert time.monotonic() < end, self.out + self.err
            time.sleep(0.02)

    def interrupt(self) -> None:
        """Ctrl-C."""
        os.killpg(self._process.pid, signal.SIGINT)

    def terminate(self) -> None:
        """SIGTERM, to the process alone."""
        self._process.terminate()

    def ended(self, seconds: float = SOON) -> tuple[int, float]:
        """Its exit status and how many seconds it took; it must come, and no traceback be shown."""
        began = time.monotonic()
        status = self._process.wait(seconds)
        took = time.monotonic() - began
        assert "Traceback" not in self.err + self.out, self.err
        print(f"ended in {took:.2f} s")
        return status, took
