from __future__ import annotations

import csv
import json
import math
import os
import zlib
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import lpn
from lpn import descriptors
from lpn.cli.main import main
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.datasets import Dataset, Picture, Truth, geo, open_dataset
from lpn.datasets.layouts.university import University
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import WEATHERS, Weather
from lpn.models.base import Model, normalise
from lpn.models.checkpoints import TorchModel
from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec
from lpn.retrieval import describe_picture, metrics
from lpn.retrieval.calibration import centred as without_mean
from lpn.sources import SourceOptions, open_source
from lpn.tasks import query_outcomes
from lpn.tasks.changes import averaged, centred, changed, in_weather, turned, with_parts
from lpn.tasks.measure import Figures, Result, measure
from lpn.tasks.opening import lazy_task
from lpn.tasks.query_outcomes import Outcomes
from lpn.tasks.weathers import measure_weathers
from tests.conftest import Refused
from tools.fixtures import layouts, small_worlds
from tools.fixtures.tasks import descriptor_task

KEYS = ("recall@1", "recall@5", "recall@10", "recall@1%", "ap")


def described(model: Model, pictures: list[Picture], view: str, angle: float = 0.0) -> Float32Array:
    turned = [images.rotate(images.load_picture(picture.path), angle) for picture in pictures]
    return model.descriptors(np.stack([images.prepare(p, model.input_size) for p in turned]), view)


def labels(pictures: Sequence[Picture]) -> list[int]:
    return [picture.label for picture in pictures]


def expect_figures(found: Figures | Result, *sides: object) -> None:
    """Compare figures with those of queries, their labels, tiles, and their labels, and perhaps lists of true matches."""
    expected, values = metrics.evaluate(*sides), found.to_dict()
    assert [values[key] for key in KEYS] == pytest.approx([expected[key] for key in KEYS])


TASK = "drone-to-satellite"
PLACES = list(range(7, 21))
"""The places of the small data set, each with one picture of each view."""


@pytest.fixture(scope="module")
def dataset(data: Path) -> Dataset:
    return open_dataset(data)


@pytest.fixture(scope="module")
def sides(model: Model, dataset: Dataset) -> dict[str, Float32Array]:
    """The descriptors of the pictures as they are, by view."""
    return {view: described(model, dataset.queries(view), view) for view in ("drone", "satellite")}


@pytest.mark.parametrize(
    ("task", "rotate", "parts"), [(TASK, 0.0, None), ("satellite-to-drone", 30.0, [2]), (TASK, -90.0, [4, 1, 4])]
)
def test_figures_are_those_of_the_turned_queries_and_the_chosen_parts(
    model: Model, dataset: Dataset, sides: dict[str, Float32Array], task: str, rotate: float, parts: list[int] | None
) -> None:
    found = measure(with_parts(turned(lazy_task(model, dataset, task), rotate), parts))
    query_view, gallery_view = task.split("-to-")
    index = [part - 1 for part in dict.fromkeys(parts)] if parts else list(range(4))
    asked = described(model, dataset.queries(query_view), query_view, rotate)
    expect_figures(found, asked[:, index], PLACES, sides[gallery_view][:, index], PLACES)
    assert found.parts == tuple(i + 1 for i in index)


def test_centred_figures_are_those_of_a_model_with_the_means_of_both_sides(
    model: Model, dataset: Dataset, sides: dict[str, Float32Array]
) -> None:
    found = measure(centred(lazy_task(model, dataset, TASK)))
    moved = model.centred({view: of.mean(axis=0) for view, of in sides.items()})
    asked, tiles = (described(moved, dataset.queries(view), view) for view in ("drone", "satellite"))
    expect_figures(found, asked, PLACES, tiles, PLACES)
    assert "each part normalised; the mean of the queries and that of the gallery subtracted" in found.sentence
    rows = np.arange(24, dtype=np.float32).reshape(3, 2, 4) ** 2
    rows /= np.linalg.norm(rows, axis=2, keepdims=True) * np.float32(np.sqrt(2))
    away = rows[1, 0] - rows[:, 0].mean(axis=0)
    np.testing.assert_allclose(without_mean(rows)[1, 0], away / np.linalg.norm(away) / np.sqrt(2), rtol=1e-5)


