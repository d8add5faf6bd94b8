from __future__ import annotations

import csv
import io
import shutil
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
import torch
from rich.console import Console
from safetensors.torch import save_file

import lpn
from lpn.cli.main import main
from lpn.core import images
from lpn.core.errors import DataError, DivergedError, InputError, LPNError, ModelFileError
from lpn.core.files import exclusive_lock
from lpn.datasets import open_dataset
from lpn.datasets.rendered import UNFINISHED
from lpn.models.checkpoints import save
from lpn.models.lpn import LPN
from lpn.reproduce import jobs, report
from lpn.reproduce.measure import features_alone, read_measurements
from lpn.reproduce.record import RowRecord, TableRecord
from lpn.reproduce.run import Reproduction
from lpn.reproduce.sources import TASKS
from lpn.reproduce.tables import KEYS, SCALES, SHOWN, find, tables
from lpn.tasks.opening import lazy_task
from lpn.training.recipe import Recipe
from lpn.training.recipes import METRIC_LOSSES, RECIPES
from lpn.training.run_folder import here
from lpn.training.trainer import Trainer
from tests.conftest import Refused
from tools.fixtures import layouts, small_worlds
from tools.fixtures.trainings import make_resnets_shallow

QUICK = {"size": 64, "epochs": 1, "batch": 4, "precision": "float32"}


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("reproduce") / "places", train=4, test=6)


@pytest.fixture(autouse=True)
def _shallow(monkeypatch: pytest.MonkeyPatch) -> None:
    """Train networks of few layers: depth does not change what the tables name."""
    make_resnets_shallow(monkeypatch, first=2)


def reproduction(places: Path, out: Path, **options: Any) -> Reproduction:
    values: dict[str, Any] = {
        "data": [str(places)],
        "out": out,
        "models": {},
        "init": (),
        "seeds": (0,),
        "from_scratch": not options.get("init"),
        "console": Console(file=io.StringIO(), width=200),
    }
    scale = replace(SCALES["reduced"], changes=options.pop("changes", QUICK))
    return Reproduction(**{"scale": scale, **values, **options})


def said(made: Reproduction) -> str:
    assert isinstance(made.console.file, io.StringIO)
    return made.console.file.getvalue()


@pytest.mark.parametrize("has_google", [True, False])
def test_the_note_of_table_i_says_which_rows_are_trained_with_google(has_google: bool) -> None:
    scale = SCALES["paper"]
    table = find("table1", scale)
    google = [row.label for row in table.rows if row.training and scale.recipe(row.training, 0).google]
    assert google == ["Instance loss (baseline)", "LPN"]
    source = Mock(has_google=has_google, sizes=lambda _: "sizes")
    notes = " ".join(report.data_notes(table, [source], scale))
    assert ("LPN and the baseline are trained with google" in notes) == has_google


def test_at_the_paper_s_scale_the_recipes_are_the_paper_s() -> None:
    scale = SCALES["paper"]
    recipes = {
        training.name: scale.recipe(training, 0) for table in tables(scale).values() for training in table.trainings
    }
    assert (recipes["lpn"].backbone, recipes["lpn"].n_parts, recipes["lpn"].google) == ("resnet50", 4, True)
    assert not recipes["lpn-without-google"].google
    assert (recipes["lpn-512-pixels"].size, recipes["lpn-8-parts"].n_parts) == (512, 8)
    # Table II has the LPN of the text and the LPN of the released run, each by its own recipe.
    assert recipes["panorama-lpn-sequential"] == RECIPES["cvusa-paper"]
    assert recipes["panorama-lpn"] == RECIPES["cvusa-released"]
    assert (recipes["panorama-safa-lpn"].pooling, recipes["panorama-safa-lpn"].optimizer) == ("safa", "adam")
    assert recipes["panorama-safa-lpn"].input_size == (112, 616)
    released = SCALES["released"]
    of_table = {training.name: released.recipe(training, 0) for training in find("table1", released).trainings}
    rates = {name: (recipe.batch, recipe.lr) for name, recipe in of_table.items()}
    assert rates["lpn"] == (8, 0.001)
    # wtyhub/LPN run.sh:36
    assert rates["instance"] == (8, 0.01)
    # layumi/University1652-triplet-loss train.py:45, 48
    assert {rates[name] for name in METRIC_LOSSES} == {(32, 0.01)}
    assert all(recipes[name].google for name in ("instance", "lpn-8-parts", "lpn-512-pixels"))
    assert recipes["triplet-0.3"] == RECIPES["metric-released"]
    small = replace(scale, changes={"backbone": "resnet18", "last_layer": "layer3"})
    for table in tables(small).values():
        assert {small.recipe(training, 0).backbone for training in table.trainings} == {"resnet18"}
    safa = [recipes[f"panorama-{name}"] for name in ("safa", "safa-lpn")]
    assert [(one.backbone, one.n_parts, one.maps) for one in safa] == [("vgg16", 1, 8), ("vgg16", 8, 1)]


