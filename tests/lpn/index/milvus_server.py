"""A Milvus server of a test's own, from the environment whose Python `LPN_MILVUS_PYTHON` names, or what stands for one."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import time
from contextlib import suppress
from importlib import import_module
from pathlib import Path
from types import TracebackType
from typing import Any, ClassVar, Self

import pytest

from lpn.index import Kind, Structure
from tests.processes import free_ports

_RUN = """
import json, socket, sys, time
from milvus import default_server

def bound(config, port):
    # Connections of a server that was killed keep its port for a while from those who do not say this; it would take the next.
    # And on a busy machine the server itself keeps it for a moment longer.
    for _ in range(300):
        one = socket.socket()
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind(("127.0.0.1", port))
            one.listen()
            return one
        except OSError:
            one.close()
            time.sleep(0.1)
    raise OSError(f"port {port} is in use")

type(default_server.config).try_bind_port = bound
given = json.loads(sys.argv[1])
default_server.set_base_dir(given["folder"])
default_server.listen_port, default_server.webservice_port = given["port"], given["health"]
default_server.config.set("authorization_enabled", given["passwords"])
parts = [key for key in default_server.config.configurable_items if key.endswith("_port") and key != "proxy_port"]
default_server.config.update(**dict(zip(parts, given["ports"], strict=False)))
default_server.start()
print(default_server.server_proc.pid, flush=True)
sys.stdin.read()
default_server.stop()
"""
_ETCD = """
listen-client-urls: http://127.0.0.1:{0}
advertise-client-urls: http://127.0.0.1:{0}
listen-peer-urls: http://127.0.0.1:{1}
initial-advertise-peer-urls: http://127.0.0.1:{1}
initial-cluster: default=http://127.0.0.1:{1}
"""
_PARTS = 16
"""Ports for a server's parts, more than there are."""


def milvus_python() -> str:
    """The Python of an environment with `milvus==2.3.5`, `setuptools<81`, and `marshmallow<4`; skips where none is named."""
    pytest.importorskip("pymilvus", reason="pymilvus is not installed (the extra milvus)")
    python = os.environ.get("LPN_MILVUS_PYTHON")
    if not python:
        pytest.skip("LPN_MILVUS_PYTHON names no Python that has the Milvus server")
    return python


COLLECTION = "milvus://127.0.0.1:9/tiles"


class Client:
    """In place of pymilvus's: a collection with a description, and what goes wrong where it is asked for."""

    clients: ClassVar[list[Client]] = []
    description = ""
    error: Exception | None = None

    def __init__(self, **_: Any) -> None:
        self.closed = False
        self.clients.append(self)

    def has_collection(self, *_: Any, **__: Any) -> bool:
        return True

    def describe_collection(self, *_: Any, **__: Any) -> dict[str, str]:
        return {"description": self.description}

    def list_indexes(self, *_: Any) -> list[str]:
        return ["vector"]

    def load_collection(self, *_: Any) -> None:
        if self.error is not None:
            raise self.error

    def query(self, *_: Any, **__: Any) -> None:
        self.load_collection()

    def close(self) -> None:
        self.closed = True


def pretend(monkeypatch: pytest.MonkeyPatch, kind: Kind) -> type[Client]:
    """Put a client in place of pymilvus's; returns its class, on which a test says what it meets."""
    pymilvus = pytest.importorskip("pymilvus", reason="pymilvus is not installed (the extra milvus)")
    said = json.dumps({"format": "lpn-milvus/1", **vars(kind), "structure": "flat"})
    made = type("Made", (Client,), {"clients": [], "description": said})
    monkeypatch.setattr(pymilvus, "MilvusClient", made)
    return made


def indexed(client: Any, name: str, structure: Structure) -> None:
    """Returns when every tile is in the index and that is loaded; flat ones have none."""
    client.flush(name)
    field = client.list_indexes(name)[0]
    while structure != "flat":
        said = client.describe_index(name, field)
        if not int(said["pending_index_rows"]) and int(said["indexed_rows"]) >= int(said["total_rows"]):
            break
        time.sleep(0.2)
    client.release_collection(name)
    client.load_collection(name)


class Server:
    """A server on ports and a folder of its own, beside others, which ends with the block.

    Args:
        passwords: whether it lets in only who has a name and a password; at first that is root with Milvus.
    """

    def __init__(self, python: str, folder: Path, passwords: bool = False) -> None:
        self._python, self._folder, self._passwords = python, folder, passwords
        self.port, self._health, *self._ports = free_ports(_PARTS + 4)
        self._process: subprocess.Popen[str] | None = None
        self._server = 0

    @property
    def url(self) -> str:
        """Of its collections, but for their names."""
        return self.url_of("root:Milvus" if self._passwords else "")

    def url_of(self, token: str) -> str:
        """The same of a user, user:password."""
        return f"milvus://{token}@127.0.0.1:{self.port}" if token else f"milvus://127.0.0.1:{self.port}"

    def client(self) -> Any:
        """pymilvus's own, of one who may do all."""
        return import_module("pymilvus").MilvusClient(f"http://127.0.0.1:{self.port}", token="root:Milvus")

    @property
    def pid(self) -> int:
        """Of the server's process."""
        return self._server

    def __enter__(self) -> Self:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.kill()

    def start(self) -> None:
        """Start on the folder as it is; returns when the server answers."""
        etcd = self._folder.parent / f"{self._folder.name}.etcd.yaml"
        etcd.write_text(_ETCD.format(*self._ports))
        given = {
            "folder": str(self._folder),
            "port": self.port,
            "health": self._health,
            "ports": self._ports[2:],
            "passwords": self._passwords,
        }
        command = [self._python, "-c", _RUN, json.dumps(given)]
        environment = {**os.environ, "ETCD_CONFIG_PATH": str(etcd)}
        with (self._folder.parent / f"{self._folder.name}.log").open("a") as log:
            self._process = subprocess.Popen(
                command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=log, text=True, env=environment
            )
        assert self._process.stdout is not None
        said = self._process.stdout.readline()
        if not said:
            self.kill()
            raise RuntimeError(f"the Milvus server did not start; see {self._folder}.log")
        self._server = int(said)

    def kill(self) -> None:
        """End the server at once, and what started it; the next waits half a minute for this one's leases to end."""
        if self._process is None:
            return
        if self._server:
            with suppress(ProcessLookupError):  # it has ended by itself
                os.kill(self._server, signal.SIGKILL)
        self._process.kill()
        self._process.wait()
        for stream in (self._process.stdin, self._process.stdout):
            if stream is not None:
                stream.close()
        self._process, self._server = None, 0
