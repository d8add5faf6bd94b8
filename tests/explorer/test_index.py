"""An index of tiles in the explorer: opening, links, the laboratory, reports, flights, and large indexes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lpn
from explorer import reports
from explorer.browse.feeds import Feeds
from explorer.explain_window import evidence
from explorer.explain_window.sweep_request import SweepRequest
from explorer.failure_lab import state as lab_state
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.service import FailureLab
from explorer.failure_lab.state import LabState
from explorer.opening import open_model, open_source
from explorer.panels import answer_text, pages, place_text
from explorer.session_state import POSITIVE, SessionState
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, Workspace
from lpn.analysis import part_weights
from lpn.analysis.comparison import effect_on
from lpn.cli.main import main
from lpn.flights import write_flight
from lpn.index import gallery
from lpn.library.analyser import OwnPicture
from lpn.maps import NamedWindow
from lpn.sources import SourceOptions, source_of
from lpn.tasks import changes
from tests.lpn.locate.scenery import FLOWN_PLACES, land, small_flight, write_map
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import GATES, GateModel

TASK = "drone-to-satellite"


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


def _state(query: int = 0) -> SessionState:
    return SessionState(TASK, 4, query=query)


def test_the_screen_shows_what_that_of_the_data_set_shows(workspace: Workspace, data: Path, model_file: Path) -> None:
    live = open_model(data, model_file)
    ours, theirs = StateAnalyser(workspace), StateAnalyser(live)
    for query in (0, 7):
        one, other = (analyser.analyse(_state(query), 10) for analyser in (ours, theirs))
        for name in ("verdict", "matches"):
            rendered = [
                pages.verdict(analysis, shown)
                if name == "verdict"
                else [analysis.task.gallery[match.index].name for match in analysis.matches]
                for analysis, shown in ((one, workspace), (other, live))
            ]
            assert rendered[0] == rendered[1]
    results = workspace.rankings[TASK].results
    for name in ("recall@1", "recall@5", "recall@10", "ap"):
        assert results[name] == pytest.approx(live.rankings[TASK].results[name])
    header = pages.header(workspace, workspace.tasks[TASK])
    assert ">14 tiles<" in header
    assert "Save this answer" in header
    assert "no map" in header


def test_regions_turns_and_own_pictures_are_searched_as_in_memory(
    workspace: Workspace, data: Path, model_file: Path
) -> None:
    live = open_model(data, model_file)
    own = OwnPicture("mine", small_worlds.place(9))
    rows, columns = live.map_sizes["drone"]
    cells = tuple(range(rows * columns // 2))
    states = [
        replace(_state(2), region=cells, enabled=(True, True, False, True)),
        replace(_state(3), angle=40.0, zoom=1.2),
        replace(_state(), upload=own),
    ]
    for state in states:
        one, other = (StateAnalyser(shown).analyse(state, 10) for shown in (workspace, live))
        names = [[analysis.task.gallery[m.index].name for m in analysis.matches] for analysis in (one, other)]
        assert names[0] == names[1]
        for match, expected in zip(one.matches, other.matches, strict=True):
            np.testing.assert_allclose(match.contributions, expected.contributions, atol=1e-5)
            assert match.contributions.sum() == pytest.approx(match.distance2, abs=1e-5)


def test_a_sweep_ranks_at_every_step(workspace: Workspace, data: Path, model_file: Path) -> None:
    live = open_model(data, model_file)
    ends = []
    for shown in (workspace, live):
        assert shown.model is not None
        analysis = StateAnalyser(shown).analyse(_state(4), 10)
        *_, last = SweepRequest("zoom", analysis).run(shown, shown.model)
        assert last.ended
        ends.append(last.points)
    assert len(ends[0]) == len(ends[1]) > 5
    for one, other in zip(*ends, strict=True):
        assert one.rank == other.rank
        assert one.score == pytest.approx(other.score, abs=1e-5)
        assert one.top_score == pytest.approx(other.top_score, abs=1e-5)
    assert max(point.rank for point in ends[1]) > 1


def test_a_link_names_a_tile_as_the_data_set_does(workspace: Workspace) -> None:
    links = UrlState(workspace)
    state, problems = links.read("?with=0020", _state())
    assert not problems
    assert isinstance(state.selected, int)
    assert workspace.tasks[TASK].gallery[state.selected].name == "0020"
    assert links.write(state).endswith("with=0020")
    assert StateAnalyser(workspace).analyse(state, 10).chosen.index == state.selected
    assert links.read("?with=truth", _state())[0].selected == POSITIVE
    for bad in ("nothing", "~14", "own"):
        state, problems = links.read(f"?with={bad}", _state())
        assert state.selected is None
        assert "no such tile" in problems[0]


def test_the_laboratory_and_reports_are_those_of_a_data_set(workspace: Workspace, data: Path, model_file: Path) -> None:
    live = open_model(data, model_file)
    shown = []
    for one in (workspace, live):
        service = FailureLab(one)
        assert service.build(TASK, "test").wait(60)
        findings = service.findings(TASK)
        assert findings is not None
        assert lab_state.confusions(findings, LabState(task=TASK)) is not None
        rows = lab_state.sorted_rows(findings, LabState(task=TASK))
        shown.append(np.array([findings.table.columns["rank"].text(row) for row in rows]).tolist())
        view = MapPage(service, Feeds(one), "test").page(findings, LabState(task=TASK, map="pca"), 0, rows, (760, 400))
        assert "PCA" in view.controls
    assert shown[0] == shown[1]
    analysis = StateAnalyser(workspace).analyse(replace(_state(1), why=True), 10)
    name, report = reports.of_analysis(workspace, analysis)
    assert name.endswith(".html")
    assert b"14 tiles" in report
    task = workspace.tasks[TASK]
    assert effect_on(task, (1, 1, 1, 0)).after == pytest.approx(effect_on(live.tasks[TASK], (1, 1, 1, 0)).after)
    assert not part_weights.why_not(task)
    assert not changes.why_not(task)


@pytest.fixture(scope="module")
def flown(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path, Path]:
    """An index of windows, their map, and a flight over it."""
    folder = tmp_path_factory.mktemp("flown")
    town = write_map(folder / "town.tif", land()[::2, ::2])
    (folder / "monday").mkdir()
    write_flight(small_flight(folder / "monday", town), folder / "monday")
    model = ("--model", model_file)
    _run("describe", *model, "--map", folder / "town.tif", "--size", 50, 70, "--out", folder / "store")
    _run("index", "--descriptors", folder / "store", "--out", folder / "windows")
    return folder / "windows", folder / "town.tif", folder / "monday"


def test_a_flight_is_searched_for_among_windows(
    flown: tuple[Path, Path, Path], model_file: Path, caplog: pytest.LogCaptureFixture
) -> None:
    index, town, flight = flown
    workspace = open_source(SourceOptions(source=str(flight), map=town, index=str(index), model=model_file))
    task, analyser = workspace.tasks[TASK], StateAnalyser(workspace)
    assert len(task.queries) == len(FLOWN_PLACES) + 1
    assert task.known is not None
    assert np.flatnonzero(~task.known).tolist() == [0, 2]  # one has no position, one cannot be read
    (bad,) = (frame for frame in task.queries if frame.note == "cannot be read")
    told = [record.getMessage() for record in caplog.records if record.name == "lpn.locate.index_queries"]
    assert [bad.path.name in line for line in told] == [True]
    analysis = analyser.analyse(replace(_state(5), why=True), 10)
    assert analysis.pair_evidence is not None
    assert analysis.errors_m is not None
    assert analysis.task.geometry is not None
    for match in analysis.matches:
        window = NamedWindow.parse(task.gallery[match.index].path.name)
        assert window is not None
        placed, tag = analysis.task.geometry.tiles[match.index], analysis.task.geometry.queries[5]
        assert tag is not None
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
    assert place_text.criterion(workspace, task) == "Right is a piece on which the photo's GPS tag lies."
    unknown = analyser.analyse(_state(0), 10)
    assert unknown.ranking.relevant is None
    assert answer_text.verdict(unknown, workspace)[0] is None


def test_the_windows_that_hold_a_tag_are_among_those_of_a_large_index(
    flown: tuple[Path, Path, Path], model_file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    index, town, flight = flown
    source = SourceOptions(source=str(flight), map=town, index=str(index), model=model_file)
    whole = source_of(source).open().task
    monkeypatch.setattr(gallery, "MOST_TILES", whole.tiles - 1)
    monkeypatch.setattr(gallery, "PROPOSED", 1)
    nearest = source_of(source).open().task
    assert nearest.tiles < whole.tiles
    assert nearest.truth is not None
    assert whole.truth is not None
    for query, (some, every) in enumerate(zip(nearest.truth, whole.truth, strict=True)):
        assert (some.known, len(some.good) > 0) == (every.known, len(every.good) > 0)
        if some.known:
            ranks = [task.search(query).positive() for task in (nearest, whole)]
            assert ranks[0] is not None
            assert ranks[1] is not None
            assert ranks[0].rank <= ranks[1].rank
            # It is the nearest of all windows that hold the tag.
            assert ranks[0].score == pytest.approx(ranks[1].score, abs=1e-6)
    workspace = open_source(source)
    said = "that its engine (exact) proposes for each query"
    assert said in pages.header(workspace, workspace.tasks[TASK])
    assert said in answer_text.own_hint(workspace, rendered=False)


def test_windows_without_their_map_are_placeholders(
    flown: tuple[Path, Path, Path], model_file: Path, data: Path
) -> None:
    workspace = open_source(SourceOptions(source=str(flown[0]), model=model_file, data=data))
    analysis = StateAnalyser(workspace).analyse(replace(_state(0), why=True), 10)
    assert "give that map as --map" in evidence.page(analysis, workspace)
    assert not analysis.task.of_map
    assert workspace.card(analysis.task, analysis.chosen.index).std() < 60
    assert analysis.ranking.relevant is None  # the data set's places are not in the index


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["INDEX", "--model", "MODEL"], "tiles and no queries"),
        (["INDEX", "--model", "MODEL", "--index", "x"], "is an index, and --index fits a flight; leave it out"),
        (["DATA", "--model", "MODEL", "--map", "y", "--index", "INDEX"], "is a data set, and --map fits"),
        (["DATA", "--model", "MODEL", "--data", "DATA"], "is a data set, and --data fits"),
    ],
)
def test_mistakes_get_one_sentence(
    options: list[str], said: str, index: Path, data: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"INDEX": index, "MODEL": model_file, "DATA": data}
    assert main(["explore", "--port", "0", *(str(places.get(option, option)) for option in options)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert error.strip().count("\n") == 0


def test_an_index_of_drone_tiles_is_a_gallery_for_satellite_queries(
    data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The model has one branch for queries and one for the gallery; the index has the fingerprint of this task alone."""
    model = GateModel(replace(GATES, roles="role", groups=()))
    monkeypatch.setattr(lpn, "load", lambda *_, **__: model)
    tiles = data / "test" / "gallery_drone"
    described = ("describe", "--model", "m.pth", "--images", tiles, "--view", "drone", "--role", "gallery")
    _run(*described, "--out", tmp_path / "store")
    _run("index", "--descriptors", tmp_path / "store", "--out", tmp_path / "tiles")
    task = open_source(SourceOptions(source=str(tmp_path / "tiles"), model=Path("m.pth"), data=data)).tasks[
        "satellite-to-drone"
    ]
    live = open_model(data, model).tasks["satellite-to-drone"]
    weights = np.full(3, 1 / 3, np.float32)
    ours, theirs = (one.start_search(0, one.query_descriptors[0])(weights) for one in (task, live))
    found = [task.gallery[i].path for i in ours.order]
    assert found == [live.gallery[i].path for i in theirs.order]
