"""Statistics of compared models against sums written out."""

from __future__ import annotations

import csv
import io
import itertools
import json
import statistics
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import ttest_ind

import lpn
from lpn.analysis.model_table import compare
from lpn.analysis.statistics import holm, intervals, randomization_test
from lpn.cli.main import main
from lpn.core.errors import InputError
from lpn.core.text_tables import markdown_page
from lpn.core.views import views_of
from lpn.datasets import open_dataset
from lpn.retrieval.saved import PublishedResult
from lpn.tasks.measure import RankedModel
from lpn.tasks.saved import saved_task
from tests.conftest import Refused
from tools.fixtures import layouts, small_worlds
from tools.fixtures.published_results import save_result


def ranked(name: str, seed: int, queries: int = 30, places: int = 12, gallery: int = 40) -> RankedModel:
    rng = np.random.default_rng(seed)
    first = rng.integers(-1, 8, queries)
    return RankedModel(
        name,
        "drone-to-satellite",
        f"full gallery, {gallery}",
        tuple(f"q{i}" for i in range(queries)),
        frozenset(f"t{i}" for i in range(gallery)),
        np.arange(queries) % places,
        first,
        np.where(first < 0, 0.0, rng.random(queries)),
    )


def test_a_comparison_counts_what_only_one_model_finds() -> None:
    models = [ranked("a.onnx", 1), ranked("b.onnx", 2), ranked("c.mat", 3)]
    shuffled = np.random.default_rng(0).permutation(30)
    models[1] = models[1].in_order([f"q{i}" for i in shuffled])
    found = compare(models, seed=4, resamples=50)
    pairs = [("a.onnx", "b.onnx"), ("a.onnx", "c.mat"), ("b.onnx", "c.mat")]
    assert [(test.first, test.second) for test in found.tests] == 2 * pairs
    assert [test.figure for test in found.tests] == 3 * ["R@1"] + 3 * ["AP"]
    hits = [{query for query, first in zip(one.queries, one.first, strict=True) if first == 0} for one in models]
    for test, (a, b) in zip(found.tests[:3], itertools.combinations(hits, 2), strict=True):
        assert (test.first_better, test.second_better) == (len(a - b), len(b - a))
        assert test.difference.value == pytest.approx(100 * (len(a) - len(b)) / 30)
    for of_figure, key in ((found.tests[:3], "R@1"), (found.tests[3:], "AP")):
        values = [(one.first == 0) * 1.0 if key == "R@1" else one.precision for one in found.models]
        differences = np.stack([a - b for a, b in itertools.combinations(values, 2)])
        p = randomization_test(differences, found.models[0].labels, 4)
        assert [test.p for test in of_figure] == p
        assert [test.holm for test in of_figure] == holm(p)
        for test, row in zip(of_figure, differences, strict=True):
            assert (test.first_better, test.second_better) == ((row > 0).sum(), (row < 0).sum())
            (alone,) = intervals(row[None], found.models[0].labels, 4, 50)
            assert vars(test.difference) == pytest.approx(vars(alone))
            assert (test.seeds_p, test.seeds_holm) == (None, None)
    for one, figures in zip(models, found.figures, strict=True):
        assert list(figures) == ["R@1", "R@5", "R@10", "AP"]
        for depth in (1, 5, 10):
            assert figures[f"R@{depth}"].value == pytest.approx(
                100 * np.mean([0 <= first < depth for first in one.first])
            )
        assert figures["AP"].value == pytest.approx(100 * one.precision.mean())
        assert all(e.low <= e.value <= e.high for e in figures.values())
    again = compare(models, seed=4, resamples=50)
    assert again.to_dict() == found.to_dict()
    rows = list(csv.DictReader(io.StringIO(found.to_csv().decode())))
    assert [row["model"] for row in rows if not row["against"]] == [*4 * ["a.onnx"], *4 * ["b.onnx"], *4 * ["c.mat"]]
    (low,) = (row["low"] for row in rows if (row["model"], row["against"], row["figure"]) == ("c.mat", "", "R@5"))
    assert float(low) == pytest.approx(found.figures[2]["R@5"].low, abs=1e-4)
    tested = [row for row in rows if row["against"]]
    assert [(row["model"], row["against"], row["figure"]) for row in tested] == [
        (test.first, test.second, test.figure) for test in found.tests
    ]
    for row, test in zip(tested, found.tests, strict=True):
        numbers = (test.difference.value, test.p, test.holm)
        assert [float(row[key]) for key in ("value", "p", "Holm's p")] == pytest.approx(numbers, rel=1e-5)
        assert (row["sd"], row["seeds' p"]) == ("", "")
    page = markdown_page(found.printed)
    assert f"| a.onnx | {found.figures[0]['R@1']} |" in page
    test = found.tests[0]
    assert f"| a.onnx | b.onnx | R@1 | {test.difference} | {test.first_better} | {test.second_better} |" in page
    assert "seed 4" in page


