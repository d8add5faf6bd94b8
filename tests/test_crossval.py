"""Cross-validation: folds, trials, figures that add up, resuming, and that no test picture is read."""

from __future__ import annotations

import io
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console

from lpn.core.errors import InputError
from lpn.datasets import open_dataset
from lpn.datasets.layouts.university import University
from lpn.retrieval import calibration
from lpn.training.trainer import Trainer
from lpn.training.training_set import Fold, TrainingSet
from tools import crossval
from tools.crossval import CrossValidation, RecipeTrial, parse_trial, summary
from tools.fixtures import small_worlds, trainings

QUICK = replace(trainings.QUICK, epochs=1, n_parts=2)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("crossval") / "places", train=13, test=4)


def validation(places: Path, out: Path, *trials: RecipeTrial, **options: Any) -> CrossValidation:
    console = Console(file=io.StringIO(), width=200)
    options = {"folds": 2, "from_scratch": True, "console": console} | options
    return CrossValidation(open_dataset(places), out, QUICK, trials, **options)


@pytest.mark.slow
def test_held_out_places_are_read_calibrated_where_there_are_enough(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (crossval, calibration):
        monkeypatch.setattr(module, "MIN_PICTURES", 4)
    trials = (RecipeTrial("base", {}), RecipeTrial("wide", {"ground_ratio": 2.0}))
    values = validation(places, tmp_path / "runs", *trials, run_folds=1).run(tmp_path / "table.json")
    fold = json.loads((tmp_path / "runs/wide-seed0-fold0/fold.json").read_bytes())
    task = "satellite-to-drone"
    first = np.array(fold["first"][task]["calibrated"])
    figures = values["trials"]["wide"]["figures"][task]["calibrated"]["R@1"]
    assert figures["mean"] == pytest.approx(100 * np.mean(first == 0))
    assert set(values["differences"]["wide"][task]) == {"plain", "centred", "calibrated"}


def test_a_reading_that_one_fold_is_too_small_for_is_left_out(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (crossval, calibration):
        monkeypatch.setattr(module, "MIN_PICTURES", 7)
    values = validation(places, tmp_path / "runs", RecipeTrial("base", {})).run(tmp_path / "table.json")
    folds = [json.loads((tmp_path / f"runs/base-seed0-fold{number}/fold.json").read_bytes()) for number in (0, 1)]
    assert ["calibrated" in fold["first"]["drone-to-satellite"] for fold in folds] == [True, False]
    assert list(values["trials"]["base"]["figures"]["drone-to-satellite"]) == ["plain", "centred"]


def test_folds_share_the_places_out_evenly_whatever_the_recipe_s_seed(places: Path) -> None:
    held: list[list[int]] = []
    for number in range(3):
        training = TrainingSet(open_dataset(places), Console(quiet=True))
        out = training.hold_out(Fold(number, 3), seed=number)
        assert not set(out) & set(training.labels)
        assert len(training) == len(training.files["drone"]) == 13 - len(out)
        held.append(list(out))
    assert sorted(map(len, held)) == [4, 4, 5]
    assert sorted(label for one in held for label in one) == sorted(
        TrainingSet(open_dataset(places), Console(quiet=True)).labels
    )
    again = TrainingSet(open_dataset(places), Console(quiet=True))
    assert list(again.hold_out(Fold(0, 3), seed=9)) == held[0]
    with pytest.raises(InputError, match=r"number of folds is 7; .* at least 2 of the 8 places"):
        again.hold_out(Fold(0, 7), seed=0)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a b", "has no valid name; expected NAME or NAME:setting=value"),
        (":lr=1", "has no valid name"),
        ("a:speed=1", "has 'speed=1'; expected setting=value, a setting of lpn train --help"),
        ("a:lr", "has 'lr'; expected setting=value"),
        ("a:seed=3", "seeds are given with --seeds"),
        ("a:epochs=many", "has 'epochs=many' .* give another value"),
        ("a:epochs=0", "epochs = 0; expected a whole number of at least 1"),
        ("a:metric=best", "has 'metric=best'"),
        ("a:memory=true", "has 'memory=true'"),
    ],
)
def test_mistaken_trials_get_one_sentence(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said) as error:
        parse_trial(text, QUICK)
    assert "\n" not in str(error.value)


