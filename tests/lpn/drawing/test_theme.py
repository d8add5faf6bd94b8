from __future__ import annotations

from itertools import combinations

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
# The colours that meet over the workbench's pair, with four rings, and in the window of a flight.
WORKBENCH = ("part-0", "part-1", "part-2", "part-3", "right", "wrong", "unknown", "for", "against", "accent")
FLIGHT = ("tag", "retrieval", "sequence", "registration", "contradicted", "right", "unknown", "by-hand", "accent")


def delta_e(one: theme.Colour, other: theme.Colour, vision: str) -> float:
    """Return the distance of two colours in CIELAB (CIE76), in which 2.3 can just be told apart side by side."""
    return float(np.linalg.norm(_lab(one, vision) - _lab(other, vision)))


def _lab(colour: theme.Colour, vision: str) -> Float64Array:
    share = np.array(colour) / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    seen = np.clip(VISION[vision] @ linear, 0, 1)
    again = np.where(seen <= 0.0031308, 12.92 * seen, 1.055 * seen ** (1 / 2.4) - 0.055)
    return np.asarray(cv2.cvtColor(again.astype(np.float32)[None, None], cv2.COLOR_RGB2LAB)[0, 0], np.float64)


def test_no_two_meanings_share_a_colour() -> None:
    for one, other in combinations(theme.COLOURS, 2):
        assert delta_e(theme.COLOURS[one], theme.COLOURS[other], "normal") > 18, (one, other)


@pytest.mark.parametrize("vision", VISION)
def test_colours_that_are_compared_differ_for_any_vision(vision: str) -> None:
    parts = [theme.part_colour(part) for part in range(8)]
    assert min(delta_e(*pair, vision) for pair in combinations(parts, 2)) > 18
    assert min(delta_e(*pair, vision) for pair in combinations(parts[:4], 2)) > 24
    stages = [theme.COLOURS[name] for name in ("tag", "retrieval", "sequence", "registration", "contradicted")]
    assert min(delta_e(*pair, vision) for pair in combinations(stages, 2)) > 18
    assert delta_e(theme.TRUE_COLOUR, theme.FALSE_COLOUR, vision) > 60
    assert delta_e(theme.FOR, theme.AGAINST, vision) > 60


@pytest.mark.parametrize("vision", VISION)
@pytest.mark.parametrize("screen", [WORKBENCH, FLIGHT], ids=["workbench", "flight"])
def test_colours_that_meet_on_one_screen_differ_for_any_vision(screen: tuple[str, ...], vision: str) -> None:
    for one, other in combinations(screen, 2):
        assert delta_e(theme.COLOURS[one], theme.COLOURS[other], vision) > 15, (one, other)


@pytest.mark.parametrize("palette", [theme.DARK, theme.LIGHT], ids=["dark", "light"])
def test_bars_stand_out_on_their_ground_and_still_differ(palette: theme.Palette) -> None:
    marks = {name: palette.mark(colour) for name, colour in theme.COLOURS.items()}
    assert all(theme.contrast(mark, palette.background) >= theme.MARK_CONTRAST for mark in marks.values())
    parts = [marks[f"part-{part}"] for part in range(4)]
    for vision in VISION:
        for one, other in combinations(WORKBENCH, 2):
            assert delta_e(marks[one], marks[other], vision) > 9, (one, other, vision)
        assert min(delta_e(*pair, vision) for pair in combinations(parts, 2)) > 15, vision
