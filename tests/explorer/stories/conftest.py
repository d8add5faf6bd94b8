"""A small workspace with positions, whose stories each test keeps in a folder of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from explorer.opening import open_model
from explorer.workspace import Workspace
from tools.fixtures import small_worlds

TASK = "drone-to-satellite"


@pytest.fixture(scope="package")
def opened(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    data = small_worlds.map_dataset(
        small_worlds.make_dataset(tmp_path_factory.mktemp("stories") / "places", train=1, test=6)
    )
    return open_model(data, model_file)


@pytest.fixture
def workspace(opened: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    (tmp_path / "data").mkdir()
    monkeypatch.setattr(opened, "root", tmp_path / "data")
    return opened
