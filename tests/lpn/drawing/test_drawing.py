"""Tests of the charts: they are to scale, add up, and escape their texts."""

from __future__ import annotations

import io
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import cv2
import numpy as np
import pytest
from PIL import Image

import lpn
from lpn.core.arrays import UInt8Array
from lpn.drawing import charts, network_figures, overlays, plots
from lpn.drawing.network_figures import PictureOfView
from lpn.drawing.score_map import score_map
from lpn.models.base import Model
from lpn.retrieval import describe_picture
from tools.fixtures import small_worlds


def rectangles(svg: str) -> list[tuple[float, float]]:
    """Return start and width of each bar in percent."""
    return [(float(x), float(w)) for x, w in re.findall(r'<rect x="([\d.]+)%"[^>]*? width="([\d.]+)%"', svg)]


def test_shares_fill_their_part_of_the_bar() -> None:
    svg = charts.share_bar(np.array([0.5, 0.25, -0.01]), 1.0, ["a", "<b>", "c"])
    assert rectangles(svg) == [(0.0, 50.0), (50.0, 25.0), (75.0, 0.0)]
    assert "part &lt;b&gt;: 0.2500" in svg
    assert "<b>" not in svg


def test_evidence_is_stacked_from_zero_and_its_sum_is_marked() -> None:
    sums = np.array([[0.4, 0.1], [-0.1, -0.3], [-0.1, 0.2]])
    evidence = cast(Any, SimpleNamespace(part_sums=sums, weighted_cosines=sums.sum(axis=0), cosines=np.zeros(2)))
    assert charts.evidence_segments(evidence, 0) == [
        ("cells for", 0.0, 0.4),
        ("cells against", 0.0, -0.1),
        ("constant", -0.1, -0.2),
    ]
    low, high = charts.evidence_span([evidence])
    assert (low, high) == pytest.approx((-0.3, 0.4))
    first = charts.evidence_bars(evidence, (low, high))[0]
    zero = 100 * 0.3 / 0.7
    assert rectangles(first)[0] == pytest.approx((zero, 100 * 0.4 / 0.7), abs=0.01)
    assert float(re.findall(r'x1="([\d.]+)%"[^>]*class="mark"', first)[0]) == pytest.approx(zero + 20 / 0.7, abs=0.01)


def test_cells_run_from_dark_to_bright_and_those_of_other_parts_are_transparent() -> None:
    cells = overlays.heat_cells(np.array([[2.0, 3.0, 4.0, np.nan]]), 2.0, 4.0)
    assert cells.shape == (1, 4, 4)
    assert cells[0, :, 3].tolist() == [255, 255, 255, 0]
    brightness = cells[0, :3, :3].astype(int).sum(axis=1)
    assert brightness[0] < brightness[1] < brightness[2]
    # A cell of value zero is no blank one.
    assert overlays.heat_cells(np.array([[0.0, 1.0]]), 0.0, 1.0)[0, 0, 3] == 255


def test_equal_steps_of_a_value_are_equal_steps_of_colour() -> None:
    colours = overlays.heat_cells(np.linspace(0, 1, 256)[None], 0.0, 1.0)[:, :, :3]
    lab = cv2.cvtColor(colours.astype(np.float32) / 255, cv2.COLOR_RGB2LAB)[0]
    lightness = lab[:, 0]
    assert (np.diff(lightness) > -0.5).all()
    halves = lightness[128] - lightness[0], lightness[255] - lightness[128]
    assert halves[0] == pytest.approx(halves[1], rel=0.25)


def test_weak_heat_is_bare_and_evidence_is_painted_by_its_sign() -> None:
    bare, strong = overlays.heat_colours(np.array([[0.0, 0.3, 0.31, 1.0]]))[0, [1, 3]].astype(int)
    assert (bare[3], strong[3]) == (0, 255)
    against, none, for_it = overlays.heat_colours(np.array([[-0.5, 0.0, 0.5]]), signed=True)[0].astype(int)
    assert none[3] == 0
    assert for_it[0] > for_it[1] + 60 < against[1] + 60 > against[0], "magenta for, green against"
    picture = np.full((4, 8, 3), (200, 100, 50), np.uint8)
    painted = overlays.with_evidence(picture, np.array([[0.0, 1.0]]), 1.0)
    assert len(np.unique(painted[:, :4])) == 1, "no evidence leaves the picture grey"
    np.testing.assert_array_equal(painted[:, 4:], overlays.with_evidence(picture, np.array([[0.0, 2.0]]), 1.0)[:, 4:])


