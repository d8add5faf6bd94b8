"""Cross-validation: folds, trials, figures that add up, resuming, and that no test picture is read."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from lpn.core.consoles import Console
from lpn.core.errors import InputError
from lpn.datasets import open_dataset
from lpn.datasets.layouts.university import University
from lpn.reproduce.jobs import TrainingJob
from lpn.retrieval import calibration
from lpn.training import recipes
from lpn.training.recipe import Recipe
from lpn.training.trainer import Trainer
from lpn.training.training_set import Fold, TrainingSet
from tools import crossval
from tools.fixtures import small_worlds, trainings

QUICK = replace(trainings.QUICK, epochs=1, n_parts=2)
BASE = ("base", QUICK)
TASK = "drone-to-satellite"


@pytest.fixture(autouse=True)
def _shallow(monkeypatch: pytest.MonkeyPatch) -> None:
    trainings.make_resnets_shallow(monkeypatch)


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("crossval") / "places", train=13, test=4)


def planned(places: Path, out: Path, *trials: tuple[str, Recipe]) -> list[TrainingJob]:
    return crossval.plan(open_dataset(places), out, trials, folds=2, init=None)


def test_a_reading_that_one_fold_is_too_small_for_is_left_out(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for module in (crossval, calibration):
        monkeypatch.setattr(module, "MIN_PICTURES", 7)
    values = crossval.run(planned(places, tmp_path / "runs", BASE), tmp_path / "table.json")
    folds = [json.loads((tmp_path / f"runs/base-seed0-fold{number}/fold.json").read_bytes()) for number in (0, 1)]
    assert ["calibrated" in fold["values"][TASK] for fold in folds] == [True, False]
    assert list(values["trials"]["base"]["figures"][TASK]) == ["plain"]


def test_folds_share_the_places_out_evenly_whatever_the_recipe_s_seed(places: Path) -> None:
    held: list[list[int]] = []
    for number in range(3):
        training = TrainingSet(open_dataset(places), Console(quiet=True))
        out = training.hold_out(Fold(number, 3), seed=number)
        assert not set(out) & set(training.labels)
        assert len(training) == len(training.files["drone"]) == 13 - len(out)
        held.append(list(out))
    assert sorted(map(len, held)) == [4, 4, 5]
    again = TrainingSet(open_dataset(places), Console(quiet=True))
    assert sorted(label for one in held for label in one) == sorted(again.labels)
    assert list(again.hold_out(Fold(0, 3), seed=9)) == held[0]
    with pytest.raises(InputError, match=r"number of folds is 7; .* at least 2 of the 8 places"):
        again.hold_out(Fold(0, 7), seed=0)


def test_a_trial_has_values_of_its_settings_types() -> None:
    made = crossval.parse_trial("deep:backbone=resnet50,epochs=20,place-rotation=5,joint_views=false", QUICK)
    recipe = replace(QUICK, backbone="resnet50", epochs=20, place_rotation=5.0, joint_views=False)
    assert made == ("deep", recipe)
    assert crossval.parse_trial("base", QUICK) == BASE


def test_trials_are_compared_query_by_query_on_training_pictures_alone(
    places: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise AssertionError("the test split was read")

    for name in ("queries", "gallery", "truth"):
        monkeypatch.setattr(University, name, refused)
    for module in (crossval, calibration):
        monkeypatch.setattr(module, "MIN_PICTURES", 4)
    trials = (BASE, ("still", replace(QUICK, colour=0.0)))
    table, runs = tmp_path / "table.json", tmp_path / "runs"
    values = crossval.run(planned(places, runs, *trials), table)
    assert json.loads(table.read_bytes()) == values
    assert (values["places"], values["folds"], values["seeds"]) == (13, 2, [0])
    assert values["trials"]["still"]["recipe"]["colour"] == 0.0
    # The figures are of the trained networks, each on its unseen places.
    folds = {}
    for name in ("base", "still"):
        for number in (0, 1):
            folder = runs / f"{name}-seed0-fold{number}"
            assert not (folder / "state.pt").exists()
            folds[name, number] = json.loads((folder / "fold.json").read_bytes())
    held = [folds["base", number]["labels"][TASK] for number in (0, 1)]
    assert sorted(held[0] + held[1]) == sorted(TrainingSet(open_dataset(places), Console(quiet=True)).labels)
    for reading in ("plain", "calibrated"):
        hits = {key: np.array(fold["values"][TASK][reading]["R@1"]) for key, fold in folds.items()}
        found = values["trials"]["base"]["figures"][TASK][reading]["R@1"]
        means = [100 * hits["base", number].mean() for number in (0, 1)]
        assert found["runs"] == pytest.approx(means)
        assert found["mean"] == pytest.approx(np.mean(means))
        assert found["spread"] == pytest.approx(np.std(means, ddof=1))
        one, other = (np.concatenate([hits[name, 0], hits[name, 1]]) for name in ("still", "base"))
        differs = values["differences"]["still"][TASK][reading]["R@1"]
        assert differs["difference"] == pytest.approx(100 * (one.mean() - other.mean()))
        assert differs["interval"][0] <= differs["difference"] <= differs["interval"][1]
    # A later command with one more trial trains nothing again.
    trained: list[str] = []
    original = Trainer.run

    def noted(self: Trainer) -> Path:
        trained.append(self.out.name)
        return original(self)

    monkeypatch.setattr(Trainer, "run", noted)
    crossval.run(planned(places, runs, *trials, ("flat", replace(QUICK, scale=0.0))), table)
    assert trained == ["flat-seed0-fold0", "flat-seed0-fold1"]
    with pytest.raises(InputError, match="base-seed0-fold0 was trained with other values of lr"):
        planned(places, runs, ("base", replace(QUICK, lr=0.1)))
    # A setting that this version lacks counts, too.
    file = runs / "base-seed0-fold0" / "job.json"
    job = json.loads(file.read_bytes())
    job["identity"] |= {"part_dropout": 0.5}
    file.write_text(json.dumps(job))
    with pytest.raises(InputError, match="base-seed0-fold0 was trained with other values of part_dropout;"):
        planned(places, runs, *trials)


def test_the_command_prints_what_the_table_says(
    places: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(recipes.RECIPES, "small", QUICK)
    arguments = ["--data", places, "--out", tmp_path / "runs", "--table", tmp_path / "table.json", "--folds", 2]
    trials = ["--trial", "base", "--trial", "still:colour=0", "--from-scratch"]
    assert crossval.main([*map(str, arguments), *trials]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith(("base ", "still "))]
    assert len(lines) == 4
    assert all(line.endswith(") against base") == line.startswith("still") for line in lines)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("--recipe secret", "no recipe 'secret'"),
        ("--recipe map", "A map has no places to cross-validate on"),
        ("--trial :lr=1", "has no valid name; expected NAME or NAME:setting=value"),
        ("--trial a:speed=1", "has 'speed=1'; expected setting=value, a setting of lpn train --help"),
        ("--trial a:lr", "has 'lr'; expected setting=value"),
        ("--trial a:seed=3", "seeds are given with --seeds"),
        ("--trial a:epochs=many", "has 'epochs=many'"),
        ("--trial a:metric=best", "has 'metric=best'"),
        ("--trial a --trial a:lr=0.1 --from-scratch", "each with a name of its own"),
        ("--folds 0 --from-scratch", "number of folds is 0; expected 2 or more"),
        ("--seeds 0 0 --from-scratch", "seeds are 0, 0; expected at least one, each once"),
        ("", "no weights of resnet18"),
    ],
)
def test_the_command_refuses_in_one_sentence(
    options: str, said: str, places: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    given = ["--data", str(places), "--out", str(tmp_path / "runs"), "--table", str(tmp_path / "table.json")]
    assert crossval.main([*given, *options.split()]) == 2
    error = capsys.readouterr().err
    assert error.startswith("crossval: ")
    assert said in error
    assert error.count("\n") == 1
    assert not (tmp_path / "table.json").exists()
