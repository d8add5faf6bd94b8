"""A workspace of places with known positions, and a running app on it."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from explorer.app import App
from explorer.opening import open_model
from explorer.workspace import LazyWorkspace, Workspace
from lpn.core.errors import DataError
from tools.fixtures import small_worlds
from tools.fixtures.waiting import TIMEOUT

TAB = "0123456789abcdef"


@pytest.fixture(scope="package")
def workspace(
    tmp_path_factory: pytest.TempPathFactory, model_file: Path, one_part_model_file: Path
) -> Iterator[Workspace]:
    """Eight places on a map under an LPN of four parts, with the baseline beside it; all queries are ranked."""
    folder = tmp_path_factory.mktemp("screen")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        data = small_worlds.map_dataset(small_worlds.make_dataset(folder / "places", train=1, test=8))
        opened = open_model(data, model_file, baseline=one_part_model_file)
        for ranking in opened.rankings.values():
            ranking.wait(opened, lambda *_: None)
        yield opened


@pytest.fixture(scope="package")
def app(workspace: Workspace) -> Iterator[App]:
    """The app on these places, which offers another one that does not open."""

    def never() -> Workspace:
        raise DataError("The map is not there; give another.")

    served = App(workspace, "127.0.0.1", 0, None, "places", {"broken": LazyWorkspace("a broken map", never)})
    yield served
    served.close()


class Tab:
    """A page's end of the channel.

    Attributes:
        last: the newest message of each kind.
    """

    def __init__(self, app: App, tab: str = TAB, protocol: str = "lpn-json", **options: Any) -> None:
        address = f"ws://127.0.0.1:{app.server.get_port()}/api/{tab}"
        protocols: Any = [protocol]
        self.socket = connect(address, subprotocols=protocols, max_size=None, **options)
        self.last: dict[str, Any] = {}

    def send(self, message: object) -> None:
        self.socket.send(json.dumps(message))

    def act(self, action: str, /, **arguments: object) -> None:
        self.send({"do": action, "args": arguments})

    def until(self, holds: Callable[[dict[str, Any]], object]) -> dict[str, Any]:
        """Receive until the newest messages fulfil a condition, and return them."""
        deadline = time.monotonic() + TIMEOUT
        while not holds(self.last):
            assert time.monotonic() < deadline, f"only {list(self.last)} came"
            self.last |= json.loads(self.socket.recv(TIMEOUT))
        return self.last

    def result(self, **state: object) -> dict[str, Any]:
        """Return the newest result once it is that of a state with these values."""
        found = self.until(
            lambda last: "result" in last and all(last["result"]["state"][name] == one for name, one in state.items())
        )
        result: dict[str, Any] = found["result"]
        return result

    def open(self, search: str = "") -> dict[str, Any]:
        """Open the page of an address, and return its first result."""
        self.last.pop("result", None)
        self.act("open", search=search)
        self.until(lambda last: "result" in last and "rail" in last)
        return self.result()

    def closed(self) -> bool:
        """Return whether the server closes the connection."""
        try:
            while True:
                self.socket.recv(TIMEOUT)
        except ConnectionClosed:
            return True


@pytest.fixture
def tab(app: App) -> Iterator[Tab]:
    connected = Tab(app)
    yield connected
    connected.socket.close()
