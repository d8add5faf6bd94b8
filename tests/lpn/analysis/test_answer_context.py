"""Tests of the sentences that compare one answer with all answers of its task."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from lpn.analysis import answer_context, breakdown
from lpn.analysis.answer_context import AlikeAnswers
from lpn.core.tables import Column, Table, number_column, text_column
from lpn.retrieval.metrics import Retrieval
from lpn.tasks.query_outcomes import Outcomes

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


def retrieval(first: np.ndarray, gap: np.ndarray) -> Retrieval:
    return Retrieval(first, first, first, gap, gap, 10)


def test_answers_of_a_like_gap_are_counted() -> None:
    # Right from a gap of 500 on; whole numbers have no rounding.
    gap = np.arange(1000.0)
    ranking = retrieval(np.where(gap >= 500, 0, 3), gap)
    assert answer_context.answers_alike(ranking, 900.1) == AlikeAnswers(100, 100)
    assert answer_context.answers_alike(ranking, 900) == AlikeAnswers(101, 101), "two are equally near"
    assert answer_context.answers_alike(ranking, 0) == AlikeAnswers(100, 0)
    assert answer_context.answers_alike(ranking, -1) == AlikeAnswers(100, 0), "no surer than the least of them"
    assert answer_context.answers_alike(ranking, 999.1) is None, "nothing was as far ahead"
    assert answer_context.answers_alike(ranking, 499.5) == AlikeAnswers(100, 50)
    # The query itself does not count, and neither does a query of unknown truth.
    assert answer_context.answers_alike(ranking, 900.1, besides=900) == AlikeAnswers(99, 99)
    known = np.arange(1000) % 4 != 0
    assert answer_context.answers_alike(ranking, 901.3, known) == AlikeAnswers(75, 75)
    # Many answers have the same gap.
    assert answer_context.answers_alike(retrieval(ranking.first, np.floor(gap / 250)), 2) == AlikeAnswers(250, 250)
    # A tenth is fewer than 50, so it is 50.
    assert answer_context.answers_alike(retrieval(ranking.first[:200], gap[:200]), 100.1) == AlikeAnswers(50, 0)


def test_queries_of_like_leads_are_counted_in_equal_groups() -> None:
    gap = np.arange(200.0)[::-1].copy()
    gap[7] = np.nan
    groups = answer_context.found_by_lead(retrieval(np.where(gap >= 100, 0, 2), gap))
    assert [one.queries for one in groups] == [20] * 9 + [19]
    assert [one.found for one in groups] == [0] * 5 + [20] * 4 + [19]
    assert groups[0].lead == 9.5
    assert not answer_context.found_by_lead(retrieval(np.zeros(200, int), gap), np.arange(200) < 90)


def test_too_few_answers_have_none_alike() -> None:
    gap = np.arange(120) / 120.0
    ranking = retrieval(np.zeros(120, np.int64), gap)
    assert answer_context.answers_alike(ranking, 0.5) is not None
    assert answer_context.answers_alike(ranking, None) is None, "there is no second tile"
    assert answer_context.answers_alike(ranking, 0.5, np.arange(120) < 99) is None
    assert answer_context.answers_alike(retrieval(ranking.first, np.full(120, np.nan)), 0.5) is None


def test_an_answer_s_distance_is_set_beside_those_of_right_answers_and_of_absent_places() -> None:
    rng = np.random.default_rng(1)
    queries, gallery = (rng.normal(size=(count, 2, 3)).astype(np.float32) for count in (30, 40))
    queries, gallery = (side / np.linalg.norm(side, axis=2, keepdims=True) / np.sqrt(2) for side in (queries, gallery))
    first = np.where(np.arange(30) < 24, 0, 5)
    true, false = np.arange(30), np.arange(10, 40)
    known = np.arange(30) != 3
    gap = np.zeros(30)
    measured = answer_context.answer_distances(queries, gallery, Retrieval(first, true, false, gap, gap, 40), known)
    kept = [i for i in range(24) if i != 3]
    expected = ((queries[kept] - gallery[kept]) ** 2).sum(axis=(1, 2))
    np.testing.assert_allclose(measured.right, expected, atol=1e-5)
    assert len(measured.absent) == 29
    middle = float(np.median(expected)) + 1e-4
    shares = (measured.right < middle).mean(), (measured.absent >= middle).mean()
    assert measured.farther(middle) == shares
    assert measured.farther(4.1) == (1.0, 0.0)
    assert replace(measured, right=expected[:5]).farther(4.1) is None


def test_the_kind_that_fails_most_is_named_if_it_is_no_chance(outcomes: Outcomes) -> None:
    wrong, places = outcomes.failed, np.arange(COUNT)
    low = number_column("altitude", np.where(wrong | (places < 5), 50.0, 200.0).tolist(), "m")
    said = answer_context.describe_failures(outcomes, table(low), places)
    assert said.startswith(
        "The first answer is wrong for 20 of 100 pictures. It fails most for pictures whose altitude is 50 m: 20 of "
    )
    # Were all pictures of four places, nothing would be known of them.
    assert answer_context.describe_failures(outcomes, table(low), places // 25).endswith(
        "no kind of picture fails more often than by chance."
    )
    assert answer_context.describe_failures(outcomes, table(low), places, ["altitude"]).endswith("20 of 100 pictures.")


@pytest.mark.parametrize(
    ("counts", "expected"),
    [((3, 3, 3, 6), 1 / 20), ((0, 2, 3, 9), 1.0), ((2, 2, 3, 9), 3 / 36), ((1, 2, 3, 9), 1 - 15 / 36)],
)
def test_the_chance_of_a_group_is_that_of_drawing_it(counts: tuple[int, int, int, int], expected: float) -> None:
    assert breakdown.chance(*counts) == pytest.approx(expected)


def test_queries_of_a_place_that_fail_together_count_as_one() -> None:
    labels = np.repeat(np.arange(50), 4)
    assert breakdown.design_effect(labels % 2 == 0, labels) == pytest.approx(4.0)
    assert breakdown.design_effect(np.tile([True, False, False, False], 50), labels) == 1.0
    assert breakdown.design_effect(labels % 2 == 0, np.arange(200)) == 1.0
