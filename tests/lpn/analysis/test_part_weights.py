"""Figures of a whole task under part weights are those of `lpn evaluate` and of a task with these weights."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn.analysis.part_weights import (
    WeightedTask,
    combinations_csv,
    part_combinations,
    weights_of,
    why_not,
)
from lpn.cli import main
from lpn.core.errors import InputError
from lpn.datasets import Truth, open_dataset
from lpn.models.base import normalise
from lpn.retrieval import metrics
from lpn.retrieval.part_ranks import PartRanks
from lpn.tasks.opening import describe_task
from lpn.tasks.query_outcomes import weight_factors

WEIGHTS = ([1, 1, 1, 1], [1, 0, 1, 1], [0, 0, 0, 1], [0.3, 1, 0.7, 0.2])


def sides(queries: int, gallery: int, places: int, junk: bool) -> tuple[np.ndarray, ...]:
    rng = np.random.default_rng(3)
    labels, of_query = rng.integers(0, places, gallery), rng.integers(0, places + 2, queries)
    if junk:
        labels[::7] = -1
    centres = rng.standard_normal((places + 2, 4, 8))
    query, tiles = (
        normalise((centres[side] + 0.9 * rng.standard_normal((len(side), 4, 8))).astype(np.float32))
        for side in (of_query, labels)
    )
    tiles[5] = tiles[4]  # a tie ranks in gallery order
    return query, of_query, tiles, labels


@pytest.mark.parametrize(("queries", "gallery", "places", "junk"), [(300, 90, 90, False), (60, 200, 12, True)])
@pytest.mark.parametrize("weights", WEIGHTS)
def test_ranks_are_those_of_the_whole_ranking(
    weights: list[float], queries: int, gallery: int, places: int, junk: bool
) -> None:
    query, of_query, tiles, labels = sides(queries, gallery, places, junk)
    parts = PartRanks.of(query, tiles, of_query, labels)
    assert parts is not None
    used = np.array(weights) / np.sum(weights)
    first, precision = parts.under(used)
    expected = metrics.retrieve(query, of_query, tiles, labels, None, weight_factors(query, weights))
    np.testing.assert_array_equal(first, expected.first)
    np.testing.assert_array_equal(precision, expected.precision)


@pytest.mark.parametrize("trapezoid", [True, False])
def test_ranks_by_lists_leave_out_their_junk(trapezoid: bool) -> None:
    query, _, tiles, _ = sides(40, 60, 9, False)
    rng = np.random.default_rng(0)
    truth = []
    for query_index in range(40):
        named = rng.permutation(60)[: 2 + query_index % 5]
        truth.append(Truth(good=named[: query_index % 4], junk=named[query_index % 4 :], trapezoid=trapezoid))
    parts = PartRanks.of(query, tiles, None, None, truth)
    assert parts is not None
    first, precision = parts.under(np.array([0.5, 0.25, 0.25, 0]))
    expected = metrics.retrieve(query, None, tiles, None, truth, weight_factors(query, [2, 1, 1, 0]))
    np.testing.assert_array_equal(first, expected.first)
    np.testing.assert_array_equal(precision, expected.precision)


def test_equal_tiles_and_equal_scores_rank_in_gallery_order() -> None:
    tile = normalise(np.ones((1, 4, 8), np.float32))
    tiles, query = np.repeat(tile, 6, axis=0), np.repeat(tile, 6, axis=0)
    parts = PartRanks.of(query, tiles, np.arange(6), np.arange(6))
    assert parts is not None
    first, _ = parts.under(np.full(4, 0.25))
    assert first.tolist() == [0, 1, 2, 3, 4, 5]


def test_an_effect_has_the_figures_of_evaluate_and_counts_the_queries_that_change(
    data: Path, model_file: Path, tmp_path: Path
) -> None:
    task = describe_task(lpn.load(model_file), "lpn", open_dataset(data))
    measured, out = WeightedTask(task), tmp_path / "figures.json"
    for parts in ((1, 2), (4,)):
        effect = measured.effect(weights_of(parts, 4))
        chosen = ",".join(map(str, parts))
        main.main(["evaluate", "--model", str(model_file), str(data), "--parts", chosen, "--json", str(out)])
        expected = json.loads(out.read_text())
        assert [effect.recall, effect.ap] == pytest.approx([expected["recall@1"], expected["ap"]])
        whole = task.metrics
        assert [effect.equal_recall, effect.equal_ap] == pytest.approx([whole["recall@1"], whole["ap"]])
        assert effect.queries == len(task.queries)
        assert effect.recall_difference.value == pytest.approx(100 * (effect.gained - effect.lost) / effect.queries)
        assert effect.ap_difference.value == pytest.approx(effect.ap - effect.equal_ap)
        assert effect.ap_difference.low <= effect.ap_difference.value <= effect.ap_difference.high
    weighed = replace(task, weights=[0.2, 1, 0, 3])
    effect = measured.effect([0.2, 1, 0, 3])
    assert effect.recall == pytest.approx(weighed.metrics["recall@1"])
    assert effect.ap == pytest.approx(weighed.metrics["ap"])
    # Beyond the budget each weighting is ranked anew, with the same figures.
    assert WeightedTask(task, budget=0).effect([0.2, 1, 0, 3]) == effect


def test_progress_stops_the_comparison(data: Path, model_file: Path) -> None:
    measured = WeightedTask(describe_task(lpn.load(model_file), "lpn", open_dataset(data)))

    def stop(_: int, __: int) -> None:
        raise RuntimeError("stopped")

    with pytest.raises(RuntimeError, match="stopped"):
        measured.effect([1, 0, 0, 0], stop)
    assert measured.effect([1, 1, 1, 1]).gained == 0


def test_combinations_are_all_of_four_parts_and_those_of_the_paper_beyond() -> None:
    four = part_combinations(4)
    assert len(four) == len(set(four)) == 15
    assert part_combinations(6) == [
        *((part,) for part in range(1, 7)),
        *[(1, 2), (1, 2, 3), (1, 2, 3, 4), (1, 2, 3, 4, 5), (1, 2, 3, 4, 5, 6)],
    ]
    assert weights_of((1, 3), 4) == (1, 0, 1, 0)


def test_the_table_is_saved_with_each_task_beside_the_other(data: Path, model_file: Path) -> None:
    task = describe_task(lpn.load(model_file), "lpn", open_dataset(data))
    effect = WeightedTask(task).effect([1, 1, 0, 0])
    lines = combinations_csv({(1, 2): {"drone-to-satellite": effect}}).decode().splitlines()
    assert lines[0] == "parts,recall@1 drone-to-satellite,ap drone-to-satellite"
    assert lines[1].split(",")[0] == "1 2"
    assert float(lines[1].split(",")[1]) == pytest.approx(effect.recall)


def test_a_model_of_one_part_says_why_it_has_no_combinations(data: Path, one_part_model_file: Path) -> None:
    task = describe_task(lpn.load(one_part_model_file), "whole", open_dataset(data))
    assert why_not(task) == "The model has one part, so there are no weights to compare."
    with pytest.raises(InputError, match="one part"):
        WeightedTask(task)
