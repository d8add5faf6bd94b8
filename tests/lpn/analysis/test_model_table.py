"""Statistics of compared models against sums written out."""

from __future__ import annotations

import csv
import io
import itertools
import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import binomtest, chi2

from lpn.analysis.model_table import RankedModel, compare, intervals, mcnemar, rank_published
from lpn.cli.main import main
from lpn.core.errors import InputError
from lpn.core.views import views_of
from lpn.datasets import open_dataset
from lpn.retrieval.saved import PublishedResult
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


@pytest.mark.parametrize(("b", "c"), [(0, 0), (0, 1), (3, 3), (5, 1), (24, 4), (20, 6), (400, 350)])
def test_mcnemar_is_the_binomial_test_where_few_differ(b: int, c: int) -> None:
    p, exact = mcnemar(b, c)
    assert exact
    assert p == pytest.approx(1.0 if b + c == 0 else binomtest(min(b, c), b + c, 0.5).pvalue)
    if b + c <= 6:
        outcomes = [sum(draw) for draw in itertools.product((0, 1), repeat=b + c)]
        as_far = [abs(2 * heads - (b + c)) >= abs(b - c) for heads in outcomes]
        assert p == pytest.approx(sum(as_far) / len(outcomes))


@pytest.mark.parametrize(("b", "c"), [(501, 500), (700, 600), (5000, 4000)])
def test_mcnemar_is_chi_square_where_many_differ(b: int, c: int) -> None:
    p, exact = mcnemar(b, c)
    assert not exact
    assert p == pytest.approx(chi2.sf((abs(b - c) - 1) ** 2 / (b + c), 1))
    assert p == pytest.approx(binomtest(c, b + c, 0.5).pvalue, rel=0.02)


def test_intervals_draw_places_with_all_their_queries() -> None:
    rng = np.random.default_rng(5)
    labels = np.array([7, 7, 7, 2, 2, 9, 4, 4, 4, 4])
    values = (rng.random((2, 10)) < 0.5).astype(float)
    found = intervals(values, labels, seed=3, resamples=200)
    draws = np.random.default_rng(3)
    places = [2, 4, 7, 9]
    means = []
    for _ in range(200):
        chosen = [places[i] for i in draws.integers(4, size=4)]
        rows = [row for place in chosen for row in np.flatnonzero(labels == place)]
        means.append(values[:, rows].mean(axis=1))
    for estimate, row, of_row in zip(found, values, np.array(means).T, strict=True):
        assert estimate.value == pytest.approx(100 * row.mean())
        assert (estimate.low, estimate.high) == pytest.approx(tuple(100 * np.quantile(of_row, (0.025, 0.975))))


def test_intervals_hold_a_known_share() -> None:
    hits = (np.arange(400) % 4 == 0).astype(float)
    (estimate,) = intervals(hits[None], np.arange(400), seed=0, resamples=2000)
    half = 100 * 1.96 * math.sqrt(0.25 * 0.75 / 400)
    assert (estimate.value, estimate.low, estimate.high) == pytest.approx((25, 25 - half, 25 + half), abs=0.6)


def test_a_comparison_counts_what_only_one_model_finds() -> None:
    models = [ranked("a.onnx", 1), ranked("b.onnx", 2), ranked("c.mat", 3)]
    shuffled = np.random.default_rng(0).permutation(30)
    models[1] = models[1].in_order([f"q{i}" for i in shuffled])
    found = compare(models, seed=4, resamples=50)
    assert [(test.first, test.second) for test in found.tests] == [
        ("a.onnx", "b.onnx"),
        ("a.onnx", "c.mat"),
        ("b.onnx", "c.mat"),
    ]
    hits = [{query for query, first in zip(one.queries, one.first, strict=True) if first == 0} for one in models]
    for test, (a, b) in zip(found.tests, itertools.combinations(hits, 2), strict=True):
        assert (test.only_first, test.only_second, test.both) == (len(a - b), len(b - a), len(a & b))
        assert test.neither == 30 - len(a | b)
        assert test.p == mcnemar(len(a - b), len(b - a))[0]
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
    assert [row["model"] for row in rows] == ["a.onnx", "b.onnx", "c.mat"]
    assert rows[1]["only this, not a.onnx"] == str(found.tests[0].only_second)
    assert float(rows[2]["R@5 low"]) == pytest.approx(found.figures[2]["R@5"].low, abs=1e-4)
    page = found.to_markdown()
    assert f"| a.onnx | {found.figures[0]['R@1']} |" in page
    assert f"| a.onnx | b.onnx | {found.tests[0].only_first} | {found.tests[0].only_second} |" in page
    assert "seed 4" in page