def test_figures_in_training_leave_nothing_in_the_cache(
    model: Model, dataset: Dataset, sides: dict[str, Float32Array]
) -> None:
    passing = measure(lazy_task(model, dataset, TASK, descriptors.temporary_descriptors))
    assert not Path(os.environ["LPN_CACHE"]).exists()
    expect_figures(passing, sides["drone"], PLACES, sides["satellite"], PLACES)


@pytest.mark.parametrize("parts", [(), (0,), (5,), "a", [1.5]])
def test_parts_that_are_no_parts_of_the_model_are_refused(data: Path, model_file: Path, parts: Any) -> None:
    with pytest.raises(InputError, match=r"(parts|numbers from) 1 to 4"):
        lpn.evaluate(model_file, data, parts=parts)


def test_queries_are_scaled_before_the_resize_and_shifted_after_it(
    model: Model, dataset: Dataset, sides: dict[str, Float32Array]
) -> None:
    task = lazy_task(model, dataset, TASK)
    found = measure(changed(task, Change(20, -7, 0.8)))
    made = []
    for picture in dataset.queries("drone"):
        zoomed = images.zoom(images.rotate(images.load_picture(picture.path), 20), 0.8)
        resized = images.resize(zoomed, *model.input_size)
        moved = np.zeros_like(resized)
        moved[:, :-7] = resized[:, 7:]
        made.append(images.normalise(moved))
    query = model.descriptors(np.stack(made), "drone")
    expect_figures(found, query, PLACES, sides["satellite"], PLACES)
    assert "queries turned 20°, scaled by 0.8, shifted 7 px to the left" in found.sentence
    assert "turned" not in measure(task).sentence


def test_panoramas_are_turned_by_moving_their_columns_around(tmp_path: Path) -> None:
    dataset = open_dataset(small_worlds.make_cvusa(tmp_path / "pairs", 3))
    spec = ModelSpec("resnet18", "layer3", views=("satellite", "street"), shared=False, n_parts=2, input_size=(64, 64))
    task = turned(lazy_task(TorchModel(LPN(spec), "f" * 16), dataset, "street-to-satellite"), 90)
    assert task.change == Change(rotate=90).for_picture(dataset.queries("street")[0])
    assert "columns moved around" in task.evaluate().sentence


def test_averaged_queries_are_one_per_place(tmp_path: Path, model: Model) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=1, test=6)
    for label in range(2, 8):
        for i in (2, 3):
            picture = small_worlds.from_drone(small_worlds.place(label), 50 * i + label)
            small_worlds.write(root / "test" / "query_drone" / f"{label:04d}" / f"image-0{i}.png", picture)
    dataset = open_dataset(root)
    found = measure(averaged(lazy_task(model, dataset, "drone-to-satellite")))
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    parts = described(model, queries, "drone")
    mean = np.stack([parts[i : i + 3].mean(axis=0) for i in range(0, 18, 3)])
    mean /= 2 * np.linalg.norm(mean, axis=2, keepdims=True)
    assert (len(queries), found.queries) == (18, 6)
    expect_figures(found, mean, labels(queries)[::3], described(model, gallery, "satellite"), labels(gallery))
    assert "the 18 query pictures averaged to one query per place" in found.sentence


def test_one_branch_can_describe_both_sides(dataset: Dataset) -> None:
    two = TorchModel(LPN(replace(small_worlds.make_network().spec, shared=False)), "f" * 16)
    found = {}
    for branch in ("satellite", "drone"):
        found[branch] = measure(lazy_task(two, dataset, TASK, branch=branch))
        asked, tiles = (described(two, dataset.queries(view), branch) for view in ("drone", "satellite"))
        expect_figures(found[branch], asked, PLACES, tiles, PLACES)
        assert f"both sides described by the {branch} branch" in found[branch].sentence
    assert found["satellite"].ap != found["drone"].ap
    with pytest.raises(InputError, match="no 'street' view"):
        lazy_task(two, dataset, TASK, branch="street")


