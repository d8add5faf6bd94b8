"""Windows of a map described straight into an index."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn.cli.main import main
from lpn.core.arrays import Float32Array
from lpn.core.progress import listening
from lpn.flight.locate.retrieval import described_windows
from lpn.flight.maps import Map, NamedWindow, Window, open_map
from lpn.index import DescriptorKind, WindowsRecord, create_index, open_index
from lpn.index.from_map import index_windows, windows_kind
from lpn.models.base import normalise
from tests.conftest import Refused
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff


@pytest.fixture
def town(tmp_path: Path) -> Map:
    return open_map(write_geotiff(tmp_path / "town.tif", smooth(200, 300)))


def windows_of(town: Map) -> DescriptorKind:
    """The kind of an index of windows of 40 m, of drawn descriptors."""
    record = WindowsRecord(town.identity(), (40.0,), 0.5, 1, town.count_pyramid([40.0]))
    return DescriptorKind("drawn", 2, 8, record)


def test_windows_are_those_of_a_described_store(town: Map, model_file: Path, tmp_path: Path) -> None:
    model = lpn.load(model_file)
    assert windows_kind(model, town, [40.0]).windows == windows_of(town).windows
    named = NamedWindow.all_of(town.pyramid([40.0, 60.0], 0.5), town.frame)
    rounded, names = NamedWindow.all_on(named, town.frame), [one.name for one in named]
    out = tmp_path / "index"
    command = ["index", "--map", str(tmp_path / "town.tif"), "--model", str(model_file), "--size", "40", "60"]
    assert main([*command, "--out", str(out)]) == 0
    with open_index(out, model.fingerprint) as index:
        assert index.count() == len(names) > 20
        vectors, degrees = index.read(names)
    np.testing.assert_allclose(vectors, described_windows(model, town, rounded), atol=1e-5)
    np.testing.assert_array_equal(degrees, [(one.latitude, one.longitude) for one in named])


def test_a_killed_run_goes_on_with_the_windows_that_are_missing(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lpn.index.from_map.BLOCK", 8)
    kind = windows_of(town)
    described: list[Window] = []

    def describe(windows: Sequence[Window]) -> Float32Array:
        if len(described) >= 20 and not resumed:
            raise KeyboardInterrupt
        described.extend(windows)
        return normalise(np.array([[w.x, w.y] for w in windows], np.float32).repeat(8, axis=1).reshape(-1, 2, 8))

    resumed = False
    with create_index(tmp_path / "index", kind) as index:
        with pytest.raises(KeyboardInterrupt):
            index_windows(index, town, describe)
        before, resumed = len(described), True
        assert index.count() == before >= 20
        progress: list[tuple[int, int]] = []
        with listening(lambda _, *counts: progress.append(counts)):
            added = index_windows(index, town, describe)
        windows = town.pyramid([40.0])
        assert len(described) == before + added == index.count() == len(windows) == town.count_pyramid([40.0])
        assert progress[0] == (0, len(windows))
        assert progress[-1] == (len(windows), len(windows))
        assert not index_windows(index, town, describe)
        assert index_windows(index, town, describe, again=True) == index.count() == len(windows)


def test_machines_share_a_map_by_boxes(town: Map, tmp_path: Path) -> None:
    def describe(windows: Sequence[Window]) -> Float32Array:
        return normalise(np.ones((len(windows), 2, 8), np.float32))

    middle = town.frame.degrees([(0.0, 0.0)])[0, 1]
    with create_index(tmp_path / "index", windows_of(town)) as index:
        west, east = (
            index_windows(index, town, describe, box=box) for box in ((-90, -180, 90, middle), (-90, middle, 90, 180))
        )
        assert min(west, east) > 3
        assert index.count() == town.count_pyramid([40.0]) == west + east


@pytest.mark.usefixtures("town")
@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--map", "TOWN"], "give --map with --model"),
        (["--map", "TOWN", "--model", "MODEL", "--descriptors", "x"], "not --descriptors or --data"),
        (["--map", "TOWN", "--model", "MODEL", "--size", "5000"], "No window of 5000 m"),
        (["--size", "40"], "give --descriptors, or --map with --model"),
    ],
)
def test_mistakes_get_one_sentence(
    options: list[str], said: str, model_file: Path, tmp_path: Path, refused: Refused
) -> None:
    files = {"TOWN": tmp_path / "town.tif", "MODEL": model_file}
    assert said in refused("index", "--out", tmp_path / "index", *(files.get(option, option) for option in options))
    assert not (tmp_path / "index").exists()
