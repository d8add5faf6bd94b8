"""A Milvus server of a test's own, from the environment whose Python `LPN_MILVUS_PYTHON` names; see `milvus_python`."""

from __future__ import annotations

import os
import signal
import subprocess
from pathlib import Path
from types import TracebackType
from typing import Self

import pytest

from tests.processes import free_port

_RUN = """
import sys
from milvus import default_server
default_server.set_base_dir(sys.argv[1])
default_server.listen_port, default_server.webservice_port = int(sys.argv[2]), int(sys.argv[3])
default_server.start()
print(default_server.server_proc.pid, flush=True)
sys.stdin.read()
default_server.stop()
"""


def milvus_python() -> str:
    """The Python of an environment with `milvus==2.3.5`, `setuptools<81`, and `marshmallow<4`; skips where none is named."""
    pytest.importorskip("pymilvus", reason="pymilvus is not installed (the extra milvus)")
    python = os.environ.get("LPN_MILVUS_PYTHON")
    if not python:
        pytest.skip("LPN_MILVUS_PYTHON names no Python that has the Milvus server")
    return python


class Server:
    """A server on a port and a folder of its own, which ends with the block."""

    def __init__(self, python: str, folder: Path) -> None:
        self._python, self._folder = python, folder
        self.port, self._health = free_port(), free_port()
        self._process: subprocess.Popen[str] | None = None
        self._server = 0

    @property
    def url(self) -> str:
        return f"milvus://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()

    def start(self) -> None:
        """Start on the folder as it is; returns when the server answers."""
        command = [self._python, "-c", _RUN, str(self._folder), str(self.port), str(self._health)]
        with (self._folder.parent / f"{self._folder.name}.log").open("a") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True
            )
        assert self._process.stdout is not None
        said = self._process.stdout.readline()
        if not said:
            self.kill()
            raise RuntimeError(f"the Milvus server did not start; see {self._folder}.log")
        self._server = int(said)

    def kill(self) -> None:
        """End the server at once, and what started it."""
        if self._process is None:
            return
        if self._server:
            os.kill(self._server, signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        self._process, self._server = None, 0
