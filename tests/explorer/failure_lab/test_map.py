from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from explorer.feeds import Feeds
from explorer.failure_lab import map_data, messages
from explorer.failure_lab import service as lab_service
from explorer.failure_lab.map_layout import MapRoom, map_room
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.messages import MAX_CORNERS, ColourBy, LabMessage, OpenPoint, SelectLasso, ShowMap
from explorer.failure_lab.service import FailureLab, Findings, MapPoints
from explorer.failure_lab.state import LabState
from explorer.server.picture_route import PREFIX
from explorer.web.messages import decode
from explorer.workspace import Workspace
from lpn.analysis import embedding_map
from lpn.core.arrays import Int64Array
from lpn.core.tables import number_column, text_column
from lpn.drawing import theme

SQUARE = np.array([(-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0)])


@pytest.fixture
def view(service: FailureLab, workspace: Workspace) -> MapPage:
    return MapPage(service, Feeds(workspace), "me")


def shown(view: MapPage, findings: Findings, lab: LabState, query: int | None, rows: Int64Array) -> tuple[str, str]:
    """The map when it has been computed."""
    for _ in range(50):
        drawn = view.page(findings, lab, query, rows, (760, 400))
        if drawn.final:
            return drawn.maps, drawn.script
    raise AssertionError("the map is not computed")


def test_a_lasso_holds_the_points_inside_it() -> None:
    points = np.array([(0.0, 0.0), (0.9, -0.9), (1.1, 0.0), (np.nan, np.nan)])
    assert embedding_map.inside(points, SQUARE).tolist() == [0, 1]
    # A line that crosses itself leaves its middle out: the even-odd rule.
    angles = np.array([0, 2, 4, 1, 3]) * 2 * np.pi / 5
    star = np.column_stack([np.sin(angles), np.cos(angles)])
    assert embedding_map.inside(np.array([(0.0, 0.0), (0.0, 0.7), (0.0, -0.7)]), star).tolist() == [1]


def test_places_have_their_own_scale_and_unknown_ones_stay_unknown() -> None:
    far = np.array([(4e6, 5e6), (4e6 + 10.0, 5e6), (np.nan, np.nan)])
    points = MapPoints(far, far[:1] + np.array([0.0, 4.0]))
    drawn = np.frombuffer(map_data.plane(points), "<f4").reshape(4, 2)
    origin, unit = map_data.scale(points)
    np.testing.assert_allclose(drawn[:2] * unit + origin, far[:2], atol=1e-5)
    assert np.abs(drawn[[0, 1, 3]]).max() == 1
    assert np.isnan(drawn[2]).all()


def test_a_map_of_the_ground_knows_the_degrees_of_its_units(service: FailureLab, findings: Findings) -> None:
    job = service.points("ground", findings.task.name, "me")
    assert job is not None
    assert job.wait(60)
    points = job.value
    assert points is not None
    assert points.origin is not None
    assert findings.task.geometry is not None
    drawn = np.frombuffer(map_data.plane(points), "<f4").reshape(-1, 2)[len(points.queries) :].astype(np.float64)
    (latitude, north), (longitude, east) = map_data.degrees(points, points.origin)
    places = [(place.latitude, place.longitude) for place in findings.task.geometry.tiles]
    found = np.column_stack([latitude + drawn[:, 1] * north, longitude + drawn[:, 0] * east])
    np.testing.assert_allclose(found, places, rtol=0, atol=1e-8)


def test_a_rendered_place_has_metres_in_place_of_degrees(
    view: MapPage, service: FailureLab, findings: Findings, monkeypatch: pytest.MonkeyPatch
) -> None:
    rows, lab = findings.table.rows(), LabState(task=findings.task.name, tab="maps", map="ground")
    for rendered in (False, True):
        monkeypatch.setattr(lab_service, "shows_rendered", lambda _, rendered=rendered: rendered)
        points = service._points("ground", findings.task, lambda *_: None)
        ground = view._data(findings, lab, None, rows, [points])["ground"]
        assert (ground["degrees"] is None) == rendered
        origin, unit = map_data.scale(points)
        assert (ground["middle"], ground["metres"]) == (origin.tolist(), unit)


