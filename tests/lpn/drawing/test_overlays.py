"""Tests of heat and evidence over pictures."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from lpn.drawing import overlays


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