def test_rows_and_recipes_keep_the_settings_that_are_their_own() -> None:
    def recipes(scale: str, **changes: Any) -> dict[str, Recipe]:
        made = replace(SCALES[scale], changes=changes)
        return {training.name: made.recipe(training, 0) for training in find("table2", made).trainings}

    reduced = replace(SCALES["reduced"], changes={"size": 128, "epochs": 3})
    unrolled = ("panorama-instance-unrolled", "panorama-lpn-strips", "panorama-safa", "panorama-safa-lpn")
    made = recipes("reduced", size=128, epochs=3)
    assert {name for name, recipe in made.items() if recipe.input_size == (112, 616)} == set(unrolled)
    assert {recipe.epochs for recipe in made.values()} == {3}
    assert report.changes_note(reduced, find("table2", reduced).trainings) == (
        f"Changed: size = 128 (not for {', '.join(unrolled)}), epochs = 3."
    )
    full = recipes("paper", lr=0.02, last_layer="layer3")
    rates = {"panorama-safa": 1e-5, "panorama-lpn-sequential": 0.02, "panorama-lpn": 0.1}
    assert {name: full[name].lr for name in rates} == rates
    assert {recipe.last_layer for recipe in full.values()} == {"layer4"}
    assert recipes("released", lr=0.02)["panorama-lpn"].lr == 0.1


def test_changes_are_checked_with_the_recipe_of_each_training() -> None:
    def recipe(scale: str, key: str, **changes: Any) -> Any:
        made = replace(SCALES[scale], changes=changes)
        return made.recipe(find(key, made).trainings[0], 0)

    assert recipe("reduced", "table1", infonce=1.0).infonce == 1.0
    assert recipe("reduced", "table1", flip="place", place_rotation=20.0).place_rotation == 20.0
    assert recipe("paper", "table2", backbone_dropout=0.2).backbone_dropout == 0.2
    with pytest.raises(InputError, match=r"^instance cannot be trained with these flags: .* or sampling = places"):
        recipe("paper", "table1", infonce=1.0)
    with pytest.raises(InputError, match=r"^lpn cannot be trained .* resnet50, which has no dropout"):
        recipe("paper", "table5", backbone_dropout=0.2)


