"""A workspace of places with known positions, and a running app on it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from explorer.app import App
from explorer.workspace import LazyWorkspace, Workspace
from lpn.core.errors import DataError
from tests.explorer.conftest import mapped_workspace
from tools.fixtures.screen_tab import ScreenTab

TAB = "0123456789abcdef"


@pytest.fixture(scope="package")
def workspace(
    tmp_path_factory: pytest.TempPathFactory, model_file: Path, one_part_model_file: Path
) -> Iterator[Workspace]:
    with mapped_workspace(tmp_path_factory.mktemp("screen"), model_file, one_part_model_file) as opened:
        yield opened


@pytest.fixture(scope="package")
def app(workspace: Workspace) -> Iterator[App]:
    """The app on these places, which offers another one that does not open."""

    def never() -> Workspace:
        raise DataError("The map is not there; give another.")

    served = App(workspace, "127.0.0.1", 0, None, "places", {"broken": LazyWorkspace("a broken map", never)})
    yield served
    served.close()


class Tab(ScreenTab):
    """A tab of an app in this process."""

    def __init__(self, app: App, tab: str = TAB, protocol: str = "lpn-json", **options: Any) -> None:
        super().__init__(f"http://127.0.0.1:{app.server.get_port()}", tab, protocol, **options)


@pytest.fixture
def tab(app: App) -> Iterator[Tab]:
    with Tab(app) as connected:
        yield connected