def test_every_window_paints_the_ground_half_way_to_its_neighbours() -> None:
    x, y = np.meshgrid([5.0, 15.0, 25.0], [40.0, 30.0])
    places = np.column_stack([x.ravel(), y.ravel()])
    # Coordinates of a row differ by rounding, and a window is missing.
    places[:3, 1] += (0.0, 1e-9, -1e-9)
    drawn = score_map(places[:5], np.full(5, 40.0), np.arange(5.0))
    assert drawn.bounds == pytest.approx((0.0, 25.0, 30.0, 45.0), abs=1e-6)
    np.testing.assert_array_equal(drawn.cells, [[0, 1, 2], [3, 4, np.nan]])
    assert (drawn.low, drawn.high) == (0.0, 4.0)


def test_the_highest_score_counts_where_windows_of_several_sizes_lie() -> None:
    places = np.array([(10.0, 10.0), (30.0, 10.0), (20.0, 10.0)])
    drawn = score_map(places, np.array([20.0, 20.0, 40.0]), np.array([0.1, 0.9, 0.5]))
    west, south, east, north = drawn.bounds
    assert (west, south, east, north) == pytest.approx((0.0, -10.0, 40.0, 30.0))

    def at(x: float, y: float) -> float:
        rows, columns = drawn.cells.shape
        return float(drawn.cells[int((north - y) / (north - south) * rows), int((x - west) / (east - west) * columns)])

    assert at(5, 10) == 0.5
    assert at(35, 10) == 0.9
    assert at(35, 28) == 0.5


def test_a_lone_window_covers_its_side() -> None:
    drawn = score_map(np.array([(1.0, 2.0)]), np.array([6.0]), np.array([0.3]))
    assert drawn.bounds == pytest.approx((-2.0, -1.0, 4.0, 5.0))
    np.testing.assert_array_equal(drawn.cells, [[0.3]])


def test_no_window_paints_nothing() -> None:
    assert score_map(np.zeros((0, 2)), np.zeros(0), np.zeros(0)) is None


def described(model: Model) -> list[PictureOfView]:
    made = []
    for view in ("drone", "satellite"):
        one = describe_picture(model, small_worlds.place(7), view)
        made.append(PictureOfView(view, one.picture, one.activation, one.descriptor))
    return made


def pixels(data: bytes) -> UInt8Array:
    return np.asarray(Image.open(io.BytesIO(data)).convert("RGB"))


@pytest.fixture
def titles(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """The titles of the panels of each figure that is drawn."""
    drawn: list[list[str]] = []

    def encode(figure: Any, dpi: int) -> bytes:
        drawn.append([cell.get_title() for cell in figure.axes])
        return plots.encode(figure, dpi)

    monkeypatch.setattr(network_figures, "encode", encode)
    return drawn


def test_the_network_is_drawn_with_a_panel_for_each_part(
    model_file: Path, one_part_model_file: Path, titles: list[list[str]]
) -> None:
    widths = {}
    for file in (model_file, one_part_model_file):
        model = lpn.load(file)
        widths[model.n_parts] = pixels(network_figures.network(model, described(model))).shape[:2]
        first, cells, *parts, last = titles[-1][: 3 + model.n_parts]
        rows, columns = model.map_size("drone")
        assert (first, cells) == ("drone: 64 x 64 pixels", f"map: {rows} x {columns} cells")
        assert [title.partition(":")[0] for title in parts] == model.contract.names("drone")
        assert last == f"descriptor: {model.n_parts} x {model.embedding}"
    assert widths == {4: (460, 1470), 1: (460, 840)}


def test_partitions_are_drawn_side_by_side_and_the_model_s_is_named(model_file: Path, titles: list[list[str]]) -> None:
    model = lpn.load(model_file)
    drawn = pixels(network_figures.partitions(model, described(model)))
    assert titles[0][:3] == [
        "drone, square rings (this model)",
        "drone, sequential: columns",
        "drone, sequential: rows",
    ]
    # The three panels show the same picture under other borders.
    thirds = np.array_split(drawn[:230], 3, axis=1)
    assert len({third.tobytes() for third in thirds}) == 3