def test_runs_of_one_method_are_a_group_with_mean_and_deviation() -> None:
    runs = [
        ranked(f"{method}{seed}.onnx", seed) for method, seeds in (("a", (1, 2, 3)), ("b", (4, 5))) for seed in seeds
    ]
    single = ranked("c.onnx", 6)
    found = compare([*runs, single], seed=2, resamples=30, groups=("A", "A", "A", "B", "B", "C"))
    recalls = [100 * float(np.mean(one.first == 0)) for one in runs]
    precisions = [100 * float(one.precision.mean()) for one in runs]
    for figure, values in (("R@1", recalls), ("AP", precisions)):
        for group, of_group in enumerate((values[:3], values[3:])):
            estimate = found.figures[group][figure]
            assert estimate.value == pytest.approx(statistics.mean(of_group))
            assert estimate.sd == pytest.approx(statistics.stdev(of_group))
        assert found.figures[2][figure].sd is None
        # The interval of the runs' mean is over places: it does not cover the seeds.
        means = [np.mean([(one.first == 0) if figure == "R@1" else one.precision for one in of], 0) for of in
                 (runs[:3], runs[3:])]  # fmt: skip
        (interval,) = intervals(means[0][None], runs[0].labels, 2, 30)
        assert replace(found.figures[0][figure], sd=None) == interval
        first, *others = (test for test in found.tests if test.figure == figure)
        assert (first.first, first.second) == ("A", "B")
        assert first.difference.value == pytest.approx(statistics.mean(values[:3]) - statistics.mean(values[3:]))
        assert first.p == randomization_test((means[0] - means[1])[None], runs[0].labels, 2)[0]
        assert first.seeds_p == pytest.approx(ttest_ind(values[:3], values[3:], equal_var=False).pvalue, rel=1e-4)
        assert first.seeds_holm == first.seeds_p  # the only pair of two groups with several runs
        assert [(test.second, test.seeds_p) for test in others] == [("C", None), ("C", None)]
    values = found.to_dict()["models"]
    assert values[0]["runs"]["names"] == ["a1.onnx", "a2.onnx", "a3.onnx"]
    assert values[0]["runs"]["AP"] == pytest.approx(precisions[:3])
    assert "runs" not in values[2]
    page = markdown_page(found.printed)
    assert f"| A | {found.figures[0]['R@1']} |" in page
    assert f" ± {statistics.stdev(recalls[:3]):.2f} (" in page
    assert "seeds' p" in page
    rows = list(csv.DictReader(io.StringIO(found.to_csv().decode())))
    assert float(rows[0]["sd"]) == pytest.approx(statistics.stdev(recalls[:3]), rel=1e-5)


def test_one_group_has_figures_and_no_tests_and_each_model_takes_a_group() -> None:
    runs = [ranked(f"{seed}.onnx", seed) for seed in (1, 2)]
    found = compare(runs, resamples=5, groups=("LPN", "LPN"))
    assert (list(found.groups), found.tests, len(found.printed)) == (["LPN"], [], 1)
    assert "p is of" not in found.sentence
    with pytest.raises(InputError, match="Found 1 group for 2 models; name the group of each model in their order"):
        compare(runs, groups=("LPN",))


