"""Tests of the sentences about explanations."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.descriptors.transforms import Change
from lpn.drawing import verdicts
from lpn.explain import Evidence, SideEvidence
from lpn.explain.counterfactual import Effect
from lpn.explain.sweeps import SweepPoint, SweepResult
from lpn.retrieval.scoring import part_weights
from tools.fixtures.tasks import match


def test_reweighting_states_its_effect_on_all_queries() -> None:
    change = np.array([0.7, 0.3], np.float32)
    none = np.zeros(0, np.int64)
    assert verdicts.describe_reweighting(None, None) == "No choice of part weights would put the truth first."
    helped = verdicts.describe_reweighting(change, Effect(50.0, 52.0, np.arange(3), np.arange(1), 100))
    assert "70 : 30 %; over 100 queries it helps: 3 gained, 1 lost, R@1 50.0 to 52.0 %." in helped
    assert "it harms" in verdicts.describe_reweighting(change, Effect(50.0, 49.0, none, np.arange(1), 100))
    assert "neither helps nor harms" in verdicts.describe_reweighting(change, Effect(50.0, 50.0, none, none, 100))


@pytest.mark.parametrize(
    ("known", "judged"),
    [
        (None, "(d² 1.200). So the picture's top should point 0° clockwise from north, a guess that may be wrong."),
        (350.0, "That guess is right, 10° off: the top really points 350° clockwise from north."),
        (30.0, "That guess is roughly right, 30° off: the top really points 30° clockwise from north."),
        (200.0, "That guess is wrong, 160° off: the top really points 200° clockwise from north."),
    ],
)
def test_a_guessed_heading_is_judged_by_the_known_one(known: float | None, judged: str) -> None:
    points = [
        SweepPoint(Change(rotate=angle), match(0, 2, 0.2, True), match(1, 1, top_score, False))
        for angle, top_score in ((90, 0.3), (0, 0.4))
    ]
    sweep = SweepResult("rotation", tuple(points))
    said = verdicts.describe_heading(sweep, ("drone", "satellite"), known)
    assert "the smallest distance to any tile is at 0°" in said
    assert said.endswith(judged)
    assert not verdicts.describe_heading(sweep, ("satellite", "drone"), known)


@pytest.mark.parametrize(
    ("row", "column", "picture", "tile"),
    [(0, 3, "upper right", "north-east"), (3, 0, "lower left", "south-west"), (1, 3, "right", "east")],
)
def test_sides_of_a_tile_are_told_by_the_compass(row: int, column: int, picture: str, tile: str) -> None:
    cells = np.zeros((4, 4))
    cells[row, column] = 1
    if picture == "right":
        cells[2, column] = 1
    assert (verdicts.describe_position(cells, "drone"), verdicts.describe_position(cells, "satellite")) == (
        picture,
        tile,
    )
    assert verdicts.describe_position(np.ones((4, 4)), "drone") == "all around"
    unrolled = np.zeros((4, 16))
    unrolled[:, 14] = 1
    assert verdicts.describe_position(unrolled, "satellite") == "right"
    assert verdicts.describe_position(-np.ones((4, 4)), "drone") == "all around"


def test_a_score_of_constants_is_not_said_to_be_of_places() -> None:
    cells = np.zeros((2, 4, 4))
    cells[:, 0, 3] = -0.1
    found = Evidence(np.array([0.5, 0.6]), part_weights(2), *(SideEvidence(cells, np.array([0.6, 0.7])),) * 2)
    said = verdicts.describe_evidence(found, ["1 centre", "2 outer"], "drone", "satellite")
    assert "most of it by a constant that comes from no cell" in said
    assert "Of the whole score, +0.650 comes from constants" in said
    assert "north-east" not in said


def test_the_sentence_names_the_part_that_adds_most_and_one_that_speaks_against() -> None:
    cells = np.zeros((2, 4, 4))
    cells[1, 0, 3] = 0.8
    side = SideEvidence(cells, np.zeros(2))
    found = Evidence(np.array([-0.2, 0.8]), part_weights(2), side, side)
    said = verdicts.describe_evidence(found, ["1 centre", "2 outer"], "drone", "satellite")
    assert said == (
        "Part 2 outer adds most to the score (+0.400 of +0.300), where the photo's upper right agrees with the tile's "
        "north-east. Part 1 centre speaks against the pair (−0.100)."
    )


def test_cells_on_no_side_are_told_as_places_all_over_the_pictures() -> None:
    east = np.zeros((1, 4, 4))
    east[0, 1:3, 3] = 1.0
    sides = [SideEvidence(cells, np.zeros(1)) for cells in (np.full((1, 4, 4), 1.0), east)]
    said = [
        verdicts.describe_evidence(
            Evidence(np.array([0.8]), part_weights(1), sides[query], sides[tile]), ["whole"], "drone", "satellite"
        )
        for query, tile in ((0, 0), (0, 1), (1, 0))
    ]
    assert said == [
        "The score is +0.800, mainly from places all over both pictures.",
        "The score is +0.800, mainly from where places all over the photo agree with the tile's east.",
        "The score is +0.800, mainly from where the photo's right agrees with places all over the tile.",
    ]