def test_a_column_gives_colours_and_counts_of_the_selected_queries(findings: Findings) -> None:
    outcome = map_data.colours(findings, map_data.OUTCOME)
    failed = findings.outcomes.failed
    assert outcome.codes.tolist() == failed.astype(int).tolist()
    assert outcome.palette == [theme.css(theme.TRUE_COLOUR), theme.css(theme.FALSE_COLOUR)]
    rows = np.array([0, 3, 4])
    assert map_data.counted(outcome, rows) == [int((~failed[rows]).sum()), int(failed[rows].sum()), 0]
    words = map_data.colours(findings, "weather")
    values = findings.table.columns["weather"].values
    assert [words.labels[code] for code in words.codes] == values.tolist()
    assert sum(map_data.counted(words, findings.table.rows())) == 13


def test_few_far_numbers_and_rare_words_do_not_take_all_colours(findings: Findings) -> None:
    numbers = np.r_[np.linspace(0, 1, 11), 1e9, np.nan]
    many = [f"w{i // 2}" for i in range(12)]
    table = findings.table.with_columns(
        [
            number_column("n", numbers, "m"),
            text_column("t", [*many, ""]),
            text_column("u", [f"v{i}" for i in range(13)]),
        ]
    )
    findings = replace(findings, table=table)
    coloured = map_data.colours(findings, "n")
    assert coloured.codes[12] == map_data.UNKNOWN
    assert (np.diff(coloured.codes[:12].astype(int)) >= 0).all()
    assert coloured.ends is not None
    assert coloured.ends[1].startswith("≥ ")
    assert map_data.counted(coloured, table.rows()) == [1]
    few = map_data.colours(findings, "t")
    assert few.labels == [f"w{i}" for i in range(6)]
    assert few.codes[12] == map_data.UNKNOWN
    lots = map_data.colours(findings, "u")
    assert lots.labels[-1] == "5 others"
    assert (lots.codes == map_data.OTHER).sum() == 5
    assert len(lots.palette) == len(lots.labels) == 9


def test_flags_and_lines_tell_what_is_selected_and_how_it_failed(findings: Findings) -> None:
    outcomes = findings.outcomes
    rows = np.flatnonzero(outcomes.failed)[:2]
    flags = np.frombuffer(map_data.flags(findings, rows, rows[:1]), np.uint8)
    assert np.flatnonzero(flags & map_data.SELECTED).tolist() == rows.tolist()
    assert np.flatnonzero(flags & map_data.CHOSEN).tolist() == rows[:1].tolist()
    assert (flags & map_data.FAILED > 0).tolist() == outcomes.failed.tolist()
    places = np.zeros((13, 2))
    ground = np.zeros((2, 2, 3), np.uint8), (0.0, 0.0, 1.0, 1.0)
    points = MapPoints(places, places.copy(), ground=ground)
    assert map_data.lines(findings, points, rows) == [[int(row), int(outcomes.answer[row])] for row in rows]
    points.tiles[outcomes.answer[rows[0]]] = np.nan  # no line leads to an answer without a position
    assert [query for query, _ in map_data.lines(findings, points, rows)].count(rows[0]) == 0
    assert map_data.lines(findings, replace(points, ground=None), rows) == []