def test_repeated_queries_are_each_counted_and_never_mixed() -> None:
    names = ("a", "a", "b", "c")
    one = replace(ranked("one", 1, queries=4), queries=names, first=np.array([0, 5, 5, 5]))
    other = replace(one, name="other", first=np.array([5, 0, 5, 5]))
    found = compare([one, other], resamples=10)
    assert [figures["R@1"].value for figures in found.figures] == [25.0, 25.0]
    assert (found.tests[0].first_better, found.tests[0].second_better) == (1, 1)
    with pytest.raises(InputError, match="a is among them more than once"):
        compare([one, replace(other, queries=("a", "b", "a", "c"))])
    with pytest.raises(InputError, match="not the same"):
        compare([one, replace(other, queries=("a", "b", "b", "c"))])


def test_galleries_tasks_and_queries_are_never_mixed() -> None:
    one = ranked("a", 1)
    other = ranked("b", 2)
    for changed, message in (
        (replace(other, gallery_name="without distractors, 40"), "full gallery, 40, and b the without distractors, 40"),
        (ranked("b", 2, gallery=39), "full gallery, 40, and b the full gallery, 39; figures on two galleries"),
        (replace(other, gallery=frozenset({"x", *list(other.gallery)[1:]})), "of other pictures"),
        (replace(other, task="satellite-to-drone"), "compare models on one task"),
        (ranked("b", 2, queries=29), "30 queries, and b 29"),
        (replace(other, name="a"), "expected different names"),
    ):
        with pytest.raises(InputError, match=message):
            compare([one, changed])
    with pytest.raises(InputError, match="two models or more"):
        compare([one])
    with pytest.raises(InputError, match="expected a seed from 0"):
        compare([one, other], resamples=0)


def test_models_and_saved_results_compare_on_one_gallery(
    tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str], refused: Refused
) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=1, test=6)
    (root / "test" / "query_drone" / "0004" / "image-01.png").unlink()
    second = tmp_path / "other" / "model.onnx"
    second.parent.mkdir()
    second.write_bytes(model_file.read_bytes())
    figures = tmp_path / "table.json"
    options = ["--json", str(figures)]
    assert main(["compare", str(root), "--model", str(model_file), str(second), *options]) == 0
    found = json.loads(figures.read_text())
    assert (found["gallery"], found["queries"], found["bootstrap"]["seed"]) == ("full gallery, 6", 5, 0)
    assert found["models"][0]["AP"] == found["models"][1]["AP"]
    assert (found["tests"][0]["first_better"], found["tests"][0]["p"]) == (0, 1.0)
    assert [one["name"] for one in found["models"]] == [f"{model_file.parent.name}/model.onnx", "other/model.onnx"]
    assert main(["compare", str(root), "--model", str(model_file), str(second), "--without-distractors"]) == 0
    assert "without distractors, 5" in capsys.readouterr().out
    save_result(tmp_path / "result.mat", root, model_file)
    beside = ["compare", str(root), str(tmp_path / "result.mat"), "--model", str(model_file), *options]
    tables = {kind: tmp_path / f"table.{kind}" for kind in ("csv", "html")}
    for table in tables.values():
        assert main([*beside, "--table", str(table)]) == 0
    found = json.loads(figures.read_text())
    assert [one["name"] for one in found["models"]] == ["model.onnx", "result.mat"]
    assert (found["tests"][0]["first_better"], found["tests"][0]["second_better"]) == (0, 0)
    assert tables["csv"].read_text("utf-8-sig").splitlines()[5].startswith("result.mat,")
    assert tables["html"].read_text().count('<th scope="row">model.onnx</th>') == 3
    assert "compare models on one task" in refused(*beside, "--task", "satellite-to-drone")


