"""An index of tiles in the explorer: opening, links, the laboratory, reports, flights, and large indexes."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from explorer.opening import open_model, open_source
from explorer.screen.result import ScreenResult
from explorer.workspace import Workspace
from lpn.cli.main import main
from lpn.core.errors import InputError
from lpn.flight.files import write_flight
from lpn.flight.maps import NamedWindow
from lpn.index import task as index_tasks
from lpn.sources import SourceOptions, source_of
from tests.explorer.conftest import TASK, answered
from tests.lpn.flight.locate.scenery import FLOWN_PLACES, land, small_flight, write_map


def _run(*arguments: object) -> None:
    assert main([str(argument) for argument in arguments]) == 0


@pytest.fixture(scope="module")
def index(data: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """An index of the 14 satellite tiles of `data`, which has no positions."""
    folder = tmp_path_factory.mktemp("index")
    tiles = data / "test" / "gallery_satellite"
    _run("describe", "--model", model_file, "--images", tiles, "--view", "satellite", "--out", folder / "store")
    _run("index", "--descriptors", folder / "store", "--out", folder / "tiles")
    return folder / "tiles"


@pytest.fixture(scope="module")
def workspace(index: Path, data: Path, model_file: Path) -> Workspace:
    return open_source(SourceOptions(source=str(index), model=model_file, data=data))


@pytest.fixture(scope="module")
def live(data: Path, model_file: Path) -> Workspace:
    """The data set itself."""
    return open_model(data, model_file)


def ranked(result: ScreenResult) -> list[str]:
    return [result.task.gallery[match.index].name for match in result.analysis.matches]


def test_the_screen_shows_what_that_of_the_data_set_shows(workspace: Workspace, live: Workspace) -> None:
    own = live.tasks[TASK].queries[9].path.read_bytes()
    for given in ({"query": 0}, {"query": 3, "angle": 40.0, "weights": [1, 1, 0, 1]}, {"own": own}):
        one, other = (answered(opened, **given) for opened in (workspace, live))
        assert ranked(one) == ranked(other)
        for match, same in zip(one.analysis.matches, other.analysis.matches, strict=True):
            np.testing.assert_allclose(match.contributions, same.contributions, atol=1e-5)
            assert match.contributions.sum() == pytest.approx(match.distance2, abs=1e-5)
        shown, expected = one.message(), other.message()
        for part in ("headline", "rows", "rank", "nearest"):
            assert shown[part] == expected[part]
        assert shown["tiles"][one.first.index]["shares"] == expected["tiles"][other.first.index]["shares"]
    results = workspace.rankings[TASK].results
    for name in ("recall@1", "recall@5", "recall@10", "ap"):
        assert results[name] == pytest.approx(live.rankings[TASK].results[name])
    assert workspace.tasks[TASK].tiles == 14


@pytest.fixture(scope="module")
def flown(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """An index of windows, their map, and a flight over it."""
    folder = tmp_path_factory.mktemp("flown")
    town = write_map(folder / "town.tif", land()[::2, ::2])
    (folder / "monday").mkdir()
    write_flight(small_flight(folder / "monday", town), folder / "monday")
    _run("index", "--model", model_file, "--map", folder / "town.tif", "--size", 50, 70, "--out", folder / "windows")
    return folder / "windows", folder / "town.tif", folder / "monday"


def test_a_flight_is_searched_for_among_windows(
    flown: tuple[Path, Path, Path], model_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    index, town, flight = flown
    workspace = open_source(SourceOptions(source=str(flight), map=town, index=str(index), model=model_file))
    task = workspace.tasks[TASK]
    assert len(task.queries) == len(FLOWN_PLACES) + 1
    assert np.flatnonzero(~task.known).tolist() == [0, 2]  # one has no position, one cannot be read
    (bad,) = (frame for frame in task.queries if frame.note == "cannot be read")
    told = [record.getMessage() for record in caplog.records if record.name == "lpn.flight.locate.task"]
    assert [bad.path.name in line for line in told] == [True]
    result = answered(workspace, query=5, heat="evidence")
    assert result.evidence
    analysis = result.analysis
    assert analysis.errors_m is not None
    for match in analysis.matches:
        window = NamedWindow.parse(task.gallery[match.index].path.name)
        placed, tag = analysis.task.geometry.tiles[match.index], analysis.task.geometry.queries[5]
        assert (placed.latitude, placed.longitude, placed.width) == (window.latitude, window.longitude, window.size)
        north, east = (
            np.radians(a - b) * 6_371_000
            for a, b in ((placed.latitude, tag.latitude), (placed.longitude, tag.longitude))
        )
        inside = max(abs(north), abs(east * np.cos(np.radians(tag.latitude)))) <= window.size / 2
        assert match.true == inside
    # The picture of a window is the one that was described.
    np.testing.assert_allclose(analysis.tile.descriptor, task.gallery_descriptors[analysis.chosen.index], atol=1e-4)
    assert workspace.mosaic(analysis.task).shape[2] == 3
    west, south, east, north = analysis.task.geometry.bounds()
    assert (east - west, north - south) == pytest.approx((200, 200), abs=1)
    unknown = answered(workspace, query=0)
    assert unknown.analysis.ranking.relevant is None
    assert unknown.message()["headline"]["found"] is None


def test_the_windows_that_hold_a_tag_are_among_those_of_a_large_index(
    flown: tuple[Path, Path, Path], model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index, town, flight = flown
    source = SourceOptions(source=str(flight), map=town, index=str(index), model=model_file)
    whole = source_of(source).open().task
    monkeypatch.setattr(index_tasks, "MOST_TILES", whole.tiles - 1)
    monkeypatch.setattr(index_tasks, "PROPOSED", 4)  # of which some about a tag do not hold it
    nearest = source_of(source).open().task
    assert nearest.tiles < whole.tiles
    for query, (some, every) in enumerate(zip(nearest.truth, whole.truth, strict=True)):
        assert (some.known, len(some.good) > 0) == (every.known, len(every.good) > 0)
        if some.known:
            ranks = [task.search(query).positive() for task in (nearest, whole)]
            assert ranks[0].rank <= ranks[1].rank
            # It is the nearest of all windows that hold the tag.
            assert ranks[0].score == pytest.approx(ranks[1].score, abs=1e-6)


def test_an_index_alone_has_no_queries(index: Path, model_file: Path) -> None:
    with pytest.raises(InputError, match="tiles and no queries"):
        open_source(SourceOptions(source=str(index), model=model_file))
