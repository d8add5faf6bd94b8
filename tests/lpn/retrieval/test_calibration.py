"""Calibration without labels: zooms, means, their effect on descriptors, and refusals."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from safetensors import safe_open

import lpn
from explorer.opening import open_model
from lpn.cli.main import main
from lpn.core import images
from lpn.core.demo import DEMO
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Picture, open_dataset
from lpn.descriptors.cache import cached_descriptors, temporary_descriptors
from lpn.descriptors.transforms import Change
from lpn.library.analyser import OwnPicture, QueryAnalyser, QueryRequest, describe_tile
from lpn.models.base import Model, normalise
from lpn.models.onnx_engine import Engine
from lpn.retrieval.calibration import PRIOR, STEP, Calibration, calibrate, centred, ground_ratio
from lpn.sources import ModelOptions
from lpn.tasks.changes import calibrated, changed, turned
from lpn.tasks.changes import centred as centred_task
from lpn.tasks.opening import alike_calibrations, describe_task, lazy_task, new_calibration, task_calibration
from lpn.tasks.task import scored_key
from tests.conftest import MakeOnce
from tools.fixtures import small_worlds
from tools.fixtures.published_results import save_result

TASK = "drone-to-satellite"
PLACES = 24
# Zoom steps from a tile's ground to its drone picture's: two for most, three for every fourth.
WIDER = [3 if i % 4 == 0 else 2 for i in range(PLACES)]


@pytest.fixture(scope="module")
def wide(make_once: MakeOnce) -> Path:
    """Test places whose drone pictures show more ground than their tiles."""

    def fill(folder: Path) -> None:
        for i, steps in enumerate(WIDER):
            ground = images.resize(small_worlds.place(100 + i), 192, 192)
            shown = images.resize(images.zoom(ground, 2 / STEP**steps), 96, 96)
            tile = images.resize(images.zoom(ground, 2), 96, 96)
            small_worlds.write(folder / f"places/test/query_drone/{i:04d}/1.png", shown)
            small_worlds.write(folder / f"places/test/gallery_satellite/{i:04d}/{i:04d}.png", tile)

    return make_once("wide-places", fill) / "places"


@pytest.fixture(scope="module", autouse=True)
def _own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Keep the descriptors of the same pictures at several zooms for all tests of this file."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(tmp_path_factory.mktemp("calibration")))
        yield


@pytest.fixture(scope="module")
def found(model: Model, wide: Path) -> Calibration:
    return calibrate(model, sides(wide), cached_descriptors)


def sides(root: Path) -> dict[View, list[list[Picture]]]:
    dataset = open_dataset(root)
    return {"drone": [dataset.queries("drone")], "satellite": [dataset.gallery("satellite")]}


def test_the_ratio_of_all_and_of_each_picture_is_found(found: Calibration) -> None:
    assert found.ratio == pytest.approx(STEP**2)
    assert max(found.tried, key=lambda ratio: found.tried[ratio]) == found.ratio
    steps = np.log([found.zooms["drone"][path] for path in sorted(found.zooms["drone"])]) / np.log(STEP)
    assert np.abs(steps - np.array(WIDER)).mean() < 0.35
    assert set(found.zooms["satellite"].values()) == {1.0}
    assert [level.cost for level in found.levels] == pytest.approx([4 * PRIOR, PRIOR, 0, PRIOR, 4 * PRIOR])
    assert found.describe() == (
        "calibrated without labels on 24 drone and 24 satellite pictures, drone pictures zoomed by "
        f"{min(found.zooms['drone'].values()):.2f} to {max(found.zooms['drone'].values()):.2f}, the mean of each view subtracted"
    )


def test_tiles_are_zoomed_where_drone_pictures_show_less(model: Model, wide: Path) -> None:
    swapped = sides(wide)
    found = calibrate(model, {"drone": swapped["satellite"], "satellite": swapped["drone"]}, cached_descriptors)
    assert found.ratio == pytest.approx(STEP**-2)
    assert set(found.zooms["satellite"].values()) == {STEP**2}
    # No drone picture can be shrunk, so none takes a smaller ratio.
    assert min(found.zooms["drone"].values()) == 1


def test_a_zoom_that_gains_nothing_is_not_chosen(model: Model, tmp_path: Path) -> None:
    shades = np.random.default_rng(0).integers(0, 256, (20, 1, 1, 3), np.uint8)
    for i, shade in enumerate(shades.repeat(64, 1).repeat(64, 2)):
        for folder in ("query_drone", "gallery_satellite"):
            small_worlds.write(tmp_path / "test" / folder / f"{i:04d}/1.png", shade)
    found = calibrate(model, sides(tmp_path), cached_descriptors)
    assert len(found.levels) > 1
    assert set(found.zooms["drone"].values()) == set(found.zooms["satellite"].values()) == {1.0}


def test_a_training_takes_the_same_ratio(model: Model, wide: Path) -> None:
    (drones,), (tiles,) = sides(wide).values()
    assert ground_ratio(model, drones, tiles, cached_descriptors) == pytest.approx(STEP**2)
    assert ground_ratio(model, tiles, drones, cached_descriptors) == pytest.approx(STEP**-2)
    with pytest.raises(InputError, match=r"20 pictures of each view or more, and there are 19 drone pictures; set"):
        ground_ratio(model, drones[:19], tiles, cached_descriptors)
    around = [replace(one, panorama=True) for one in drones]
    with pytest.raises(InputError, match="these are panoramas or unrolled; leave it at 1"):
        ground_ratio(model, around, tiles, cached_descriptors)


@pytest.mark.slow
def test_a_training_measures_the_ratio_of_its_pictures_and_records_it(
    model_file: Path, wide: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "places"
    shutil.copytree(wide / "test/query_drone", root / "train/drone")
    shutil.copytree(wide / "test/gallery_satellite", root / "train/satellite")
    options = ["--data", str(root), "--recipe", "small", "--epochs", "1", "--warmup-epochs", "0", "--size", "32"]
    start = ["--init", str(model_file.with_suffix(".safetensors")), "--calibrate", "--batch", "8"]
    assert main(["train", *options, *start, "--out", str(tmp_path / "run")]) == 0
    with safe_open(tmp_path / "run/last.safetensors", "np") as file:
        recipe = json.loads(file.metadata()["recipe"])
    assert recipe["ground_ratio"] == pytest.approx(STEP**2, abs=0.01)
    again = [*options, *start, "--out", str(tmp_path / "run"), "--resume"]
    assert main(["train", *again]) == 0
    assert main(["train", *options, *start, "--out", str(tmp_path / "twice"), "--ground-ratio", "2"]) == 2
    untrained = [*options, "--init", "auto", "--calibrate", "--out", str(tmp_path / "twice")]
    assert main(["train", *untrained]) == 2
    assert "such as city-lpn, and --init auto is not one" in capsys.readouterr().err
    assert main(["train", *options, "--from-scratch", "--calibrate", "--out", str(tmp_path / "none")]) == 2
    assert not (tmp_path / "twice").exists()


def test_descriptors_are_those_of_the_zoomed_pictures_without_the_mean(
    model: Model, wide: Path, found: Calibration
) -> None:
    pictures = found.pictures("drone", sides(wide)["drone"][0])
    prepared = np.stack([model.prepare(picture.load_zoomed(), "drone") for picture in pictures])
    plain = model.descriptors(prepared, "drone")
    np.testing.assert_allclose(found.means["drone"], plain.mean(axis=0), atol=1e-6)
    read = found.read(model, pictures, "drone", cached_descriptors)
    np.testing.assert_allclose(read, normalise(plain - plain.mean(axis=0)), atol=1e-5)
    np.testing.assert_allclose(found.applied(model).descriptors(prepared, "drone"), read, atol=1e-5)
    assert pictures[0].note == f"zoomed by {pictures[0].zoom:.2f}"
    assert pictures[0].load_zoomed().shape < pictures[0].load().shape


def test_evaluation_by_a_calibration_finds_more_and_says_so(model: Model, wide: Path) -> None:
    dataset = open_dataset(wide)
    calibration = task_calibration(model, dataset, True)
    task = lazy_task(model, dataset, TASK)
    better = calibrated(task, calibration)
    plain, moved = task.evaluate(), better.evaluate()
    assert moved.recall["1"] > plain.recall["1"]
    assert "calibrated without labels on 24 drone and 24 satellite pictures" in moved.sentence
    assert moved.to_dict()["calibration"]["ratio"] == pytest.approx(STEP**2)
    assert plain.to_dict()["calibration"] is None
    assert turned(better, 90).evaluate().recall["1"] < moved.recall["1"]
    with pytest.raises(InputError, match=r"scale is 12, and the calibration zooms drone pictures by up to .*expected"):
        changed(better, Change(scale=12)).evaluate()


@pytest.mark.slow
def test_models_are_compared_plain_and_calibrated(model_file: Path, wide: Path, tmp_path: Path) -> None:
    table = tmp_path / "table.json"
    main(["compare", str(wide), "--model", str(model_file), "--calibrate", "--json", str(table)])
    plain, moved = json.loads(table.read_bytes())["models"]
    assert [plain["name"], moved["name"]] == ["model.onnx, plain", "model.onnx, calibrated"]
    assert moved["R@1"]["value"] > plain["R@1"]["value"]
    assert main(["compare", str(wide), "saved.mat", "--model", str(model_file), "--calibrate"]) == 2
    outputs = ["--json", str(table), "--table", str(tmp_path / "table.tex")]
    assert main(["compare", str(wide), "--model", str(model_file), "--calibrate", "--csls", "3", *outputs]) == 0
    assert "\nmodel.onnx, calibrated, CSLS & " in (tmp_path / "table.tex").read_text("utf-8")
    rows = json.loads(table.read_bytes())["models"]
    assert [row["name"] for row in rows] == [plain["name"], moved["name"], "model.onnx, calibrated, CSLS"]
    assert rows[1]["R@1"]["value"] == moved["R@1"]["value"]
    alone = lpn.evaluate(model_file, wide, TASK, calibrate=True, csls=3)
    assert rows[2]["R@1"]["value"] == pytest.approx(alone.recall["1"])
    assert "less half of each tile's mean inner product with its 3 nearest queries (CSLS)" in alone.sentence
    assert main(["compare", str(wide), "--model", str(model_file), "--csls", "-1"]) == 2


def test_beside_a_result_a_data_set_is_ranked_plain(
    model_file: Path, wide: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("lpn.tasks.opening.shipped_calibration", new_calibration)
    saved, table = tmp_path / "r.mat", tmp_path / "table.json"
    save_result(saved, wide, model_file)
    given = ["--model", str(model_file), "--task", TASK, "--json", str(table)]
    assert main(["compare", str(wide), str(saved), *given]) == 0
    assert [row["name"] for row in json.loads(table.read_bytes())["models"]] == ["model.onnx", "r.mat"]


@pytest.mark.slow
def test_a_task_searches_shows_and_explains_calibrated_pictures(model: Model, wide: Path) -> None:
    dataset = open_dataset(wide)
    calibration = new_calibration(model, dataset)
    task = describe_task(model, "model.onnx", dataset, TASK, calibration=calibration)
    expected = calibrated(lazy_task(model, dataset, TASK), calibration).evaluate()
    assert task.metrics["recall@1"] == pytest.approx(expected.recall["1"])
    moved = task.model
    analyser = QueryAnalyser(moved, lambda of, index: describe_tile(of, index, moved))
    analysis = analyser.analyse(task, QueryRequest(0, evidence=True), 5)
    np.testing.assert_allclose(analysis.query.descriptor, task.query_descriptors[0], atol=1e-5)
    np.testing.assert_array_equal(analysis.query.picture, task.queries[0].load_zoomed())
    # The contributions of all cells, and the constants with the means in them, still make up the score.
    assert analysis.pair_evidence.evidence.score == pytest.approx(analysis.chosen.score, abs=1e-4)
    assert task.contract.claim == "exact, with the length of the mean's term held"
    own = analyser.analyse(task, QueryRequest(OwnPicture("mine", task.queries[0].load())), 5)
    assert own.zoom == analysis.zoom == task.queries[0].zoom != 1
    np.testing.assert_allclose(own.query.descriptor, analysis.query.descriptor, atol=1e-5)
    # A change means the same in an evaluation, in the explorer, and in a sweep.
    change = Change(rotate=30, scale=0.9)
    expected_rows = calibration.read(model, dataset.queries("drone"), "drone", change=change)
    changed = analyser.analyse(task, QueryRequest(0, change), 5)
    np.testing.assert_allclose(changed.query.descriptor, expected_rows[0], atol=1e-5)


@pytest.mark.slow
def test_the_explorer_calibrates_both_models(model_file: Path, one_part_model_file: Path, wide: Path) -> None:
    workspace = open_model(wide, model_file, beside=[ModelOptions(model=one_part_model_file)], calibrate=True)
    other = workspace.beside[0].open()
    assert other.wait(60)
    assert scored_key(TASK, "calibrated") in workspace.rankings.keys() & other.value.rankings.keys()


def test_too_few_pictures_are_refused(model: Model, data: Path) -> None:
    with pytest.raises(InputError, match="there are 14 drone pictures; leave --calibrate out"):
        calibrate(model, sides(data), cached_descriptors)
    with pytest.raises(InputError, match="two views or more, and all pictures are of drone; leave --calibrate out"):
        calibrate(model, {"drone": sides(data)["drone"]}, cached_descriptors)


def test_panoramas_keep_their_zoom(model: Model, wide: Path) -> None:
    around = {view: [[replace(one, panorama=view == "drone") for one in of[0]]] for view, of in sides(wide).items()}
    found = calibrate(model, around, cached_descriptors)
    assert (found.ratio, dict(found.tried), set(found.zooms["drone"].values())) == (1.0, {}, {1.0})
    described = found.read(model, around["drone"][0], "drone", cached_descriptors)
    np.testing.assert_allclose(described, centred(temporary_descriptors(model, around["drone"][0], "drone")), atol=1e-5)
    assert "zoomed" not in found.describe()


def test_a_calibration_has_two_views_and_their_branches(model: Model, wide: Path) -> None:
    dataset = open_dataset(wide)
    calibration = task_calibration(model, dataset, True)
    for task in (
        lazy_task(model, dataset, TASK, branch="satellite"),
        lazy_task(model, dataset, TASK, released=True),
        centred_task(lazy_task(model, dataset, TASK)),
        turned(lazy_task(model, dataset, TASK), 90),
    ):
        with pytest.raises(InputError, match="leave out --centre, another branch, and the released protocol"):
            calibrated(task, calibration)
        assert task.evaluate().calibration is None
    with pytest.raises(InputError, match="leave --centre or the calibration out"):
        centred_task(calibrated(lazy_task(model, dataset, TASK), calibration))


def test_every_way_to_a_scoring_ranks_alike(model: Model, wide: Path, model_file: Path, tmp_path: Path) -> None:
    folders = [wide / "test" / name for name in ("gallery_satellite", "query_drone")]
    for asked, csls, scoring in (
        (None, 0, "plain"),
        (True, 0, "calibrated"),
        (True, 3, "csls"),
        (False, 3, "csls"),
    ):
        task = lpn.open_task(wide, TASK, model, calibrate=asked, csls=csls)
        assert (task.scoring, task.calibration is not None) == (scoring, bool(asked))
        measured = lpn.evaluate(model_file, wide, TASK, calibrate=asked, csls=csls)
        assert task.metrics["recall@1"] == pytest.approx(measured.recall["1"])
        queries = folders[1] if asked or csls else None
        gallery = lpn.Gallery.of_folder(folders[0], model, queries=queries, calibrate=asked, csls=csls)
        for query, weights in ((0, None), (5, [1, 2, 0, 1])):
            answer = gallery.search(task.queries[query].load(), weights=weights)
            expected = task.search(query, weights)
            np.testing.assert_allclose(answer.ranking.scores, expected.scores, atol=1e-5)
            first = answer.top(1)[0]
            assert first.contributions.sum() == pytest.approx(first.distance2, abs=1e-5)
            assert answer.evidence().score == pytest.approx(first.score, abs=1e-4)
        tile, given = folders[0] / first.name, ["--weights", "1,2,0,1", "--json", str(tmp_path / "why.json")]
        given += [f"--{'' if asked else 'no-'}calibrate", "--csls", str(csls)]
        pair = ["--query", str(task.queries[5].path), "--match", str(tile)]
        assert main(["explain", str(wide), "--model", str(model_file), *pair, *given]) == 0
        explained = json.loads((tmp_path / "why.json").read_text())
        assert explained["score"] == pytest.approx(first.score, abs=1e-5)
        assert ("csls" in explained) == bool(csls)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"calibrate": "yes"}, "calibrate is 'yes'; expected True, False, or None"),
        ({"csls": 25}, "over 25 nearest queries, and there are 24; expected 1 to 24"),
        ({"csls": "many"}, "over 'many' nearest queries, and there are 24; expected a whole number from 1 to 24"),
        ({"task": 7}, "The task is 7; with this model, places has the tasks drone-to-satellite"),
        ({"data": 7}, "The data set is of the type int; expected its folder"),
        ({"model": 7}, "The model is of the type int; expected a model, its file, or a name"),
    ],
)
def test_a_wrong_argument_is_told_in_one_sentence(
    options: dict[str, object], message: str, model: Model, wide: Path
) -> None:
    given = {"model": model, "data": wide, "task": TASK, **options}
    for function in (lpn.evaluate, lpn.open_task):
        with pytest.raises(InputError, match=message):
            function(**given)
    with pytest.raises(InputError, match="The change is of the type str"):
        lpn.evaluate(model, wide, TASK, "published")


def test_the_demo_is_ranked_by_the_calibration_that_ships(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("lpn.tasks.opening.new_calibration", None)  # nothing is calibrated anew
    for asked, scoring, recall in ((None, "calibrated", 84.7), (True, "calibrated", 84.7), (False, "plain", 70.1)):
        task = lpn.open_task(DEMO, TASK, calibrate=asked)
        assert (task.scoring, round(task.metrics["recall@1"], 1)) == (scoring, recall)
    # The command needs no network: the calibrated descriptors ship, too.
    monkeypatch.setattr(Engine, "run", None)
    for given in ({}, {"csls": 3}):
        assert lpn.evaluate(DEMO / "lpn.onnx", DEMO, **given).recall["1"] >= 84.7
    # No calibration of the other model ships: compared models are ranked alike.
    models = [lpn.load(DEMO / name) for name in ("lpn.onnx", "baseline.onnx")]
    assert alike_calibrations(models, open_dataset(DEMO)) == [None, None]
    assert alike_calibrations(models[:1], open_dataset(DEMO)) != [None]


def test_pictures_of_queries_come_with_a_calibration_or_csls(model: Model, wide: Path) -> None:
    tiles, drones = (wide / "test" / name for name in ("gallery_satellite", "query_drone"))
    for options in ({"calibrate": True}, {"csls": 3}, {"queries": drones}):
        with pytest.raises(InputError, match="give it as queries, together with one of both, or leave all three out"):
            lpn.Gallery.of_folder(tiles, model, **options)
    gallery = lpn.Gallery.of_folder(tiles, model, queries=drones, calibrate=True)
    with pytest.raises(InputError, match="drone and satellite pictures, and this one is of street; change the view"):
        gallery.calibration.own_zoom(model, np.zeros((8, 8, 3), np.uint8), "street")