class Landmarks(University):
    """The drawn places as landmarks: a query is a part of a picture, and lists name true and junk pictures."""

    def tasks(self) -> list[str]:
        return ["street-to-street"]

    def queries(self, view: str) -> list[Picture]:
        assert view == "street"
        return [replace(p, box=(10.2, 20.0, 60.0, 90.7 - i)) for i, p in enumerate(super().queries("drone"))]

    def gallery(self, view: str) -> list[Picture]:
        assert view == "street"
        return super().gallery("satellite")

    def truth(self, task: str) -> list[Truth] | None:
        assert task == "street-to-street"
        count = len(self.queries("street"))
        return [Truth(np.array([i, (i + 3) % count]), np.array([(i + 1) % count])) for i in range(count)]


def test_landmarks_are_cropped_and_ranked_by_lists(data: Path, model: Model) -> None:
    dataset = Landmarks(data)
    tiles = described(model, dataset.gallery("street"), "drone")
    whole = [images.load_picture(picture.path) for picture in dataset.queries("street")]
    cut = [picture[20 : round(90.7 - i), 10:60] for i, picture in enumerate(whole)]
    query = model.descriptors(np.stack([images.prepare(picture, model.input_size) for picture in cut]), "drone")
    task = lazy_task(model, dataset, "street-to-street", branch="drone")
    found = measure(task)
    expect_figures(found, query, None, tiles, None, dataset.truth("street-to-street"))
    assert (found.to_dict()["cropped"], found.to_dict()["junk"]) == (True, "lists")
    assert "junk taken out of the ranking" in found.sentence
    assert "cropped" in found.sentence
    uncut = model.descriptors(np.stack([images.prepare(picture, model.input_size) for picture in whole]), "drone")
    assert metrics.evaluate(uncut, None, tiles, None, dataset.truth("street-to-street"))["ap"] != found.ap
    with pytest.raises(InputError, match=r"use lpn reproduce table6 .*lazy_task\(branch=\.\.\.\)"):
        lazy_task(model, dataset, "street-to-street")
    with pytest.raises(InputError, match="averaged"):
        averaged(task)


