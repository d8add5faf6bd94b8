"""Tests of the order of wrong answers, and of what is measured of one."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from lpn.analysis.wrong_answers import worst_first
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
