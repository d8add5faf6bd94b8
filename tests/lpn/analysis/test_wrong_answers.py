"""Tests of the order of wrong answers, and of what is measured of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lpn.analysis.wrong_answers import most_alike, share_of_larger_leads, worst_first
from lpn.core.tables import Table, number_column, text_column
from lpn.tasks.query_outcomes import Outcomes


def outcomes(rank: list[int], margin: list[float]) -> Outcomes:
    tiles = np.zeros(len(rank), np.int64)
    parts = np.array(margin)[:, None]
    return Outcomes(
        np.array(rank), tiles, tiles, tiles, parts, parts[:, 0], tiles, np.ones(1), np.ones(len(rank), bool)
    )


def test_the_farthest_answer_comes_first_and_then_the_last_right_one() -> None:
    found = outcomes([0, 3, -1, 1, 9, 1], [0.3, -0.1, -0.2, -0.1, -0.1, -0.3])
    names = [str(i) for i in range(6)]
    assert worst_first(found, Table(names, [])).tolist() == [2, 4, 1, 5, 3]
    metres = number_column("distance", [0.0, 500.0, np.nan, 7.0, np.nan, 80.0], "m")
    assert worst_first(found, Table(names, [metres])).tolist() == [1, 5, 3, 2, 4]
    of_metadata = text_column("distance", ["near"] * len(names))
    assert worst_first(found, Table(names, [of_metadata])).tolist() == [2, 4, 1, 5, 3]
    unknown = replace(found, known=np.array([True, True, False, True, True, True]))
    assert 2 not in worst_first(unknown, Table(names, []))


def test_a_close_answer_is_one_that_most_leads_exceed() -> None:
    leads = [i / 100 for i in range(40)]
    known = outcomes([0] * 40 + [1], [*leads, -0.035])
    assert share_of_larger_leads(known, 0.035) == pytest.approx(36 / 40)
    assert share_of_larger_leads(outcomes([0, 1], [0.1, -0.1]), 0.0) is None, "one lead tells nothing"


def test_the_place_that_looks_most_alike_is_another_place() -> None:
    gallery = np.zeros((5, 2, 2), np.float32)
    gallery[:, 0, 0] = [0.7, 0.7, 0.5, 0.6, 0.7]
    gallery[:, 1, 0] = [0.7, 0.6, 0.7, 0.1, 0.7]
    labels = np.array([4, 4, 5, 6, -1])
    assert most_alike(gallery, labels, 0) == 5, "neither its own place nor junk"
    assert most_alike(gallery, labels, 0, [1, 0]) == 6
    assert most_alike(gallery[:2], labels[:2], 0) is None
