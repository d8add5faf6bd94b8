"""A model with one branch for queries and one for the gallery: an index holds the gallery, a search describes a query."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn import retrieval
from lpn.cli.main import main
from lpn.core import images
from lpn.descriptors import open_store
from lpn.index import open_index
from tests.conftest import Refused
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import GATES, GateModel


@pytest.fixture
def model(monkeypatch: pytest.MonkeyPatch) -> GateModel:
    """A model by role, which the commands open whatever the file."""
    opened = GateModel(replace(GATES, roles="role", groups=()))
    monkeypatch.setattr(lpn, "load", lambda *_, **__: opened)
    return opened


@pytest.fixture
def tiles(tmp_path: Path) -> Path:
    """A folder of three drone pictures."""
    for i in range(3):
        small_worlds.write(tmp_path / "tiles" / f"{i}.png", small_worlds.place(i))
    return tmp_path / "tiles"


def describe(tiles: Path, out: Path, *more: str) -> int:
    return main(["describe", "--model", "m.pth", "--images", str(tiles), "--view", "drone", "--out", str(out), *more])


def test_drone_tiles_are_a_gallery_for_a_satellite_query(model: GateModel, tiles: Path, tmp_path: Path) -> None:
    store, index, found = tmp_path / "store", tmp_path / "index", tmp_path / "found.json"
    assert describe(tiles, store, "--role", "gallery") == 0
    assert main(["index", "--descriptors", str(store), "--out", str(index)]) == 0
    bound = model.for_task("satellite", "drone")
    assert open_store(store).kind.role == "gallery"
    with open_index(index, bound.fingerprint):
        pass
    search = ["search", "--index", str(index), "--model", "m.pth", "--picture", str(tiles / "1.png"), "--view"]
    assert main([*search, "satellite", "--json", str(found)]) == 0
    picture = images.load_picture(tiles / "1.png")
    query, tile = (retrieval.describe_picture(bound, picture, view).descriptor for view in bound.views)
    score = {match["tile"]: match["score"] for match in json.loads(found.read_text())["matches"]}["1.png"]
    assert score == pytest.approx(float(np.vdot(query, tile)), abs=1e-6)
    assert score < 0.999  # as by one branch it would be 1
    assert main([*search, "drone"]) == 2


def test_descriptors_of_queries_are_no_gallery(model: GateModel, tiles: Path, tmp_path: Path, refused: Refused) -> None:
    assert describe(tiles, tmp_path / "store") == 0
    assert open_store(tmp_path / "store").kind.fingerprint == model.fingerprint
    said = refused("index", "--descriptors", tmp_path / "store", "--out", tmp_path / "index")
    assert "an index holds a gallery; describe the pictures again with --role gallery" in said
    assert not (tmp_path / "index").exists()


def test_a_role_is_for_models_that_have_them(
    tiles: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(lpn, "load", lambda *_, **__: GateModel())
    assert describe(tiles, tmp_path / "store", "--role", "gallery") == 2
    assert "Gates has no branches for queries and for the gallery; leave the role out" in capsys.readouterr().err
    assert not (tmp_path / "store").exists()
    assert describe(tiles, tmp_path / "store") == 0
    assert open_store(tmp_path / "store").kind.role is None