def test_a_trial_has_values_of_its_settings_types() -> None:
    made = parse_trial("deep:backbone=resnet50,epochs=20,place-rotation=5,joint_views=false", QUICK)
    assert made == RecipeTrial(
        "deep", {"backbone": "resnet50", "epochs": 20, "place_rotation": 5.0, "joint_views": False}
    )
    assert parse_trial("base", QUICK) == RecipeTrial("base", {})


def test_trials_are_compared_place_by_place_on_training_pictures_alone(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise AssertionError("the test split was read")

    for name in ("queries", "gallery", "truth"):
        monkeypatch.setattr(University, name, refused)
    trials = (RecipeTrial("base", {}), RecipeTrial("still", {"colour": 0.0}))
    table = tmp_path / "table.json"
    values = validation(places, tmp_path / "runs", *trials).run(table)
    assert json.loads(table.read_bytes()) == values
    assert (values["places"], values["folds"], values["trained folds"], values["seeds"]) == (13, 2, 2, [0])
    assert values["trials"]["still"]["changes"] == {"colour": 0.0}
    # The figures are of the trained networks, each on its unseen places.
    runs, ranks = tmp_path / "runs", {}
    for trial in trials:
        for number in (0, 1):
            folder = runs / f"{trial.name}-seed0-fold{number}"
            assert not (folder / "state.pt").exists()
            ranks[trial.name, number] = json.loads((folder / "fold.json").read_bytes())
    task = "drone-to-satellite"
    held = [ranks["base", number]["labels"][task] for number in (0, 1)]
    assert sorted(held[0] + held[1]) == sorted(TrainingSet(open_dataset(places), Console(quiet=True)).labels)
    for reading in ("plain", "centred"):
        hits = {
            trial.name: [np.array(ranks[trial.name, number]["first"][task][reading]) < 1 for number in (0, 1)]
            for trial in trials
        }
        found = values["trials"]["base"]["figures"][task][reading]["R@1"]
        means = [100 * one.mean() for one in hits["base"]]
        assert found["runs"] == pytest.approx(means)
        assert found["mean"] == pytest.approx(np.mean(means))
        assert found["spread"] == pytest.approx(np.std(means, ddof=1))
        one, other = (np.concatenate(hits[name]) for name in ("still", "base"))
        differs = values["differences"]["still"][task][reading]["R@1"]
        assert differs["difference"] == pytest.approx(100 * (one.mean() - other.mean()))
        assert (differs["better"], differs["worse"]) == (int((one & ~other).sum()), int((other & ~one).sum()))
        assert differs["interval"][0] <= differs["difference"] <= differs["interval"][1]
    assert len(summary(values).rows) == 8
    # Six places are too few to calibrate on.
    assert list(values["trials"]["base"]["figures"][task]) == ["plain", "centred"]
    # A later command with one more trial trains nothing again.
    trained: list[str] = []
    original = Trainer.run

    def noted(self: Trainer) -> Path:
        trained.append(self.out.name)
        return original(self)

    monkeypatch.setattr(Trainer, "run", noted)
    more = validation(places, runs, *trials, RecipeTrial("flat", {"scale": 0.0}), run_folds=1).run(table)
    assert trained == ["flat-seed0-fold0"]
    assert more["trained folds"] == 1
    with pytest.raises(InputError, match="base-seed0-fold0 was trained with other values of lr"):
        validation(places, runs, RecipeTrial("base", {"lr": 0.1}))
    # A setting that this version lacks counts, too.
    file = runs / "base-seed0-fold0" / "job.json"
    job = json.loads(file.read_bytes())
    job["identity"] |= {"part_dropout": 0.5}
    file.write_text(json.dumps(job))
    with pytest.raises(InputError, match="base-seed0-fold0 was trained with other values of part_dropout;"):
        validation(places, runs, *trials, run_folds=1)


@pytest.mark.slow
def test_a_stopped_cross_validation_goes_on_where_it_was(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = validation(places, tmp_path / "whole", RecipeTrial("base", {"epochs": 2}), run_folds=1).run(
        tmp_path / "whole.json"
    )
    original = Trainer._epoch

    def killed(self: Trainer, epoch: int, *rest: Any) -> dict[str, float]:
        if epoch == 1:
            raise KeyboardInterrupt
        return original(self, epoch, *rest)

    cut = validation(places, tmp_path / "cut", RecipeTrial("base", {"epochs": 2}), run_folds=1)
    with monkeypatch.context() as patch:
        patch.setattr(Trainer, "_epoch", killed)
        with pytest.raises(KeyboardInterrupt):
            cut.run(tmp_path / "cut.json")
    assert (tmp_path / "cut" / "base-seed0-fold0" / "state.pt").is_file()
    resumed = validation(places, tmp_path / "cut", RecipeTrial("base", {"epochs": 2}), run_folds=1).run(
        tmp_path / "cut.json"
    )
    assert resumed["trials"]["base"]["figures"] == whole["trials"]["base"]["figures"]


def test_weights_come_from_the_files_or_are_found(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    with pytest.raises(InputError, match=r"no weights of resnet18; .* let --init auto find them"):
        validation(places, tmp_path / "runs", RecipeTrial("base", {}), from_scratch=False)
    asked: list[str] = []

    def found(backbone: str) -> tuple[Path, str]:
        asked.append(backbone)
        return tmp_path / f"{backbone}.pth", "a folder"

    monkeypatch.setattr(crossval, "find_weights", found)
    (tmp_path / "resnet50.pth").touch()
    (tmp_path / "resnet18.pth").touch()
    trials = (RecipeTrial("base", {}), RecipeTrial("deep", {"backbone": "resnet50"}))
    made = validation(places, tmp_path / "runs", *trials, from_scratch=False, init=[Path("auto")])
    assert asked == ["resnet18", "resnet50"]
    assert {job.start.name for job in made.jobs if job.start} == {"resnet18.pth", "resnet50.pth"}
    with pytest.raises(InputError, match="each with a name of its own"):
        validation(places, tmp_path / "runs", RecipeTrial("a", {}), RecipeTrial("a", {"lr": 0.1}))
    with pytest.raises(InputError, match="Of 2 folds, 3 are to be trained"):
        validation(places, tmp_path / "runs", RecipeTrial("a", {}), run_folds=3)
    with pytest.raises(InputError, match="number of folds is 0; expected 2 or more"):
        validation(places, tmp_path / "runs", RecipeTrial("a", {}), folds=0)
    with pytest.raises(InputError, match=r"seeds 0, 0; .* each once"):
        validation(places, tmp_path / "runs", RecipeTrial("a", {}), seeds=(0, 0))


def test_the_command_reads_the_recipe_first_and_refuses_in_one_sentence(
    places: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--data", str(places), "--out", str(tmp_path / "runs"), "--table", str(tmp_path / "table.json")]
    for options, said in (
        (["--recipe", "secret"], "no recipe 'secret'"),
        (["--recipe", "map"], "A map has no places to cross-validate on"),
        (["--trial", "a b"], "has no valid name"),
        ([], "no weights of resnet18"),
    ):
        assert crossval.main([*given, *options]) == 2
        error = capsys.readouterr().err
        assert error.startswith("crossval: ")
        assert said in error
        assert error.count("\n") == 1
    assert not (tmp_path / "table.json").exists()
