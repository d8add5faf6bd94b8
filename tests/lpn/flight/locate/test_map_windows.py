from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import lpn
from lpn.cli.main import main
from lpn.core.arrays import Float32Array
from lpn.descriptors import Store, open_store
from lpn.flight.locate.retrieval import describe_windows
from lpn.flight.maps import Map, NamedWindow, open_map
from lpn.flight.maps.named_window import WindowCut
from lpn.index import open_index
from lpn.models.base import Model
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff


@pytest.fixture
def town(tmp_path: Path) -> Map:
    return open_map(write_geotiff(tmp_path / "town.tif", smooth(200, 300)))


def _windows(town: Map) -> list[NamedWindow]:
    return NamedWindow.all_of(town.pyramid([40.0], 0.5), town.frame)


def _describe(model: Model, town: Map, windows: list[NamedWindow], out: Path) -> Store:
    rounded, names = NamedWindow.all_on(windows, town.frame), [window.name for window in windows]
    return describe_windows(model, town, rounded, out, names=names)


def test_windows_are_described_once_and_a_killed_run_resumes(
    town: Map, model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    model, windows = lpn.load(model_file), _windows(town)
    described = 0
    original = type(model).descriptors

    def counted(self: Model, batch: Float32Array, *given: object) -> Float32Array:
        nonlocal described
        if described >= 10 and not resumed:
            raise KeyboardInterrupt
        described += len(batch)
        return original(self, batch, *given)  # type: ignore[arg-type]

    resumed = False
    monkeypatch.setattr(type(model), "descriptors", counted)
    with pytest.raises(KeyboardInterrupt):
        _describe(model, town, windows, tmp_path / "store")
    before, resumed = described, True
    assert 10 <= before < len(windows)
    store = _describe(model, town, windows, tmp_path / "store")
    assert described == len(windows)
    for row in (0, before, len(windows) - 1):
        picture = WindowCut(town, NamedWindow.all_on(windows, town.frame)[row], max(model.input_size))()
        alone = original(model, model.prepare(picture, "satellite")[None], "satellite")[0]
        np.testing.assert_allclose(store.float32[row], alone, atol=1e-5)
    described = 0
    _describe(model, town, windows, tmp_path / "store")
    assert not described
    # Another map of the same windows is another matter.
    other = open_map(write_geotiff(tmp_path / "other.tif", smooth(200, 300, seed=1)))
    _describe(model, other, windows, tmp_path / "store")
    assert described == len(windows)


def test_a_map_is_described_indexed_and_searched(town: Map, model_file: Path, tmp_path: Path) -> None:
    def run(*arguments: object) -> None:
        assert main([str(argument) for argument in arguments]) == 0

    model = ("--model", model_file)
    run("describe", *model, "--map", tmp_path / "town.tif", "--size", 40, "--overlap", 0.5, "--out", tmp_path / "store")
    run("index", "--descriptors", tmp_path / "store", "--out", tmp_path / "index")
    windows = _windows(town)
    assert [row.file for row in open_store(tmp_path / "store").manifest.rows] == [window.name for window in windows]
    picture = tmp_path / "query.png"
    cv2.imwrite(str(picture), WindowCut(town, NamedWindow.all_on(windows[7:8], town.frame)[0], 96)()[..., ::-1])
    found = tmp_path / "found.json"
    run("search", *model, "--index", tmp_path / "index", "--picture", picture, "--view", "satellite", "--json", found)
    first = json.loads(found.read_text())["matches"][0]
    assert first["tile"] == windows[7].name
    assert (first["latitude"], first["longitude"]) == (windows[7].latitude, windows[7].longitude)
    with open_index(tmp_path / "index") as index:
        assert index.count() == len(windows)


@pytest.mark.usefixtures("town")
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--map", "TOWN", "--images", "x"], "either --map or --images"),
        (["--map", "TOWN", "--size", "5000"], "No window of 5000 m"),
        (["--map", "TOWN", "--engine", "ray"], "on one machine"),
        (["--images", "x"], "give --view"),
        (["--images", "x", "--view", "drone", "--overlap", "0.3"], "with --map only"),
        ([], "There are no pictures"),
    ],
)
def test_mistakes_get_one_sentence(
    options: list[str], said: str, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = [str(tmp_path / "town.tif") if option == "TOWN" else option for option in options]
    status = main(["describe", "--model", str(model_file), "--out", str(tmp_path / "store"), *given])
    assert status == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "store").exists()