def test_a_map_is_published_again_only_where_something_changed(
    view: MapPage, findings: Findings, lab: LabState
) -> None:
    rows = findings.table.rows()
    for kind in ("pca", "ground"):
        state = replace(lab, map=kind)
        html, script = shown(view, findings, state, 0, rows)
        assert f'data-map="{kind}"' in html
        published = {name: feed for name, (_, feed) in view._published.items()}
        feed = published["plane 0"]
        piece = view._feeds.find(f"/{view._feeds.address}{feed}0".removeprefix(PREFIX))
        assert piece is not None
        assert len(piece().data) == 8 * (13 + len(findings.task.gallery))
        assert shown(view, findings, state, 0, rows) == (html, script)
        # The script fills a canvas of another height again.
        assert view.page(findings, state, 0, rows, (860, 700)).script != script
        shown(view, findings, replace(state, colour="weather"), 1, rows[:4])
        changed = {name for name, (_, feed) in view._published.items() if feed != published[name]}
        assert changed == {"flags", "codes"}
    assert "ground" in view._published
    view.leave()
    ended = view._feeds.find(f"/{view._feeds.address}{feed}0".removeprefix(PREFIX))
    assert ended is not None
    assert ended().data == b""


def test_a_lasso_and_a_click_belong_to_the_map_that_is_shown(
    view: MapPage, findings: Findings, lab: LabState, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown(view, findings, lab, 0, findings.table.rows())
    corners = [(2.0, -2.0), (2.0, 2.0), (-2.0, 2.0), (-2.0, -2.0)]
    selected = view.select_lasso(lab, SelectLasso("pca", corners))
    assert selected.selections[0].rows == tuple(range(13))
    assert selected.selections[0].label == "lasso on the PCA"
    assert view.select_lasso(lab, SelectLasso("ground", corners)) is lab
    rows = view.queries_at(findings, lab, OpenPoint("pca", 4))
    assert rows is not None
    assert 4 in rows
    assert view.queries_at(findings, lab, OpenPoint("pca", 13)) is None
    assert view.queries_at(findings, replace(lab, map="umap"), OpenPoint("pca", 4)) is None
    points = view._points
    asks: tuple[Callable[[], object], ...] = (
        lambda: view.queries_at(findings, lab, OpenPoint("pca", 4)),
        lambda: view.select_lasso(lab, SelectLasso("pca", corners)),
    )
    for ask in asks:
        values = iter([points, None])  # another thread removes the map between two reads
        monkeypatch.setattr(MapPage, "_points", property(lambda _, values=values: next(values)), raising=False)
        assert ask() is not None


def test_a_map_is_drawn_as_large_as_the_window_allows() -> None:
    tall = map_room((748, 888), 0.53)
    assert tall.beside
    assert tall.height > 800
    assert 0.5 < tall.width / tall.height < 0.65
    wide = map_room((748, 440), 3.0)
    assert not wide.beside
    assert wide.width > 700
    assert wide.height < 240
    # Two maps share the width, and a phone has its controls above.
    assert map_room((748, 888), 1.0, 2).width <= 356
    assert map_room((380, 400), 0.5) == MapRoom(344, 460)
    for window, proportion in (((320, 320), 1e9), ((10_000, 320), 1e-9), ((748, 440), 1.0)):
        room = map_room(window, proportion)
        assert min(room.width, room.height) >= 150
        assert room.width <= window[0]


def test_wrong_messages_of_a_map_change_nothing(findings: Findings, lab: LabState) -> None:
    wrong = ([[0, 0]] * 2, [[0, 0]] * (MAX_CORNERS + 1), [[0, 1e9]] * 3, [[0, "1"]] * 3, None)
    for corners in wrong:
        assert decode(LabMessage, "lab-lasso", ["pca", corners]) is None
    assert decode(LabMessage, "lab-point", ["pca", 2]) == OpenPoint("pca", 2)
    for row in (-1, 1.5, "1", None):
        assert decode(LabMessage, "lab-point", ["pca", row]) is None
    assert messages.apply(ColourBy("no column"), lab, findings) is lab
    assert messages.apply(ColourBy("weather"), lab, findings).colour == "weather"
    without_places = replace(findings, task=replace(findings.task, geometry=None))
    assert messages.apply(ShowMap("ground"), lab, without_places) is lab