def test_repeated_queries_are_each_counted_and_never_mixed() -> None:
    names = ("a", "a", "b", "c")
    one = replace(ranked("one", 1, queries=4), queries=names, first=np.array([0, 5, 5, 5]))
    other = replace(one, name="other", first=np.array([5, 0, 5, 5]))
    found = compare([one, other], resamples=10)
    assert [figures["R@1"].value for figures in found.figures] == [25.0, 25.0]
    assert (found.tests[0].only_first, found.tests[0].only_second) == (1, 1)
    with pytest.raises(InputError, match="a is among them more than once"):
        compare([one, replace(other, queries=("a", "b", "a", "c"))])
    with pytest.raises(InputError, match="not the same"):
        compare([one, replace(other, queries=("a", "b", "b", "c"))])


def test_galleries_tasks_and_queries_are_never_mixed() -> None:
    one = ranked("a", 1)
    other = ranked("b", 2)
    for changed, message in (
        (replace(other, gallery_name="without distractors, 40"), "full gallery, 40, and b the without distractors, 40"),
        (
            ranked("b", 2, gallery=39),
            "full gallery, 40, and b the full gallery, 39; figures on two galleries do not compare",
        ),
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
    tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=1, test=6)
    (root / "test" / "query_drone" / "0004" / "image-01.png").unlink()
    second = tmp_path / "other" / "model.onnx"
    second.parent.mkdir()
    second.write_bytes(model_file.read_bytes())
    figures = tmp_path / "table.json"
    options = ["--data", str(root), "--json", str(figures)]
    assert main(["compare", str(model_file), str(second), *options]) == 0
    found = json.loads(figures.read_text())
    assert (found["gallery"], found["queries"], found["bootstrap"]["seed"]) == ("full gallery, 6", 5, 0)
    assert found["models"][0]["AP"] == found["models"][1]["AP"]
    assert (found["tests"][0]["only_first"], found["tests"][0]["p"]) == (0, 1.0)
    assert [one["name"] for one in found["models"]] == [f"{model_file.parent.name}/model.onnx", "other/model.onnx"]
    assert main(["compare", str(model_file), str(second), "--data", str(root), "--gallery", "without-distractors"]) == 0
    assert "without distractors, 5" in capsys.readouterr().out
    save_result(tmp_path / "result.mat", root, model_file)
    tables = {kind: tmp_path / f"table.{kind}" for kind in ("md", "csv", "tex")}
    for table in tables.values():
        assert main(["compare", str(model_file), str(tmp_path / "result.mat"), *options, "--table", str(table)]) == 0
    found = json.loads(figures.read_text())
    assert [one["name"] for one in found["models"]] == ["model.onnx", "result.mat"]
    assert (found["tests"][0]["only_first"], found["tests"][0]["only_second"]) == (0, 0)
    assert tables["csv"].read_text("utf-8-sig").splitlines()[2].startswith("result.mat,")
    assert "| model.onnx | result.mat | 0 | 0 |" in tables["md"].read_text()
    assert tables["tex"].read_text().count(r"\begin{tabular}") == 2
    dataset = open_dataset(root)
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")[1:]
    drawn = np.random.default_rng(0).standard_normal((11, 1, 8)).astype(np.float32)
    paths = tuple(tuple(str(picture.path) for picture in pictures) for pictures in (queries, gallery))
    labels = tuple(np.array([picture.label for picture in pictures]) for pictures in (queries, gallery))
    saved = PublishedResult("r.mat", drawn[:5], labels[0], drawn[5:10], labels[1], *paths)
    smaller = rank_published(saved, "r.mat", dataset)
    assert smaller.gallery_name == "full gallery, 5"
    whole = replace(smaller, name="m", gallery_name="full gallery, 6", gallery=smaller.gallery | {"x"})
    with pytest.raises(InputError, match="do not compare"):
        compare([whole, smaller])
    assert (
        main(["compare", str(model_file), str(tmp_path / "result.mat"), *options, "--task", "satellite-to-drone"]) == 2
    )
    assert "expected satellite-to-drone" in capsys.readouterr().err


