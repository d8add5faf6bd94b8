"""Tests of the sentences that compare one answer with all answers of its task."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lpn.analysis import answer_context
from lpn.analysis.query_outcomes import Outcomes
from lpn.core.tables import Column, Table, number_column, text_column

COUNT = 100


@pytest.fixture
def outcomes() -> Outcomes:
    """Right answers with leads of 0, 0.01, ... 0.79, and 20 wrong ones."""
    margin = np.arange(COUNT) / 100.0
    wrong = np.arange(COUNT) >= 80
    margin[wrong] = -0.1
    tiles = np.zeros(COUNT, np.int64)
    parts = np.stack([margin, np.zeros(COUNT)], axis=1)
    weights = np.full(2, 0.5)
    return Outcomes(wrong.astype(np.int64), tiles, tiles, tiles, parts, margin, tiles, weights, np.ones(COUNT, bool))


def table(*columns: Column) -> Table:
    names = [str(i) for i in range(COUNT)]
    return Table(names, [text_column("name", names), *columns])


def test_a_lead_is_compared_with_those_of_all_right_answers(outcomes: Outcomes) -> None:
    large = answer_context.describe_lead(outcomes, 0.6)
    assert large == "A lead of 0.600 is larger than that of about three quarters of the model's 80 right answers."
    small = answer_context.describe_lead(outcomes, 0.005)
    assert small == "A lead of 0.005 is smaller than that of almost all of the model's 80 right answers."
    few = replace(outcomes, known=np.arange(COUNT) < 10)
    assert answer_context.describe_lead(few, 0.6) == ""


def test_a_failure_names_the_kind_of_picture_that_fails_most(outcomes: Outcomes) -> None:
    altitude = number_column("altitude", np.where(np.arange(COUNT) >= 70, 240.0, 100.0), "m")
    twins = text_column("twins", ["yes" if i >= 78 else "no" for i in range(COUNT)])
    assert (
        answer_context.describe_failure(outcomes, table(altitude), 90)
        == "Where altitude is 240 m, pictures fail 67 % of the time, against 20 % over all."
    )
    twin = answer_context.describe_failure(outcomes, table(altitude, twins), 90)
    assert twin == (
        "This building has a twin elsewhere, and pictures of such buildings fail 91 % of the time, against 20 % over all."
    )
    assert answer_context.describe_failure(outcomes, table(altitude, twins), 3) == "", "its kind fails seldom"
    assert answer_context.describe_failure(outcomes, table(), 90) == "", "nothing else is known"