def test_distractors_make_a_second_gallery_that_is_named(
    tmp_path: Path, model_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = small_worlds.make_dataset(tmp_path / "places", train=1, test=9)
    for label in (3, 6, 8):
        (root / "test" / "query_drone" / f"{label:04d}" / "image-01.png").unlink()
    model, dataset = lpn.load(model_file), open_dataset(root)
    found = measure(lazy_task(model, dataset, "drone-to-satellite"))
    assert [figures.name for figures in found.galleries] == ["full gallery, 9", "without distractors, 6"]
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    asked = labels(queries)
    kept = [label if label in asked else -1 for label in labels(gallery)]
    query, tiles = described(model, queries, "drone"), described(model, gallery, "satellite")
    for figures, expected_labels in zip(found.galleries, (labels(gallery), kept), strict=True):
        expect_figures(figures, query, asked, tiles, expected_labels)
    assert found.galleries[1].ap > found.ap
    assert main(["evaluate", str(root), "--model", str(model_file)]) == 0
    said = capsys.readouterr().out
    assert "full gallery, 9" in said
    assert "without distractors, 6" in said
    assert "Figures of the two do not compare." in said.replace("\n", " ")


def read_drawn(model: Model, pictures: Sequence[Picture], view: str, change: Change) -> Float32Array:
    """Descriptors drawn by the picture's path, near its place's."""
    del view, change
    rows = []
    for picture in pictures:
        seeds = picture.label, zlib.crc32("/".join(picture.path.parts[-4:]).encode())
        place, own = map(np.random.default_rng, seeds)
        rows.append(place.standard_normal((model.n_parts, 6)) + 1.5 * own.standard_normal((model.n_parts, 6)))
    return normalise(np.array(rows, np.float32))


def drawn_sides(model: Model, *sides: Sequence[Picture]) -> list[Float32Array]:
    """Return the descriptors of pictures, each as one vector."""
    return [read_drawn(model, pictures, "", Change()).reshape(len(pictures), -1) for pictures in sides]


def outcomes_of(query: Float32Array, tiles: Float32Array, truth: Sequence[Truth] | None) -> Outcomes:
    labels = np.zeros(len(query), np.int64), np.zeros(len(tiles), np.int64)
    return descriptor_task(query[:, None], tiles[:, None], *labels, truth).outcomes


@pytest.mark.parametrize("task", ["drone-to-satellite", "satellite-to-drone"])
def test_sues_has_a_row_for_each_height_on_both_galleries(tmp_path: Path, model: Model, task: str) -> None:
    dataset = open_dataset(layouts.sues(tmp_path / "SUES", 2, 3, ("150", "300")))
    found = measure(lazy_task(model, dataset, task, read_drawn))
    assert found.group_name == "height"
    assert list(found.groups) == ["150", "300"]
    query_view, gallery_view = task.split("-to-")
    for height, galleries in found.groups.items():
        sides = [
            [picture for picture in pictures if picture.group in (height, "")]
            for pictures in (dataset.queries(query_view), dataset.gallery(gallery_view))
        ]
        query, tiles = (read_drawn(model, pictures, "", Change()) for pictures in sides)
        kept = [label if label > 2 else -1 for label in labels(sides[1])]
        assert [one.gallery for one in galleries] == ([5, 3] if gallery_view == "satellite" else [10, 6])
        for figures, of_gallery in zip(galleries, (labels(sides[1]), kept), strict=True):
            expect_figures(figures, query, labels(sides[0]), tiles, of_gallery)
    assert set(found.to_dict()["groups"]) == {"150", "300"}


def test_denseuav_is_measured_in_degrees(tmp_path: Path, model: Model) -> None:
    dataset = open_dataset(layouts.denseuav(tmp_path / "DenseUAV"))
    found = measure(lazy_task(model, dataset, "drone-to-satellite", read_drawn))
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    query, tiles = drawn_sides(model, queries, gallery)
    total, near = 0.0, 0
    for row, picture in zip(query, queries, strict=True):
        order = np.argsort(-(tiles.astype(float) @ row), kind="stable")
        here, *there = (np.float32(120.38 + 0.0002 * of.label) for of in (picture, *(gallery[i] for i in order)))
        off = [abs(float(here - place)) for place in there]
        total += sum((3 - i) * math.exp(-5000 * off[i]) for i in range(3)) / 6
        near += off[0] * 111_320 * math.cos(math.radians(30.32)) < 50
    assert found.measures["sdm_denseuav@3"] == pytest.approx(total / len(queries), rel=1e-6)
    assert found.measures["ma@50"] == pytest.approx(100 * near / len(queries))
    assert len(found.errors) == len(queries)
    assert list(found.groups) == ["80", "90", "100"]


@pytest.mark.parametrize("degrees", [False, True])
def test_gta_uav_and_visloc_are_measured_in_metres(tmp_path: Path, model: Model, degrees: bool) -> None:
    dataset = open_dataset(layouts.gta(tmp_path / "GTA", degrees=degrees))
    found = measure(lazy_task(model, dataset, "drone-to-satellite", read_drawn))
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    query, tiles = drawn_sides(model, queries, gallery)
    starts, ends = dataset.coordinates(queries), dataset.coordinates(gallery)
    sdm, distance, precision = 0.0, 0.0, 0.0
    for row, start, lists in zip(query, starts, dataset.truth("drone-to-satellite") or (), strict=True):
        order = np.argsort(-(tiles.astype(float) @ row), kind="stable")
        metres = [float(geo.geodesic(start, ends[i])) if degrees else math.dist(start, ends[i]) for i in order]
        sdm += sum((3 - i) * math.exp(-0.001 * metres[i]) for i in range(3)) / 6
        distance += sum(metres[:3]) / 3
        ranks = sorted(order.tolist().index(tile) for tile in lists.good)
        precision += sum((i + 1) / (rank + 1) for i, rank in enumerate(ranks)) / len(ranks)
    assert found.measures["sdm_gta_uav@3"] == pytest.approx(sdm / 2)
    assert found.measures["dis@3"] == pytest.approx(distance / 2)
    assert "hit rate" not in found.measures
    assert found.ap == pytest.approx(100 * precision / 2)
    assert "AP as the mean precision at the true matches" in found.sentence
    back = measure(lazy_task(model, dataset, "satellite-to-drone", read_drawn))
    assert (back.queries, back.gallery) == (3, 2)
    outcomes = outcomes_of(query, tiles, dataset.truth("drone-to-satellite"))
    column, semi = query_outcomes.listed_columns(outcomes, dataset.truth("drone-to-satellite"))
    names = [gallery[answer].name for answer in outcomes.answer]
    known = [{"4_0_0_0": 0.7, "5_0_1_1": 0.45, "4_0_1_0": 0.2}, {"4_0_1_1": 0.5}]
    if not degrees:
        assert semi.values.tolist() == ["yes" if name == "4_0_1_0" and i == 0 else "no" for i, name in enumerate(names)]
        assert column.values.tolist() == [of.get(name, 0.0) for of, name in zip(known, names, strict=True)]


def test_vigor_has_a_hit_rate_and_a_row_for_each_city(tmp_path: Path, model: Model) -> None:
    dataset = open_dataset(layouts.vigor(tmp_path / "VIGOR"))
    found = measure(lazy_task(model, dataset, "street-to-satellite", read_drawn, "drone"))
    assert list(found.groups) == ["Chicago", "NewYork", "Seattle", "SanFrancisco"]
    queries, gallery = dataset.queries("street"), dataset.gallery("satellite")
    query, tiles = drawn_sides(model, queries, gallery)
    hits = 0
    for row, lists in zip(query, dataset.truth("street-to-satellite") or (), strict=True):
        scores = tiles.astype(float) @ row
        scores[lists.semi] = -np.inf
        hits += int(np.argmax(scores)) in lists.good
    assert found.measures == {"hit rate": pytest.approx(100 * hits / 8)}
    truth = dataset.truth("street-to-satellite") or []
    outcomes = outcomes_of(query, tiles, truth)
    (semi,) = query_outcomes.listed_columns(outcomes, truth)
    assert semi.values.tolist() == [
        "yes" if answer in lists.semi else "no" for answer, lists in zip(outcomes.answer, truth, strict=True)
    ]


def test_each_query_has_its_rank_precision_and_nearest_tiles(data: Path, model_file: Path, tmp_path: Path) -> None:
    out, options = tmp_path / "deep" / "queries.csv", ["--csls", "3", "--no-calibrate", "--rotate", "90"]
    given = ["evaluate", str(data), "--model", str(model_file), "--task", TASK, "--per-query", str(out)]
    assert main([*given, *options]) == 0
    task = lpn.open_task(data, TASK, model_file, csls=3)
    with out.open(newline="", encoding="utf-8") as file:
        turned = list(csv.DictReader(file))
    assert main([*given, *options[:-2]]) == 0
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
        scores = [match.score + float(ranking.csls.query @ ranking.weights) for match in ranking.top(10)]
        assert [float(row[f"score {k}"]) for k in range(1, 11)] == pytest.approx(scores, abs=1e-5)


def test_weathers_have_no_table_of_queries(data: Path, model_file: Path, tmp_path: Path, refused: Refused) -> None:
    given = ["evaluate", data, "--model", model_file, "--weather", "all"]
    assert "choose one with --weather" in refused(*given, "--per-query", tmp_path / "queries.csv")
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("by_lists", [False, True])
def test_junk_is_left_out_and_names_are_no_formulas(by_lists: bool) -> None:
    rng = np.random.default_rng(4)
    query, gallery = (rng.standard_normal((count, 2, 3)).astype(np.float32) for count in (3, 6))
    labels = np.array([0, 1, 2, -1, 1, 0])
    none = np.zeros(0, np.int64)
    truth = [Truth(np.array(good), np.array(junk)) for good, junk in (([0, 5], [1, 3]), ([1, 4], [3]))]
    truth.append(Truth(none, none, known=False))
    lists = truth if by_lists else None
    task = replace(
        descriptor_task(query, gallery, np.arange(3), labels, lists),
        queries=[Picture(Path(), i, name) for i, name in enumerate(("=1+1", "b", "c"))],
        gallery=[Picture(Path(), i, f"-tile {i}") for i in range(6)],
    )
    found = measure(task, 8)
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


def test_weather_falls_on_the_drone_pictures_of_the_gallery(
    model: Model, dataset: Dataset, sides: dict[str, Float32Array]
) -> None:
    change = Change(weather=Weather("dark"))
    result = measure(changed(lazy_task(model, dataset, "satellite-to-drone"), change))
    photos = dataset.gallery("drone")
    drawn = np.stack([describe_picture(model, one.load(), "drone", change).descriptor for one in photos])
    expect_figures(result, sides["satellite"], PLACES, drawn, PLACES)
    assert "gallery pictures in the dark" in result.sentence


@pytest.mark.slow
def test_all_weathers_print_the_leaderboards_table(
    data: Path, model_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "weathers.json"
    command = ["evaluate", str(data), "--model", str(model_file), "--weather"]
    assert main([*command, "all", "--json", str(out)]) == 0
    printed = capsys.readouterr().out
    written = json.loads(out.read_text())
    assert list(written["weathers"]) == list(WEATHERS)
    for task in ("drone-to-satellite", "satellite-to-drone"):
        of_task = [results[task]["ap"] for results in written["weathers"].values()]
        assert written["mean"][task]["ap"] == pytest.approx(np.mean(of_task))
        assert len(set(of_task)) > 3
        assert task in printed
    assert f"{written['mean']['satellite-to-drone']['ap']:.2f}" in printed.split("mean")[1]
    assert main([*command, "rain", "--json", str(out)]) == 0
    rain = json.loads(out.read_text())
    assert rain["weather"] == {"name": "rain", "strength": 1.0, "seed": 0}
    assert rain["ap"] == written["weathers"]["rain"]["drone-to-satellite"]["ap"]


def test_tiles_have_no_weather(model: Model, dataset: Dataset) -> None:
    task = replace(lazy_task(model, dataset, "satellite-to-drone"), name="satellite-to-satellite")
    with pytest.raises(InputError, match="satellite tiles on both sides"):
        measure_weathers([task])
    with pytest.raises(InputError, match="satellite tiles on both sides"):
        in_weather(task, "fog")


def test_a_query_whose_truth_is_taken_away_is_not_graded(data: Path, model_file: Path) -> None:
    by_labels = open_source(SourceOptions(source=str(data), model=model_file)).task
    with pytest.raises(InputError, match="defined by labels"):
        by_labels.without_truth([0])
    none = np.zeros(0, np.int64)
    lists = [Truth(np.flatnonzero(by_labels.gallery_labels == label), none) for label in by_labels.query_labels]
    task = replace(by_labels, truth=lists)
    assert task.without_truth([]) is task
    failed = np.flatnonzero(task.outcomes.failed)
    assert len(failed)
    left = task.without_truth([int(failed[0])])
    assert left.without_truth(failed[:1].tolist()) is left
    np.testing.assert_array_equal(np.flatnonzero(left.outcomes.failed), failed[1:])
    assert (task.metrics["queries"], left.metrics["queries"]) == (len(lists), len(lists) - 1)
    assert left.search(int(failed[0])).relevant is None
