"""The table of queries that `lpn evaluate` writes, against the scores of a task, and what junk and unknown places do to it."""

from __future__ import annotations

import csv
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import lpn
from lpn.cli import main
from lpn.datasets import Picture, Truth
from lpn.tasks.measure import measure
from tools.fixtures.tasks import descriptor_task

TASK = "drone-to-satellite"


def test_each_query_has_its_rank_precision_and_nearest_tiles(data: Path, model_file: Path, tmp_path: Path) -> None:
    out, options = tmp_path / "deep" / "queries.csv", ["--csls", "3", "--no-calibrate", "--rotate", "90"]
    given = ["evaluate", str(data), "--model", str(model_file), "--task", TASK, "--per-query", str(out)]
    assert main.main([*given, *options]) == 0
    task = lpn.open_task(data, TASK, model_file, csls=3)
    with out.open(newline="", encoding="utf-8") as file:
        turned = list(csv.DictReader(file))
    assert main.main([*given, *options[:-2]]) == 0
    with out.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert [row["query"] for row in rows] == [row["query"] for row in turned] == task.query_names
    assert rows != turned
    assert [row["rank"] for row in rows] == [str(rank + 1) for rank in task.outcomes.rank.tolist()]
    assert np.mean([float(row["ap"]) for row in rows]) == pytest.approx(task.metrics["ap"], abs=1e-4)
    for query, row in enumerate(rows):
        ranking = task.search(query)
        nearest = [task.gallery[match.index].name for match in ranking.top(10)]
        assert [row[f"top {k}"] for k in range(1, 11)] == nearest
        # The term of the query is the same for all tiles, and no part of a score of the evaluation.
        assert ranking.csls is not None
        scores = [match.score + float(ranking.csls.query @ ranking.weights) for match in ranking.top(10)]
        assert [float(row[f"score {k}"]) for k in range(1, 11)] == pytest.approx(scores, abs=1e-5)


def test_weathers_have_no_table_of_queries(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["evaluate", str(data), "--model", str(model_file), "--weather", "all"]
    assert main.main([*given, "--per-query", str(tmp_path / "queries.csv")]) == 2
    assert "choose one with --weather" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("by_lists", [False, True])
def test_junk_is_left_out_and_names_are_no_formulas(by_lists: bool) -> None:
    rng = np.random.default_rng(4)
    query, gallery = (rng.standard_normal((count, 2, 3)).astype(np.float32) for count in (3, 6))
    labels = np.array([0, 1, 2, -1, 1, 0])
    none = np.zeros(0, np.int64)
    truth = [
        Truth(np.array([0, 5]), np.array([1, 3])),
        Truth(np.array([1, 4]), np.array([3])),
        Truth(none, none, known=False),
    ]
    lists = truth if by_lists else None
    task = replace(
        descriptor_task(query, gallery, np.arange(3), labels, lists),
        queries=[Picture(Path(), i, name) for i, name in enumerate(("=1+1", "b", "c"))],
        gallery=[Picture(Path(), i, f"-tile {i}") for i in range(6)],
    )
    found = measure(task, 8)
    assert found.nearest is not None
    nearest, near = found.nearest
    lines = [line.split(",") for line in found.queries_csv().decode("utf-8-sig").splitlines()]
    scores = np.einsum("qnd,gnd->qg", query.astype(float), gallery.astype(float))
    for row, junk in enumerate([one.junk for one in truth] if by_lists else [np.array([3])] * 3):
        order = [tile for tile in np.argsort(-scores[row], kind="stable").tolist() if tile not in junk]
        assert nearest[row].tolist() == order + [-1] * (8 - len(order))
        np.testing.assert_allclose(near[row, : len(order)], scores[row, order], atol=1e-12)
        true = truth[row].good.tolist() if by_lists else np.flatnonzero(labels == row).tolist()
        assert lines[row + 1][1] == (str(1 + min(order.index(tile) for tile in true)) if true else "")
    assert lines[1][0] == "'=1+1"
    assert sum(cell.startswith("'-tile ") for cell in lines[1]) == int((nearest[0] >= 0).sum())
    assert lines[1][-1] == ""
    assert (lines[3][:3] == ["c", "", ""]) is by_lists