@pytest.mark.slow
def test_a_table_is_trained_measured_and_written_and_not_trained_again(places: Path, tmp_path: Path) -> None:
    made = reproduction(places, tmp_path, seeds=(0, 1))
    files = made.run(["table4", "table5", "figure8"])
    assert [file.name for file in files] == [*("table4.md", "table4.csv", "table5.md", "table5.csv", "figure8.png")]
    text = (tmp_path / "table4.md").read_text()
    assert "| 75.93 |" in text
    assert "Mean of the seeds trained so far" in text
    assert "Protocol: descriptors of picture and mirror added" in text
    assert "epochs = 1" in text
    with (tmp_path / "table4.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 2 * 5 * 4
    for row in rows:
        mean = (float(row["seed 0"]) + float(row["seed 1"])) / 2
        assert float(row["mean"]) == pytest.approx(mean, abs=1e-4)
    network = lpn.load(tmp_path / "runs" / "lpn-seed1" / "last.safetensors")
    results = [lazy_task(network, open_dataset(places), task).evaluate() for task in TASKS["both ways"]]
    expected = [value for result in results for value in (result.recall["1"], result.ap)]
    by_column = {row["column"]: float(row["seed 1"]) for row in rows if row["row"] == "LPN, 0°"}
    assert list(by_column.values()) == pytest.approx(expected, abs=1e-4)
    assert "Plan: 4 of 4 trainings are left: 4 epochs. A second process" in said(made)
    assert "(4 of 4 trainings)" in said(made)
    # The rotation of 0 degrees and all parts are the same measurement.
    by_angle = text.split("| LPN, 0° |")[1].split("\n")[0]
    assert by_angle == (tmp_path / "table5.md").read_text().split("| 1+2+3+4 |")[1].split("\n")[0]

    again = reproduction(places, tmp_path, seeds=(0, 1))
    again.run(["table4"])
    assert "Epoch" not in said(again)
    assert (tmp_path / "table4.md").read_text() == text
    with pytest.raises(InputError, match="other values of epochs"):
        reproduction(places, tmp_path, changes={**QUICK, "epochs": 2}).run(["table4"])


@pytest.mark.slow
def test_other_pictures_or_another_start_are_noticed(places: Path, tmp_path: Path) -> None:
    reproduction(places, tmp_path / "out").run(["table5"])
    before = (tmp_path / "out" / "table5.csv").read_text()
    shutil.copytree(places, tmp_path / "places")
    for name in ("query", "gallery"):
        shutil.rmtree(tmp_path / "places" / "test" / f"{name}_drone" / "0010")
    # The same training pictures with fewer test pictures, under the same folder name, are measured again.
    reproduction(tmp_path / "places", tmp_path / "out").run(["table5"])
    assert (tmp_path / "out" / "table5.csv").read_text() != before
    shutil.rmtree(tmp_path / "places" / "train" / "drone" / "0004")
    quick = {**QUICK, "batch": 3}
    with pytest.raises(InputError, match="other values of batch, pictures"):
        reproduction(tmp_path / "places", tmp_path / "out", changes=quick).run(["table5"])
    start = tmp_path / "start.safetensors"
    save(small_worlds.make_network(), start)
    with pytest.raises(InputError, match="other values of start"):
        reproduction(places, tmp_path / "out", init=[start]).run(["table5"])


@pytest.mark.slow
def test_a_run_killed_at_its_very_start_and_one_that_diverged_do_not_block(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    half = tmp_path / "runs" / "instance-seed0"
    half.mkdir(parents=True)
    (half / "last.safetensors").write_bytes(b"half")
    original = Trainer._epoch

    def explode(self: Trainer, *rest: Any) -> Any:
        if self.recipe.n_parts == 2:
            raise DivergedError("The loss became nan in epoch 1, step 1; start again.")
        return original(self, *rest)

    monkeypatch.setattr(Trainer, "_epoch", explode)
    made = reproduction(places, tmp_path)
    made.run(["figure5"])
    text = (tmp_path / "figure5.md").read_text()
    assert "lpn-2-parts, seed 0 is given up" in said(made)
    assert "| n = 2 | not run: its training diverged |" in text
    assert (tmp_path / "figure5.png").read_bytes()[:4] == b"\x89PNG"
    assert "Diverged, and given up: lpn-2-parts, seed 0." in text
    assert "| n = 8 | not run" not in text
    with (tmp_path / "figure5.csv").open(encoding="utf-8") as file:
        reasons = {row["row"]: row["not run"] for row in csv.DictReader(file)}
    assert {label: reason for label, reason in reasons.items() if reason} == {"n = 2": "its training diverged"}


def test_an_unfinished_run_goes_on_only_as_it_began(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    original, out, longer = Trainer._epoch, tmp_path / "out", {**QUICK, "epochs": 2}

    def stop(self: Trainer, epoch: int, *rest: Any) -> Any:
        if epoch == 1:
            raise KeyboardInterrupt
        return original(self, epoch, *rest)

    monkeypatch.setattr(Trainer, "_epoch", stop)
    with pytest.raises(KeyboardInterrupt):
        reproduction(places, out, changes=longer).run(["table5"])
    monkeypatch.setattr(Trainer, "_epoch", original)
    start = tmp_path / "start.safetensors"
    save(small_worlds.make_network(), start)
    with pytest.raises(InputError, match="other values of start"):
        reproduction(places, out, init=[start], changes=longer).run(["table5"])
    note = out / "runs" / "lpn-seed0" / "job.json"
    kept = note.read_bytes()
    note.write_bytes(b"{")
    with pytest.raises(InputError, match="does not say what is trained there"):
        reproduction(places, out, changes=longer).run(["table5"])
    note.write_bytes(kept)
    made = reproduction(places, out, changes=longer)
    made.run(["table5"])
    assert "Resuming after epoch 1 of 2" in said(made)


@pytest.mark.slow
def test_given_models_stand_for_trainings(
    places: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path
) -> None:
    model, baseline = model_file, one_part_model_file
    made = reproduction(places, tmp_path / "out", models={"lpn": model, "instance": baseline}, train=False)
    made.run(["table1", "table4", "figure7", "figure8"])
    text = (tmp_path / "out" / "table1.md").read_text()
    assert text.count("| not run |") == 5 * 3
    for said_there in (
        "# Table I: losses and LPN, on University-1652\n",
        "| Contrastive loss | not run: no --model gives contrastive, and --no-train trains none | 52.39 | not run |",
        "| LPN without google | not run: without train/google it would be the network of LPN |",
        "not known; ",
        f"Networks given: instance = {baseline.name} (Baseline resnet18/layer3, n = 1, 64 x 64), lpn = {model.name} (LPN",
        "drone-to-satellite 6 of 37,855 queries, 6 of 951 pictures in the gallery, satellite-to-drone 6 of 701",
    ):
        assert said_there in text
    assert not (tmp_path / "out" / "runs").exists()
    assert "which are 25.0 % of 4 x 4 cells; mean" in (tmp_path / "out" / "figure7.md").read_text(encoding="utf-8")


def test_what_cannot_be_made_is_said_before_anything_is_trained(places: Path, model_file: Path, tmp_path: Path) -> None:
    model, out = model_file, tmp_path / "out"
    start, two = model_file.with_suffix(".safetensors"), {"views": ("satellite", "street"), "shared": False}
    for options, keys, expected in (
        ({}, ["table1", "table2"], "Table II: .*: no panoramas and tiles as in CVUSA are given with --data; give them"),
        ({}, ["table9"], "There is no 'table9'"),
        ({"models": {"nobody": model}}, ["table1"], "--model names 'nobody'"),
        ({"models": {"lpn": tmp_path / "typo.onnx"}}, ["figure5", "table4"], "no model file"),
        ({"models": {"lpn": model}, "data": [str(landmarks(tmp_path))]}, ["table6"], "needs the view street"),
        # A view of a row that is missing in training, and a batch that would never be full.
        ({"data": [str(places), str(landmarks(tmp_path))]}, ["table6"], "the view street; places, on which instance"),
        ({"models": {"lpn": network(tmp_path / "two.safetensors", **two)}}, ["figure7"], "needs the view drone"),
        # A network under a wrong name, and a network without any measurement.
        ({"models": {"lpn-2-parts": model}}, ["figure5"], "has n_parts 4, and lpn-2-parts needs n_parts 2"),
        ({"models": {"lpn": start}, "changes": {}}, ["table4"], "has input_size 64 x 64, .* --size changes the size"),
        (
            {"models": {"lpn": network(tmp_path / "strips.safetensors", layout="strips")}},
            ["table5"],
            "has partitions satellite columns, drone columns, and lpn needs partitions satellite rings, drone rings",
        ),
        ({"models": {"lpn-2-parts": model}}, ["table5"], "as lpn-2-parts, which no requested row uses"),
        ({"queries": ["nope"]}, ["figure8"], "no query nope"),
        ({"data": [str(places), str(places)]}, ["table4"], "two data sets of places"),
        ({"init": [start, start]}, ["table4"], "both hold a resnet18"),
        ({"from_scratch": False}, ["table5"], "no --init has the weights of resnet18 for lpn; give its weights"),
        ({"init": [start], "from_scratch": True}, ["table5"], r"\(model.safetensors\) and --from-scratch exclude"),
        (
            {
                "scale": SCALES["paper"],
                "from_scratch": False,
                "data": [str(small_worlds.make_cvusa(tmp_path / "c", 32))],
            },
            ["table2"],
            "weights of vgg16_bn for panorama-instance, .*; vgg16 for panorama-safa, panorama-safa-lpn; give",
        ),
        ({"changes": {**QUICK, "batch": 5}}, ["table1"], "^instance cannot be trained on places. There are 4 places"),
    ):
        with pytest.raises(LPNError, match=expected):
            reproduction(places, out, **options).run(keys)
        assert not (out / "runs").exists()
    shutil.copytree(places, tmp_path / "broken")
    file = tmp_path / "broken" / "test" / "gallery_satellite" / "0007" / "0007.png"
    file.write_bytes(file.read_bytes()[:500])
    with pytest.raises(LPNError, match=r"1 of .* test pictures .* cannot be described: .*0007\.png"):
        reproduction(tmp_path / "broken", out).run(["table4"])
    assert not (out / "runs").exists()


def network(file: Path, **changes: Any) -> Path:
    """Write a network of another form than the small one."""
    save(LPN(replace(small_worlds.make_network().spec, **changes)), file)
    return file


def landmarks(folder: Path) -> Path:
    return folder / "oxford" if (folder / "oxford").is_dir() else layouts.oxford(folder / "oxford")


@pytest.mark.slow
def test_a_training_of_another_process_is_waited_for_and_taken_over_if_that_is_killed(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    taken = tmp_path / "runs" / "lpn-seed0"
    taken.mkdir(parents=True)
    other = ExitStack()
    other.enter_context(exclusive_lock(taken, wait=False))
    monkeypatch.setattr(jobs.time, "sleep", lambda _: other.close())
    made = reproduction(places, tmp_path, seeds=(0, 1))
    made.run(["table5"])
    text = said(made)
    assert text.index("lpn, seed 1 (1 of 2 trainings)") < text.index(
        "Waiting for another process, which trains lpn, seed 0."
    )
    assert "| 1+2+3+4 | not run" not in (tmp_path / "table5.md").read_text(encoding="utf-8")


def test_measured_json_says_where_each_figure_comes_from(places: Path, tmp_path: Path) -> None:
    reproduction(places, tmp_path).run(["table5"])
    table = read_measurements(tmp_path / "measured.json").tables["table5"]
    row = table.row("1+2+3+4")
    assert row.values == {"seed 0": row.mean}
    for made in (row.trained["seed 0"], row.measured["seed 0"]):
        assert made == here()
    assert here().version.startswith(lpn.__version__)
    assert "cores" in here().machine
    assert (tmp_path / "table5.md").read_text(encoding="utf-8") == report.markdown(table)


def test_a_command_is_recorded_without_a_machine_s_folders(monkeypatch: pytest.MonkeyPatch) -> None:
    given = ["/somewhere/lpn/__main__.py", "reproduce", "table1", "--data", "/home/a/world", "--out=/tmp/b/runs"]
    monkeypatch.setattr("sys.argv", [*given, "--model", "instance=/tmp/net.pth", "--init", "weights/resnet18.pth"])
    assert here.__wrapped__().command == (
        "lpn reproduce table1 --data world --out=runs --model instance=net.pth --init weights/resnet18.pth"
    )


def test_the_released_protocol_is_a_table_s_own(places: Path, model_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    scale = replace(SCALES["reduced"], changes=QUICK, protocol="released")
    options = {"models": {"lpn": model_file}, "train": False}
    reproduction(places, out, **options).run(["table4"])
    ours = (out / "table4.md").read_text(encoding="utf-8")
    reproduction(places, out, **options, scale=scale).run(["table4"])
    released = (out / "table4.md").read_text(encoding="utf-8")
    for text, own, other in ((ours, "protocol ours: bicubic", "nearest pixel"), (released, "nearest pixel", "bicubic")):
        assert own in text
        assert other not in text
    # Both are kept side by side.
    assert len(read_measurements(out / "measured.json").figures) == 2 * 5


def test_rows_whose_data_are_not_given_say_so_in_their_place(places: Path, model_file: Path, tmp_path: Path) -> None:
    options = {"models": {"lpn": model_file}, "train": False, "partial": True}
    made = reproduction(places, tmp_path, **options)
    files = made.run(["table2", "table5", "table6", "figure8"])
    assert [file.stem for file in files if file.suffix != ".csv"] == ["table2", "table5", "table6", "figure8"]
    assert "table2: 0 of 7 rows, and 8 quoted; no panoramas and tiles as in CVUSA are given with --data\n" in said(made)
    assert "table5: 7 of 7 rows\n" in said(made)
    text = (tmp_path / "table2.md").read_text(encoding="utf-8")
    assert text.startswith("### Table II: ground to satellite\n")
    reason = "not run: no panoramas and tiles as in CVUSA are given with --data"
    assert f"| SAFA | {reason} | 89.84 | not run | 96.93 | not run | 98.14 | not run | 99.64 |" in text
    assert "| CVFT (AAAI'20, VGG16) | quoted | 61.43 |" in text
    assert "Nothing was measured." in text
    reason = "not run: no landmarks as in Oxford5k or Paris6k are given with --data"
    assert f"| LPN, ground branch | {reason} | 51.71 | not run | 67.73 |" in (tmp_path / "table6.md").read_text(
        encoding="utf-8"
    )
    alone = reproduction(places, tmp_path / "landmarks", data=[str(landmarks(tmp_path))], train=False, partial=True)
    alone.run(["table5", "table6", "figure8"])
    assert "figure8 not drawn: no places are given with --data." in said(alone)
    text = (tmp_path / "landmarks" / "table6.md").read_text(encoding="utf-8")
    assert "| ImageNet alone | not run: no --init has the weights of resnet18 | 8.43 |" in text
    assert "| LPN, ground branch | not run: no places as in University-1652 are given with --data | 51.71 |" in text


@pytest.mark.slow
def test_all_runs_on_tiny_sets_in_the_released_layouts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = (
        layouts.university_gaps(tmp_path / "U1652"),
        layouts.cvusa(tmp_path / "CVUSA", train=2, test=2),
        layouts.oxford(tmp_path / "OXFORD"),
        layouts.paris(tmp_path / "PARIS"),
    )
    start, out = tmp_path / "start.safetensors", tmp_path / "out"
    save(small_worlds.make_network(), start)
    given = [argument for root in data for argument in ("--data", str(root))]
    flags = ["--recipe", "reduced", "--size", "64", "--epochs", "1", "--batch", "2", "--precision", "float32"]
    assert main(["reproduce", "all", *given, "--init", str(start), *flags, "--out", str(out)]) == 0
    text = capsys.readouterr().out
    for key in KEYS:
        if key in tables(SCALES["reduced"]):
            table = find(key, SCALES["reduced"])
            own = [row for row in table.rows if not row.quoted]
            quoted = f", and {len(table.rows) - len(own)} quoted" if len(own) < len(table.rows) else ""
            assert f"{key}: {len(own)} of {len(own)} rows{quoted}\n" in text
            assert "not run" not in (out / f"{key}.md").read_text(encoding="utf-8")
    order = ["table1: 7 of 7 rows", "Plan: 22 of 22 trainings are left: 22 epochs.", "(1 of 22 trainings"]
    assert [text.index(one) for one in order] == sorted(text.index(one) for one in order)
    assert "resnet18 starts from start.safetensors." in text
    assert "the hardest of other places among" in (out / "table1.md").read_text(encoding="utf-8")
    assert {file.stem for file in out.glob("*.png")} == {"figure5", *SHOWN}
    header = (out / "table6.md").read_text(encoding="utf-8").splitlines()[2]
    assert header == "|  | OXFORD mAP | paper | PARIS mAP | paper |"


def test_features_alone_need_the_whole_backbone(tmp_path: Path) -> None:
    save_file({"conv1.weight": torch.zeros(64, 3, 7, 7)}, str(tmp_path / "half.safetensors"))
    with pytest.raises(ModelFileError, match="lacks"):
        features_alone(replace(SCALES["reduced"], changes=QUICK).base, tmp_path / "half.safetensors")


def test_figures_have_their_own_names_and_say_which_network_they_lack(
    places: Path, model_file: Path, tmp_path: Path
) -> None:
    made = reproduction(places, tmp_path / "out", models={"lpn": model_file}, train=False)
    assert [file.name for file in made.run(["figure1"])] == ["figure1.png"]
    # One place: the drone picture and its tile, each without and with activation.
    image = images.load_picture(tmp_path / "out" / "figure1.png")
    assert image.shape[:2] == (420, 420)
    assert "figure1 drawn without some networks: there is no network instance" in said(made)
    assert [file.name for file in made.run(["figure3", "figure4"])] == ["figure3.png", "figure4.png"]
    none = reproduction(places, tmp_path / "none", train=False)
    assert none.run(["figure8"]) == []
    assert "figure8 not drawn: there is no network lpn; give it as --model lpn=FILE" in said(none)
    assert said(none).count("figure8 not drawn") == 1
    # Figure 8 (III), section IV-E: "our method with SAFA".
    recipe = SCALES["paper"].recipe(SHOWN["figure8-panoramas"][0], 0)
    assert (recipe.pooling, recipe.n_parts, recipe.polar) == ("safa", 8, True)


def test_a_world_is_named_as_one_and_refused_while_pictures_are_missing(model_file: Path, tmp_path: Path) -> None:
    root = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "half", train=4, test=3))
    (root / "world.json").write_text("{}")
    options = {"data": [str(root)], "models": {"lpn": model_file}, "train": False}
    reproduction(root, tmp_path / "whole", **options).run(["table5"])
    text = (tmp_path / "whole" / "table5.md").read_text(encoding="utf-8")
    assert text.startswith("### Table V: parts used, on a rendered world\n")
    assert "the rendered world, not the paper's data sets" in text
    (root / UNFINISHED).touch()
    with pytest.raises(DataError, match="half is not rendered to its end"):
        reproduction(root, tmp_path / "out", **options).run(["table5"])


def test_clauses_that_differ_are_said_with_the_rows_they_hold_for() -> None:
    rows = dict.fromkeys(("Baseline", "LPN"), "Protocol: mirror added; ranked.") | {
        "SAFA": "Protocol: as it is; ranked."
    }
    note = "Protocol: ranked. Not in every row: mirror added (all but SAFA); as it is (SAFA)."
    assert report.protocol_note(rows) == note
    assert report.protocol_note({"LPN": rows["LPN"]}) == rows["LPN"]


def record(key: str, values: dict[str, list[float]]) -> TableRecord:
    """A table's record with the same values in every column, one for each seed."""
    table = find(key, SCALES["paper"])
    rows = [
        RowRecord(row.label, {f"seed {n}": (value,) * len(table.columns) for n, value in enumerate(values[row.label])})
        for row in table.rows
        if row.label in values
    ]
    return TableRecord(key, table.title, table.columns, tuple(range(len(table.columns))), tuple(rows))


def test_claims_are_judged_by_the_figures_and_the_interval_of_the_seeds() -> None:
    def verdict(lpn: list[float], baseline: list[float]) -> str:
        return report.verdicts(record("table1", {"LPN": lpn, "Instance loss (baseline)": baseline}))[0]

    held = verdict([70], [50])
    assert "**held** (drone → satellite R@1: LPN 70.0, Instance loss (baseline) 50.0; drone → satellite AP" in held
    assert held.endswith("; one network each).")
    assert "**did not hold**" in verdict([50], [50])
    assert "within the interval of the seeds for LPN, Instance loss (baseline)**" in verdict([49, 55], [47, 53])
    assert verdict([69, 71], [50]).endswith("; one network of Instance loss (baseline)).")
    assert verdict([69, 71], [50, 52]).endswith("Instance loss (baseline) 51.0).")
    assert "not known; LPN was not run" in report.verdicts(record("table1", {"Instance loss (baseline)": [1]}))[0]


def test_a_gain_within_the_interval_of_the_seeds_is_said_to_be_so() -> None:
    def verdict(larger: list[float], smaller: list[float]) -> str:
        return report.verdicts(record("table3", {"512": larger, "384": smaller}))[1]

    assert "bring drone queries nothing over 384 (Table III): **held** (" in verdict([50, 50], [60, 60])
    assert "**held in the mean, but within the interval of the seeds**" in verdict([50, 70], [60, 61])
    assert "**did not hold, 5.0 points where 0.0 are allowed**" in verdict([60, 60], [55, 55])
    said = verdict([59, 62], [59, 61])
    assert "**did not hold, 0.5 points where 0.0 are allowed, but within the interval of the seeds**" in said
    # The paper loses 6.47 points of AP with turned drone queries, and 1.29 of R@1 with satellite queries.
    labels = [row.label for row in find("table4", SCALES["paper"]).rows]
    turned = record("table4", {label: [80 if label == "LPN, 0°" else 80 - 6.47] for label in labels})
    drone, satellite = report.verdicts(turned)
    assert "no significant drop (Table IV): **held**" in drone
    assert "**did not hold, 6.5 points where 1.3 are allowed**" in satellite


def test_table_ii_has_the_figures_that_the_paper_prints() -> None:
    quoted = {row.label.partition(" (")[0]: row.paper for row in find("table2", SCALES["paper"]).rows if row.quoted}
    assert quoted == {
        "MCVPlaces": (None, None, None, 34.40),
        "Zhai": (None, None, None, 43.20),
        "Vo": (None, None, None, 63.70),
        "CVM-Net": (18.80, 44.42, 57.47, 91.54),
        "Orientation, with orientation as input": (27.15, 54.66, 67.54, 93.91),
        "Regmi": (48.75, None, 81.27, 95.98),
        "Siam-FCANet": (None, None, None, 98.30),
        "CVFT": (61.43, 84.69, 90.94, 99.02),
    }


@pytest.mark.parametrize("key", [key for key in tables(SCALES["paper"]) if key != "figure7"])
def test_every_claim_holds_on_the_papers_own_values(key: str) -> None:
    table = find(key, SCALES["paper"])
    assert {len(row.paper) for row in table.rows} <= {0, len(table.columns)}
    printed = {row.label: row.paper for row in table.rows if row.paper and not row.quoted}
    rows = tuple(RowRecord(label, {"paper": tuple(value or 0.0 for value in of)}) for label, of in printed.items())
    found = report.verdicts(TableRecord(key, table.title, table.columns, (), rows))
    # Figure 5 prints only a curve for the other n.
    assert all("**held**" in verdict or (key == "figure5" and "was not run" in verdict) for verdict in found), found


def test_the_command_collects_repeated_flags_and_wants_to_know_what(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, refused: Refused
) -> None:
    seen: list[Reproduction] = []
    monkeypatch.setattr(Reproduction, "run", lambda self, _: seen.append(self) or [])
    data = ["--data", str(places)]
    given = ["--data", "b", "--model", "x.onnx", "--model", "instance=y.onnx", "--seeds", "0", "1", "--batch", "8"]
    assert main(["reproduce", "table1", "table4", *data, *given, "--out", str(tmp_path)]) == 0
    assert (seen[0].data, seen[0].seeds, seen[0].scale.name) == ((str(places), "b"), (0, 1), "paper")
    assert seen[0].models == {"lpn": Path("x.onnx"), "instance": Path("y.onnx")}
    assert seen[0].scale.changes == {"batch": 8}
    # A flag that one recipe excludes may fit others, so each training's recipe decides.
    flags = ["--recipe", "released", "--lr", "0.01", "--no-joint-views", "--label-smoothing=0", "--infonce", "1"]
    assert main(["reproduce", "table1", *data, *flags]) == 0
    assert seen[1].scale.changes == {"lr": 0.01, "joint_views": False, "label_smoothing": 0.0, "infonce": 1.0}
    assert seen[1].scale.name == "released"
    for arguments, said in (
        (["table5", *data, "--model", "x.onnx", "--model", "lpn=y.onnx"], "two files as lpn, x.onnx and y.onnx"),
        (["table1", *data, "--dropout", "2"], "dropout = 2.0"),
        (["table1", *data, "--n-parts", "2"], "distinguishes the rows of the tables"),
        (["table1", *data, "--seed", "2"], "give --seeds"),
        (["table1", *data, "--recipe", "small"], "no recipe 'small' to reproduce with; choose one of auto, paper"),
        (data, "Say what to reproduce"),
    ):
        assert said in refused("reproduce", *arguments)
