"""An index of tiles in the explorer: opening, links, the laboratory to a depth, and what an index cannot show."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

import lpn
from explorer import reports
from explorer.browse.feeds import Feeds
from explorer.client.address import PageAddress
from explorer.client.messages import Greeting
from explorer.compute import ranking_job
from explorer.explain_window import comparison, evidence
from explorer.explain_window.sweep_request import SweepRequest
from explorer.failure_lab import state as lab_state
from explorer.failure_lab import table as lab_table
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.service import FailureLab
from explorer.failure_lab.state import LabState
from explorer.opening import open_model, open_source
from explorer.panels import answer_text, pages
from explorer.session_state import POSITIVE, SessionState
from explorer.url_state import UrlState
from explorer.workspace import StateAnalyser, Workspace
from lpn.analysis import part_weights
from lpn.analysis.comparison import Comparison, effect_on
from lpn.cli.main import main
from lpn.core.errors import InputError, StoreError
from lpn.flights import write_flight
from lpn.index.shared import SharedIndex
from lpn.index.task import IndexTask
from lpn.library.analyser import OwnPicture
from lpn.maps import NamedWindow
from lpn.sources import Indexed, ModelOptions
from lpn.tasks import turned
from tests.lpn.locate.scenery import FLOWN_PLACES, land, small_flight, write_map
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import GATES, GateModel

TASK = "drone-to-satellite"
DEPTH = 10


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
    return open_source(Indexed(index=str(index), model=ModelOptions(model=model_file), data=data, depth=DEPTH))


def _state(query: int = 0) -> SessionState:
    return SessionState(TASK, 4, query=query)


def _task(workspace: Workspace) -> IndexTask:
    task = workspace.tasks[TASK]
    assert isinstance(task, IndexTask)
    return task


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
    for name in ("recall@1", "recall@5", "recall@10"):
        assert results[name] == live.rankings[TASK].results[name]
    header = pages.header(workspace, workspace.tasks[TASK])
    assert "searched exactly to depth 10 of 14 tiles" in header
    assert "AP: not defined to a depth" in header
    assert "Save this answer" not in header  # a report needs the whole gallery
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


def test_a_sweep_searches_at_every_step(workspace: Workspace, data: Path, model_file: Path) -> None:
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
        assert one.rank == min(other.rank, DEPTH + 1)
        assert one.score == pytest.approx(other.score, abs=1e-5)
        assert one.top_score == pytest.approx(other.top_score, abs=1e-5)
    assert max(point.rank for point in ends[1]) > 1


def test_a_link_names_a_tile_as_the_index_does(workspace: Workspace) -> None:
    links, task = UrlState(workspace), _task(workspace)
    unseen = "0020/0020.png"
    state, problems = links.read(f"?with={unseen}", _state())
    assert not problems
    assert state.selected == task.find_tile(unseen)
    assert links.write(state).endswith(f"with={unseen}")
    assert StateAnalyser(workspace).analyse(state, 10).chosen.index == state.selected
    assert links.read("?with=truth", _state())[0].selected == POSITIVE
    for bad in ("nothing", "~3", "own"):
        state, problems = links.read(f"?with={bad}", _state())
        assert state.selected is None
        assert "no such tile" in problems[0]


def test_a_link_to_a_tile_shows_the_rest_while_the_index_is_away(
    workspace: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    lock, shown, views = threading.Lock(), [_state()], Mock()
    views.show_state.side_effect = shown.append

    def away(*_: object) -> None:
        assert not lock.locked()
        raise StoreError("The index is away; start its server.")

    monkeypatch.setattr(SharedIndex, "holds", away)
    address = PageAddress(workspace, UrlState(workspace), views, lock, lambda: shown[-1], Mock(), None, Mock())
    address.greet(Greeting("?with=nobody-saw-it.png&angle=30"))
    address.leave()
    assert (shown[-1].selected, shown[-1].angle) == (None, 30)
    assert "The index is away" in views.panels.notify_error.call_args[0][1]


def test_the_laboratory_tells_ranks_to_the_depth(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    # Every second query is turned round, so that its true tile is among the farthest.
    signs = np.where(np.arange(len(_task(workspace).queries)) % 2, -1, 1).astype(np.float32)[:, None, None]
    task = replace(_task(workspace), query_descriptors=_task(workspace).query_descriptors * signs)
    monkeypatch.setitem(workspace.tasks, TASK, task)
    monkeypatch.setitem(workspace.rankings, TASK, ranking_job.RankingJob(task))
    service = FailureLab(workspace)
    assert service.build(TASK, "test").wait(60)
    findings = service.findings(TASK)
    assert findings is not None
    assert findings.outcomes.depth == DEPTH
    lab = LabState(task=TASK)
    rows = lab_state.sorted_rows(findings, lab)
    columns = lab_table.visible_columns(findings, lab)
    html = str(lab_table.lines(findings, columns, Feeds(workspace), rows))
    far = np.flatnonzero(findings.outcomes.rank == DEPTH)
    assert 0 < len(far) < len(task.queries)
    assert "&gt; 10" in html
    assert lab_state.confusions(findings, lab) is not None
    view = MapPage(service, Feeds(workspace), "test").page(findings, lab, 0, rows, (760, 400))
    assert view.final
    assert "not in memory" in view.maps


def test_what_an_index_cannot_tell_is_said(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> None:
    analysis = StateAnalyser(workspace).analyse(replace(_state(1), why=True), 10)
    with pytest.raises(InputError, match="needs the whole gallery in memory"):
        reports.of_analysis(workspace, analysis)
    with pytest.raises(InputError, match="takes a search for each"):
        effect_on(analysis.task, None, (1, 1, 1, 0))
    assert "gallery in memory" in part_weights.why_not(analysis.task)
    assert "gallery in memory" in turned.why_not(analysis.task)
    html = comparison.page(analysis, workspace, Comparison.of(analysis.ranking, analysis.matches[1]), None, False)
    assert "among the 10 nearest tiles" in html.replace("\n", " ").replace("    ", "")
    job = ranking_job.RankingJob(_task(workspace))
    assert job.automatic
    monkeypatch.setattr(ranking_job, "AUTOMATIC_COST", 0)
    assert not job.automatic
    monkeypatch.setitem(workspace.rankings, TASK, job)
    assert "“All pictures in a table” (B) starts them" in pages.header(workspace, job.task)


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
    workspace = open_source(
        Indexed(index=str(index), model=ModelOptions(model=model_file), map=town, flight=flight, depth=DEPTH)
    )
    task, analyser = _task(workspace), StateAnalyser(workspace)
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
        window = NamedWindow.parse(task.gallery.name_of(match.index))
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
    np.testing.assert_allclose(
        analysis.tile.descriptor, task.index.read([task.gallery.name_of(analysis.chosen.index)])[0][0], atol=1e-4
    )
    assert workspace.mosaic(analysis.task).shape[2] == 3
    west, south, east, north = analysis.task.geometry.bounds()
    assert (east - west, north - south) == pytest.approx((200, 200), abs=1)
    unknown = analyser.analyse(_state(0), 10)
    assert unknown.ranking.relevant is None
    assert answer_text.verdict(unknown, workspace)[0] is None


def test_windows_without_their_map_are_placeholders(
    flown: tuple[Path, Path, Path], model_file: Path, data: Path
) -> None:
    workspace = open_source(Indexed(index=str(flown[0]), model=ModelOptions(model=model_file), data=data))
    analysis = StateAnalyser(workspace).analyse(replace(_state(0), why=True), 10)
    assert "give that map as --map" in evidence.page(analysis, workspace)
    assert workspace.card(analysis.task, analysis.chosen.index).std() < 60
    assert analysis.ranking.relevant is None  # the data set's places are not in the index


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--index", "INDEX", "--model", "MODEL"], "tiles and no queries"),
        (["--index", "INDEX", "--model", "MODEL", "--flight", "x"], "--flight with --map"),
        (
            ["--index", "INDEX", "--model", "MODEL", "--flight", "x", "--map", "y", "--data", "DATA"],
            "one kind of queries",
        ),
        (["--index", "INDEX", "--model", "MODEL", "--data", "DATA", "--depth", "3"], "depth is 3"),
        (["--index", "DATA", "--model", "MODEL", "--data", "DATA"], "not an index"),
    ],
)
def test_mistakes_get_one_sentence(
    options: list[str], said: str, index: Path, data: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    places = {"INDEX": index, "MODEL": model_file, "DATA": data}
    assert main(["explore", "index", "--port", "0", *(str(places.get(option, option)) for option in options)]) == 2
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
    task = open_source(
        Indexed(index=str(tmp_path / "tiles"), model=ModelOptions(model=Path("m.pth")), data=data, depth=DEPTH)
    ).tasks["satellite-to-drone"]
    live = open_model(data, model).tasks["satellite-to-drone"]
    weights = np.full(3, 1 / 3, np.float32)
    ours, theirs = (one.start_search(0, one.query_descriptors[0])(weights) for one in (task, live))
    found = [task.gallery[i].path for i in ours.order[:DEPTH]]
    assert found == [live.gallery[i].path for i in theirs.order[:DEPTH]]
