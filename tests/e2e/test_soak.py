"""A short soak on drawn places: several clients and a real page at once, and every answer checked. Nothing here is timed."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from lpn.files import write_whole
from soak.run import Soak
from tests import worlds


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Places that are seen in both directions."""
    return worlds.map_dataset(worlds.make_dataset(tmp_path_factory.mktemp("soak") / "places"))


def test_many_at_once_are_each_answered_rightly_and_leave_nothing_behind(
    places: Path, model_file: Path, tmp_path: Path
) -> None:
    options = ["--data", str(places), "--model", str(model_file)]
    said: list[str] = []
    soak = Soak(places, model_file, options, clients=8, pages=1, seed=0, alone=5, together=30, say=said.append)
    figures = soak.run()
    assert not figures.faults, figures.faults
    assert not figures.tracebacks
    assert figures.wrong == 0
    assert figures.unchecked == 0
    assert {time.who for time in figures.times} == {f"client {i}" for i in range(9)} | {"page 1"}
    assert figures.checked >= 3 * 9
    left, (threads, handles) = figures.memory.left, figures.memory.most()
    if left is not None:
        assert left.threads <= threads, figures.memory
        assert left.handles <= handles, figures.memory
    write_whole(tmp_path / "soak.json", figures.json())
    assert json.loads((tmp_path / "soak.json").read_text())["checked"] == figures.checked
