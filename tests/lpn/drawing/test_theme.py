from __future__ import annotations

from itertools import combinations, pairwise

import cv2
import numpy as np
import pytest

from lpn.core.arrays import Float64Array
from lpn.drawing import theme

# Machado, Oliveira, and Fernandes (2009): linear RGB as people without red, green, or blue cones see it.
VISION = {
    "normal": np.eye(3),
    "protanopia": np.array(
        [[0.152286, 1.052583, -0.204868], [0.114503, 0.786281, 0.099216], [-0.003882, -0.048116, 1.051998]]
    ),
    "deuteranopia": np.array(
        [[0.367322, 0.860646, -0.227968], [0.280085, 0.672501, 0.047413], [-0.011820, 0.042940, 0.968881]]
    ),
    "tritanopia": np.array(
        [[1.255528, -0.076749, -0.178779], [-0.078411, 0.930809, 0.147602], [0.004733, 0.691367, 0.303900]]
    ),
}
# The colours that meet on the screen and in a report, and in the window of a flight.
SCREEN = ("part-0", "part-1", "part-2", "part-3", "right", "wrong", "unknown", "for", "against")
FLIGHT = ("tag", "retrieval", "sequence", "registration", "contradicted", "right", "unknown", "by-hand", "accent")


def delta_e(one: theme.Colour, other: theme.Colour, vision: str) -> float:
    """Return the distance of two colours in CIELAB (CIE76), where 2.3 is just noticeable."""
    return float(np.linalg.norm(_lab(one, vision) - _lab(other, vision)))


def _lab(colour: theme.Colour, vision: str) -> Float64Array:
    share = np.array(colour) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    seen = np.clip(VISION[vision] @ linear, 0, 1)
    again = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    return np.asarray(cv2.cvtColor(again.astype(np.float32)[None, None], cv2.COLOR_RGB2LAB)[0, 0], np.float64)


GROUNDS = pytest.mark.parametrize("palette", [theme.DARK, theme.LIGHT], ids=["dark", "light"])


@GROUNDS
def test_no_two_meanings_that_meet_share_a_colour(palette: theme.Palette) -> None:
    for one, other in combinations(SCREEN, 2):
        assert delta_e(palette.colours[one], palette.colours[other], "normal") > 17, (one, other)


@GROUNDS
@pytest.mark.parametrize(
    ("vision", "least"), [("normal", 53), ("protanopia", 49), ("deuteranopia", 46), ("tritanopia", 25)]
)
def test_neighbouring_rings_differ_for_any_vision(palette: theme.Palette, vision: str, least: float) -> None:
    rings = [theme.part_colour(part, palette) for part in range(5)]
    for one, other in pairwise(rings):
        assert delta_e(one, other, vision) >= least
        assert round(theme.contrast(one, other), 1) >= 2.2
        assert theme.contrast(one, palette.track) >= 3


@GROUNDS
@pytest.mark.parametrize("vision", VISION)
def test_right_and_wrong_and_for_and_against_differ_for_any_vision(palette: theme.Palette, vision: str) -> None:
    right, wrong = (theme.verdict_colour(true, palette) for true in (True, False))
    assert delta_e(right, wrong, vision) > 17, "a sign and a word stand with them"
    assert min(theme.contrast(colour, palette.background) for colour in (right, wrong)) >= theme.MIN_CONTRAST
    assert delta_e(palette.colours["for"], palette.colours["against"], vision) > 40


@pytest.mark.parametrize("vision", ["normal", "deuteranopia"])
@pytest.mark.parametrize("ramp", [theme.HEAT, theme.HEAT_AGAINST], ids=["for", "against"])
def test_heat_is_lighter_in_even_steps(ramp: tuple[tuple[float, ...], ...], vision: str) -> None:
    lightness = [_lab((round(red), round(green), round(blue)), vision)[0] for red, green, blue, _ in ramp]
    assert all(10 < high - low < 27 for low, high in pairwise(lightness))
    assert [stop[3] for stop in ramp] == sorted(stop[3] for stop in ramp), "weak heat shows the picture"


@pytest.mark.parametrize("vision", VISION)
def test_the_stages_of_a_flight_differ_for_any_vision(vision: str) -> None:
    stages = [theme.COLOURS[name] for name in ("tag", "retrieval", "sequence", "registration", "contradicted")]
    assert min(delta_e(*pair, vision) for pair in combinations(stages, 2)) > 18
    for one, other in combinations(FLIGHT, 2):
        assert delta_e(theme.COLOURS[one], theme.COLOURS[other], vision) > 15, (one, other)


@GROUNDS
def test_bars_stand_out_on_their_ground(palette: theme.Palette) -> None:
    marks = [palette.mark(colour) for colour in palette.colours.values()]
    assert all(theme.contrast(mark, palette.background) >= theme.MARK_CONTRAST for mark in marks)
