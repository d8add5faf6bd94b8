from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn.core.arrays import Float32Array
from lpn.descriptors import Store
from lpn.flight.locate.retrieval import describe_windows
from lpn.flight.maps import Map, NamedWindow, open_map
from lpn.flight.maps.named_window import WindowCut
from lpn.models.base import Model
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff


@pytest.fixture
def town(tmp_path: Path) -> Map:
    return open_map(write_geotiff(tmp_path / "town.tif", smooth(200, 300)))


def _windows(town: Map) -> list[NamedWindow]:
    return NamedWindow.all_of(town.pyramid([40.0], 0.5), town.frame)


def _describe(model: Model, town: Map, windows: list[NamedWindow], out: Path) -> Store:
    return describe_windows(model, town, NamedWindow.all_on(windows, town.frame), out)


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
