from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from explorer.failure_lab import messages
from explorer.failure_lab.map_drawing import DrawnMap, draw
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.messages import OpenPoint, SelectRectangle, ShowMap
from explorer.failure_lab.service import FailureLab, Findings, MapPoints
from explorer.failure_lab.state import LabState
from lpn.drawing import theme


def plane(count: int = 9, zoomed: bool = False, selected: list[int] | None = None) -> tuple[DrawnMap, np.ndarray]:
    """Queries on a diagonal, every third of them failed."""
    places = np.column_stack([np.arange(count), np.arange(count)]).astype(float)
    failed = np.arange(count) % 3 == 0
    mask = np.isin(np.arange(count), range(count) if selected is None else selected)
    points = MapPoints(places, places + 0.25)
    return draw(points, failed, mask, np.zeros(count, np.int64), (400, 300), zoomed), failed


def test_a_rectangle_holds_the_queries_drawn_in_it() -> None:
    drawn, _ = plane()
    assert drawn.picture.shape == (600, 800, 3)
    # y points upwards in the plane, so the upper right of the picture holds the larger numbers.
    assert drawn.inside((0.5, 0.5), (1, 0)).tolist() == [5, 6, 7, 8]
    assert drawn.inside((1, 0), (0.5, 0.5)).tolist() == [5, 6, 7, 8]
    assert drawn.inside((0, 0), (0.3, 0.3)).tolist() == []
    assert drawn.inside((0, 0), (1, 1)).tolist() == list(range(9))


def test_found_and_failed_queries_have_different_shapes() -> None:
    drawn, failed = plane()
    west, south, east, north = drawn.bounds
    for row, bad in enumerate(failed):
        x, y = (row - west) / (east - west), (north - row) / (north - south)
        assert drawn.near(x, y).tolist() == [row]
        column, line = round(x * 800), round(y * 600)
        patch = drawn.picture[line - 12 : line + 13, column - 12 : column + 13].reshape(-1, 3)
        shown, other = (theme.FALSE_COLOUR, theme.TRUE_COLOUR)[:: 1 if bad else -1]
        count = int((patch == shown).all(axis=1).sum())
        assert count > 20
        assert not (patch == other).all(axis=1).any()
        beside = drawn.picture[line, column + 5]
        assert tuple(beside) != theme.FALSE_COLOUR  # a cross has nothing there, a dot has
        assert (tuple(beside) == theme.TRUE_COLOUR) == (not bad)
    assert drawn.near(0.02, 0.02).tolist() == []


def test_zooming_shows_selected_queries_only_and_clicks_prefer_them() -> None:
    drawn, _ = plane(zoomed=True, selected=[3, 4])
    assert drawn.inside((0, 0), (1, 1)).tolist() == [3, 4]
    places = np.zeros((4, 2))
    chosen = np.array([False, True, False, True])
    same = draw(MapPoints(places, places), chosen, chosen, np.zeros(4, np.int64), (400, 300), False)
    assert same.near(0.5, 0.5).tolist() == [1, 3]


def test_a_place_of_several_queries_shows_the_share_that_failed() -> None:
    places = np.zeros((4, 2))
    ground = np.full((10, 10, 3), 200, np.uint8), (-100.0, -100.0, 100.0, 100.0)
    failed = np.array([True, False, False, False])
    points = MapPoints(places, places, ground=ground)
    drawn = draw(points, failed, np.ones(4, bool), np.full(4, -1), (400, 300), False)
    patch = drawn.picture[280:321, 380:421].reshape(-1, 3)
    blue, yellow = (int((patch == colour).all(axis=1).sum()) for colour in (theme.FALSE_COLOUR, theme.TRUE_COLOUR))
    assert blue / (blue + yellow) == pytest.approx(0.25, abs=0.06)
    assert tuple(drawn.picture[500, 400]) == (100, 100, 100)  # the ground, dimmed


def test_no_line_leads_to_an_answer_without_a_position() -> None:
    ground = np.full((10, 10, 3), 200, np.uint8), (-100.0, -100.0, 100.0, 100.0)
    points = MapPoints(np.zeros((1, 2)), np.array([[np.nan, np.nan], [50.0, 50.0]]), ground=ground)
    nowhere, none, there = (
        draw(points, np.ones(1, bool), np.ones(1, bool), np.array([answer]), (400, 300), False, 0).picture
        for answer in (0, -1, 1)
    )
    np.testing.assert_array_equal(nowhere, none)
    assert (nowhere != there).any()


def test_a_map_is_kept_until_something_on_it_changes(service: FailureLab, findings: Findings, lab: LabState) -> None:
    view, rows = MapPage(service, "me"), findings.table.rows()
    for kind in ("pca", "ground"):
        shown = replace(lab, map=kind)
        for _ in range(50):
            html, ready = view.page(findings, shown, 0, rows, (760, 400))
            if ready:
                break
        assert f'data-map="{kind}"' in html
        drawn = view.drawn
        assert drawn is not None
        assert view.page(findings, shown, 0, rows, (760, 400))[0] == html
        assert view.drawn is drawn
        view.page(findings, shown, 1, rows, (760, 400))
        assert view.drawn is not drawn
        assert view.queries_at(findings, replace(lab, map="umap"), OpenPoint(kind, (0.5, 0.5))) is None
        chosen = view.select_rectangle(shown, SelectRectangle(kind, (0, 0), (1, 1)))
        assert chosen.selections[0].rows.tolist() == list(range(13))
        assert view.select_rectangle(shown, SelectRectangle("umap", (0, 0), (1, 1))) is shown
        for wrong in ([kind, [0, 0]], [kind, [0, 0], [2, 1]], None):
            assert messages.decode("lab-rect", wrong) is None
    without_places = replace(findings, task=replace(findings.task, geometry=None))
    assert messages.apply(ShowMap("ground"), lab, without_places) is lab


def test_a_click_may_come_while_the_map_is_replaced(
    service: FailureLab, findings: Findings, lab: LabState, monkeypatch: pytest.MonkeyPatch
) -> None:
    view, (drawn, _) = MapPage(service, "me"), plane(13)
    for ask in (
        lambda: view.queries_at(findings, lab, OpenPoint("pca", (0.5, 0.5))),
        lambda: view.select_rectangle(lab, SelectRectangle("pca", (0, 0), (1, 1))),
    ):
        values = iter([drawn, None])  # another thread removes the map between two reads
        monkeypatch.setattr(MapPage, "drawn", property(lambda _, values=values: next(values)), raising=False)
        assert ask() is not None
