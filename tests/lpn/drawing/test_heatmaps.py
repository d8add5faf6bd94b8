"""Tests of the heatmaps of parts: their colours, colour bars, and panels."""

from __future__ import annotations

import base64
import re

import cv2
import numpy as np
import pytest

from lpn.core.arrays import UInt8Array
from lpn.drawing import heatmaps, overlays
from lpn.drawing.heatmaps import PictureActivation
from lpn.drawing.words import Vocabulary, speaking


def decoded(uri: str) -> UInt8Array:
    """Return a PNG's pixels as RGBA."""
    data = np.frombuffer(base64.b64decode(uri.partition(",")[2]), np.uint8)
    return np.asarray(cv2.cvtColor(cv2.imdecode(data, cv2.IMREAD_UNCHANGED), cv2.COLOR_BGRA2RGBA))


def pair(n: int, size: tuple[int, int] = (60, 60)) -> list[PictureActivation]:
    maps = np.random.default_rng(0).random((2, n, 4, 4)).astype(np.float32)
    maps[:, :, 0, 0] = np.nan
    maps[1] += 10
    return [
        PictureActivation(name, maps[i], np.zeros((*size, 3), np.uint8)) for i, name in enumerate(("query", "tile"))
    ]


def bars(html: str) -> list[list[str]]:
    """Return the labels of each colour bar."""
    drawn = re.findall(r'<svg class="colours".*?</svg>', html, re.DOTALL)
    return [labels for svg in drawn if (labels := re.findall(r">([^<>\s]+)</text>", svg))]


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


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (30.0, 75.0, ["30", "52", "75"]),
        (-1.5, 0.5, ["−1.5", "−0.5", "0.5"]),
        (0.0, 3.4, ["0.0", "1.7", "3.4"]),
        (1000.0, 3000.0, ["1000", "2000", "3000"]),
        (-0.004, 19.0, ["0.0", "9.5", "19.0"]),
        (1e-7, 3e-7, ["1e−7", "2e−7", "3e−7"]),
        (-2e6, 2e6, ["−2e6", "0", "2e6"]),
    ],
)
def test_a_colour_bar_names_its_ends_and_its_middle(low: float, high: float, labels: list[str]) -> None:
    bar = heatmaps.colour_bar(low, high)
    assert bar.ticks == [(0.0, labels[0]), (50.0, labels[1]), (100.0, labels[2])]
    gradient = decoded(bar.picture)[0]
    np.testing.assert_array_equal(gradient[0], overlays.heat_cells(np.array([[low]]), low, high)[0, 0])
    np.testing.assert_array_equal(gradient[-1], overlays.heat_cells(np.array([[high]]), low, high)[0, 0])


@pytest.mark.parametrize(
    ("low", "high", "labels"),
    [
        (10.0, 10.002, ["10.0000", "10.0020"]),
        (-12345.0, 0.0, ["−12345", "0"]),
        (-1.25e-7, 3e-7, ["−1.25e−7", "3e−7"]),
    ],
)
def test_long_labels_leave_out_the_middle(low: float, high: float, labels: list[str]) -> None:
    assert heatmaps.colour_bar(low, high).ticks == [(0.0, labels[0]), (100.0, labels[1])]


def test_a_part_of_one_value_has_one_label() -> None:
    assert heatmaps.colour_bar(1234.5, 1234.5).ticks == [(50.0, "1234.5")]
    assert heatmaps.colour_bar(-1e-7, -1e-7).ticks == [(50.0, "−1e−7")]
    assert heatmaps.colour_bar(999.99999, 1000.00001).ticks == [(50.0, "1000.00")]
    assert heatmaps.colour_bar(2.5, 2.5).ticks == [(50.0, "2.5")]
    assert heatmaps.colour_bar(0.0, 0.0).ticks == [(50.0, "0")]


@pytest.mark.parametrize("n", [1, 2, 4, 8])
def test_each_part_of_both_pictures_has_a_heatmap_with_a_scale_of_its_own(n: int) -> None:
    html = heatmaps.draw(pair(n), [str(part) for part in range(n)])
    assert html.count('class="photo"') == 2
    assert html.count('class="cells"') == 2 * n
    labels = bars(html)
    assert len(labels) == 2 * n
    for query, tile in zip(labels[::2], labels[1::2], strict=True):
        assert float(query[-1]) < 2 < 10 <= float(tile[0])


def test_a_shared_scale_is_shared_by_query_and_tile_of_each_part() -> None:
    pictures = pair(3)
    labels = bars(heatmaps.draw(pictures, ["a", "b", "c"], shared=True))
    assert labels[::2] == labels[1::2]
    low, high = (float(edge(picture.maps[1])) for picture, edge in zip(pictures, (np.nanmin, np.nanmax), strict=True))
    assert float(labels[2][0]) == pytest.approx(low, abs=0.06)
    assert float(labels[2][-1]) == pytest.approx(high, abs=0.06)


def test_names_are_escaped_and_panoramas_are_three_in_a_row() -> None:
    wide = heatmaps.draw(pair(4, (40, 200)), ["<b>", "2", "3", "4"])
    assert "part &lt;b&gt;" in wide
    assert "<b>" not in wide
    assert "--in-a-row:3;--aspect:200 / 40" in wide
    assert "--in-a-row:5;" in heatmaps.draw(pair(4), list("abcd"))
    assert "--in-a-row:5;" in heatmaps.draw(pair(8), list("abcdefgh"))
    assert "--in-a-row:2;" in heatmaps.draw(pair(1), ["1 whole"])


def test_only_the_strong_cells_of_a_lead_are_painted() -> None:
    picture = np.full((40, 40, 3), 90, np.uint8)
    cells = np.full((20, 20), 0.01)
    cells[:2], cells[-2:] = 1.0, -1.0
    drawn = overlays.with_lead(picture, cells, ((255, 200, 30), (70, 120, 240))).astype(int)
    assert drawn[0, 0, 0] > drawn[0, 0, 2] + 80
    assert drawn[-1, 0, 2] > drawn[-1, 0, 0] + 80
    assert abs(drawn[20, 20] - 90).max() <= 1, "a weak cell shows the picture"
    still = overlays.with_lead(picture, np.zeros((20, 20)), ((255, 200, 30), (70, 120, 240)))
    assert abs(still.astype(int) - 90).max() <= 1


def test_plain_words_name_parts_and_activation_as_the_page_does() -> None:
    with speaking(Vocabulary(plain=True, part="ring")):
        plain = heatmaps.draw(pair(2), ["1 centre", "2 outer"])
        said = heatmaps.note(2)
    assert 'title="ring 1 centre"' in plain
    assert "where the model reacts, ring 1 centre" in plain
    assert "ring by ring" in said
    assert not re.search("activation|channel sum|part ", plain.lower() + said.lower())
    assert 'title="part 1 centre"' in heatmaps.draw(pair(2), ["1 centre", "2 outer"])
    assert "channel sum" in heatmaps.note(2)