@pytest.mark.parametrize("make", [layouts.vigor, layouts.gta])
def test_a_saved_result_in_an_order_of_its_own_has_the_data_sets_listed_matches(
    tmp_path: Path, make: Callable[[Path], Path]
) -> None:
    dataset = open_dataset(make(tmp_path / "set"))
    task = dataset.tasks()[0]
    query_view, gallery_view = views_of(task)
    sides = dataset.queries(query_view), dataset.gallery(gallery_view)
    truth = dataset.truth(task)
    assert truth is not None
    perfect = np.zeros((len(sides[0]), 1, len(sides[1])), np.float32)
    for row, lists in enumerate(truth):
        perfect[row, 0, lists.good] = 1 / np.sqrt(len(lists.good))
    orders = [np.random.default_rng(3).permutation(len(side)) for side in sides]
    tiles = np.eye(len(sides[1]), dtype=np.float32)[:, None]
    paths = [tuple(str(side[i].path) for i in order) for side, order in zip(sides, orders, strict=True)]
    labels = [np.arange(len(side)) for side in sides]
    rows = perfect[orders[0]], tiles[orders[1]]
    saved = PublishedResult("r.mat", rows[0], labels[0], rows[1], labels[1], paths[0], paths[1])
    found = rank_published(saved, "r.mat", dataset)
    assert found.first.tolist() == [0] * len(sides[0])
    assert found.labels.tolist() == [sides[0][i].label for i in orders[0]]
    fewer = replace(
        saved, gallery=rows[1][1:], gallery_labels=labels[1][1:], gallery_paths=paths[1][1:], name="fewer.mat"
    )
    kept = orders[1][1:]
    expected = [0 if set(truth[i].good) & set(kept) else -1 for i in orders[0]]
    assert rank_published(fewer, "fewer.mat", dataset).first.tolist() == expected
    twice = replace(saved, gallery_paths=(paths[1][1], *paths[1][1:]))
    with pytest.raises(InputError, match="twice"):
        rank_published(twice, "twice.mat", dataset)


def test_plain_arrays_may_name_a_picture_twice(tmp_path: Path) -> None:
    drawn = np.random.default_rng(5).standard_normal((2, 7, 1, 8)).astype(np.float32)
    for name, one in zip("ab", drawn, strict=True):
        np.save(tmp_path / f"{name}-queries.npy", one[:3])
        np.save(tmp_path / f"{name}-gallery.npy", one[3:])
    lines = ["file,side,label", "q.jpg,query,1", "q.jpg,query,2", "r.jpg,query,3"]
    lines += [f"{i}.jpg,gallery,{i}" for i in range(4)]
    (tmp_path / "list.csv").write_text("\n".join(lines))
    files = [[str(tmp_path / f"{name}-{side}.npy") for name in "ab"] for side in ("queries", "gallery")]
    arguments = [
        "compare",
        "arrays",
        "--queries",
        *files[0],
        "--gallery",
        *files[1],
        "--paths",
        str(tmp_path / "list.csv"),
    ]
    assert main([*arguments, "--json", str(tmp_path / "table.json")]) == 0
    assert json.loads((tmp_path / "table.json").read_text())["queries"] == 3