def test_the_command_takes_the_group_of_each_model(
    data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    models, table = [str(model_file), str(one_part_model_file)], tmp_path / "table.json"
    given = ["--resamples", "5", "--json", str(table)]
    assert main(["compare", str(data), "--model", *models, *given, "--group", "ours", "ours"]) == 0
    found = json.loads(table.read_text())
    assert [one["name"] for one in found["models"]] == ["ours"]
    assert len(found["models"][0]["runs"]["R@1"]) == 2
    assert found["models"][0]["R@1"]["sd"] == pytest.approx(statistics.stdev(found["models"][0]["runs"]["R@1"]))
    assert " ± " in capsys.readouterr().out


@pytest.mark.parametrize("make", [layouts.vigor, layouts.gta])
def test_a_saved_result_in_an_order_of_its_own_has_the_data_sets_listed_matches(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    dataset = open_dataset(make(tmp_path / "set"))
    task = dataset.tasks()[0]
    query_view, gallery_view = views_of(task)
    sides = dataset.queries(query_view), dataset.gallery(gallery_view)
    truth = dataset.truth(task)
    perfect = np.zeros((len(sides[0]), 1, len(sides[1])), np.float32)
    for row, lists in enumerate(truth):
        perfect[row, 0, lists.good] = 1 / np.sqrt(len(lists.good))
    orders = [np.random.default_rng(3).permutation(len(side)) for side in sides]
    tiles = np.eye(len(sides[1]), dtype=np.float32)[:, None]
    paths = [tuple(str(side[i].path) for i in order) for side, order in zip(sides, orders, strict=True)]
    labels = [np.arange(len(side)) for side in sides]
    rows = perfect[orders[0]], tiles[orders[1]]
    saved = PublishedResult("r.mat", rows[0], labels[0], rows[1], labels[1], paths[0], paths[1])
    graded = saved_task(saved, dataset)
    for given, of in zip(graded.truth or (), (truth[i] for i in orders[0]), strict=True):
        for lists in ("good", "semi"):
            assert set(orders[1][getattr(given, lists)]) == set(getattr(of, lists))
        assert given.trapezoid == of.trapezoid
        assert [given.overlap(at) for at in range(len(orders[1]))] == pytest.approx(
            list(map(of.overlap, orders[1])), nan_ok=True
        )
    found = graded.evaluate().ranked()
    assert found.first.tolist() == [0] * len(sides[0])
    assert found.labels.tolist() == [sides[0][i].label for i in orders[0]]
    fewer = replace(
        saved, gallery=rows[1][1:], gallery_labels=labels[1][1:], gallery_paths=paths[1][1:], name="fewer.mat"
    )
    kept = orders[1][1:]
    expected = [0 if set(truth[i].good) & set(kept) else -1 for i in orders[0]]
    assert saved_task(fewer, dataset).evaluate().ranked().first.tolist() == expected
    twice = replace(saved, gallery_paths=(paths[1][1], *paths[1][1:]))
    with pytest.raises(InputError, match="twice"):
        saved_task(twice, dataset).evaluate().ranked()


def test_results_are_compared_by_their_models_and_scorings(data: Path, model_file: Path) -> None:
    plain, moved = (lpn.evaluate(model_file, data, calibrate=False, csls=neighbours) for neighbours in (0, 3))
    found = lpn.compare([plain, moved], resamples=20)
    assert [one.name for one in found.models] == [f"{model_file.name}, {scoring}" for scoring in ("plain", "CSLS")]
    assert [of["R@1"].value for of in found.figures] == pytest.approx([plain.recall["1"], moved.recall["1"]])
    for wrong in ([plain, None], [plain, "a"], 3):
        with pytest.raises(InputError, match=r"One of the results is of the type .*expected results of lpn\.evaluate"):
            lpn.compare(wrong)


def test_where_no_truth_is_known_nothing_is_compared(tmp_path: Path, refused: Refused) -> None:
    drawn = np.random.default_rng(5).standard_normal((7, 1, 8)).astype(np.float32)
    for name, one in (("q", drawn[:3]), ("again", drawn[:3]), ("g", drawn[3:])):
        np.save(tmp_path / f"{name}.npy", one)
    lines = [f"{'q' if i < 3 else 'g'}{i}.jpg,{'query' if i < 3 else 'gallery'},30.{i},120.1" for i in range(7)]
    (tmp_path / "list.csv").write_text("\n".join(["file,side,latitude,longitude", *lines]))
    q, again, g, listed = (tmp_path / name for name in ("q.npy", "again.npy", "g.npy", "list.csv"))
    said = refused("compare", q, again, "--gallery", g, g, "--paths", listed)
    assert said == "lpn: The true place of no query of q.npy is known, so there is nothing to compare."
