from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

from lpn.cli import main
from lpn.cli.train import TrainCommand
from lpn.core.errors import InputError
from lpn.training import recipe_sources, recipes
from lpn.training.recipe_sources import PAIRS, difference, source
from lpn.training.recipes import RECIPES, RELEASED_METRIC, Recipe, find

PUBLISHED = list(recipe_sources._CHAINS)
KINDS = (
    "paper, ",
    "wtyhub/LPN ",
    "wtyhub/SAFA_LPN script/",
    "layumi/University1652-Baseline ",
    "layumi/University1652-triplet-loss ",
    "ours: ",
)


@pytest.mark.parametrize("recipe", PUBLISHED)
def test_every_setting_of_a_published_recipe_has_a_source(recipe: str) -> None:
    settings = [field.name for field in fields(Recipe)]
    assert set(recipe_sources._SOURCES) == set(settings)
    for setting in settings:
        found = source(recipe, setting)
        assert found.startswith(KINDS), (setting, found)
        # The released code never speaks for the paper without saying so.
        assert recipe.endswith("paper") or not found.startswith("paper"), setting
        if recipe.endswith("paper") and found.startswith("wtyhub"):
            assert found.endswith("; the paper is silent"), setting


def test_sources_name_recipes_that_exist() -> None:
    assert {name for of in recipe_sources._SOURCES.values() for name in of} <= {*PUBLISHED, "*"}
    assert {name for pair in PAIRS for name in pair} <= set(PUBLISHED) <= set(RECIPES)


def test_a_paper_s_recipe_is_the_released_one_where_the_paper_is_silent() -> None:
    for paper, released in PAIRS:
        stated, done = asdict(find(paper)), asdict(find(released))
        for setting, value in stated.items():
            if source(paper, setting).endswith("; the paper is silent"):
                assert value == done[setting], (paper, setting)


def test_a_source_of_the_paper_states_the_value_of_its_recipe() -> None:
    """Weights: section III-A shares those of satellite and drone alone. Drone pictures: IV-D. Flipping: IV-B says no more."""
    for recipe, views in (("paper", "the satellite and the drone branch"), ("cvusa-paper", "satellite and drone")):
        shared = source(recipe, "shared")
        assert views in shared
        assert ("CVUSA has no drone pictures" in shared) == (not find(recipe).shared)
        assert "random flipping; horizontal" in source(recipe, "flip")
        assert "wtyhub/LPN train.py:97, 107" in source(recipe, "flip")
    assert "drone pictures are not rotated" in source("paper", "satellite_rotation")
    assert source("cvusa-paper", "satellite_rotation") == (
        "wtyhub/LPN train_cvusa.py:105: RandomAffine(90); the paper is silent"
    )


def test_the_released_code_s_other_methods_have_sources_too() -> None:
    expected = {(recipe, method, setting) for (recipe, method), of in recipes._OF_METHOD.items() for setting in of}
    assert set(recipe_sources._OF_METHOD) == expected
    assert (find("released", "instance").lr, find("released", "lpn").lr, find("paper", "instance").lr) == (
        0.01,
        0.001,
        0.01,
    )
    assert source("released", "lr", "instance") == "wtyhub/LPN run.sh:36, the baseline"
    given = ["--data", "places", "--out", "run", "--recipe", "released", "--method", "instance"]
    assert (
        TrainCommand.parse(given, "lpn train").settings.lr,
        TrainCommand.parse(given, "lpn train").settings.n_parts,
    ) == (0.01, 1)
    assert TrainCommand.parse([*given, "--lr", "0.02"], "lpn train").settings.lr == 0.02


@pytest.mark.parametrize("recipe", ["released", "cvusa-released"])
def test_metric_losses_train_the_baseline_at_the_baseline_s_rate(recipe: str) -> None:
    baseline = asdict(find(recipe, "instance"))
    assert baseline["lr"] != find(recipe).lr
    for method in ("contrastive", "triplet-0.3", "triplet-0.5", "soft-margin"):
        found = asdict(find(recipe, method))
        differs = {setting for setting in found if found[setting] != baseline[setting]}
        of_loss = {"metric", "instance", "sampling", "margin", *RELEASED_METRIC}
        assert {"metric", "instance", "sampling", "positives"} <= differs <= of_loss, method
        assert source(recipe, "lr", method) == "ours: the rate of the released baseline"


def test_a_width_of_0_is_shown_as_the_height() -> None:
    assert "0 (as the height)" in difference("paper", "safa-paper")


def test_the_released_runs_have_their_numbers_of_updates() -> None:
    """University-1652 has 701 places with a satellite each, CVUSA 35,532 pairs."""
    university, cvusa, metric = (RECIPES[name] for name in ("released", "cvusa-released", "metric-released"))
    assert 701 // university.batch * university.epochs == 10_440
    assert 35_532 // cvusa.batch * cvusa.epochs == 266_400
    assert 701 // metric.batch * metric.epochs == 1_470


def test_the_recipes_of_the_text_are_what_it_states() -> None:
    paper, cvusa = RECIPES["paper"], RECIPES["cvusa-paper"]
    # Sections IV-B (classifier module) and IV-D (drone pictures alone are not rotated).
    assert (paper.class_init, paper.satellite_rotation, paper.rotation) == ("kaiming", 90.0, 0.0)
    # Sections III-B and IV-C: the sequential partition; IV-D: n = 4 by default.
    assert (cvusa.layout, cvusa.n_parts, cvusa.polar, cvusa.backbone) == ("strips", 4, False, "vgg16_bn")
    assert (cvusa.batch, cvusa.lr, cvusa.class_init) == (paper.batch, paper.lr, "kaiming")
    assert all(find(paper).class_init == "kaiming" for paper in ("paper", "cvusa-paper"))


def test_the_released_runs_of_cvusa_and_cvact_are_those_of_the_scripts() -> None:
    """run_cvusa.sh:2-13, its block that is commented out (22-34), and run_cvact.sh:22-34."""
    vgg, resnet, cvact = (
        RECIPES[f"{name}"] for name in ("cvusa-released", "cvusa-released-resnet50", "cvact-released")
    )
    assert (vgg.layout, vgg.n_parts, vgg.lr, vgg.batch, vgg.warmup_epochs) == ("cvusa", 8, 0.1, 16, 5)
    assert {name for name, value in asdict(resnet).items() if asdict(vgg)[name] != value} == {"backbone", "lr"}
    assert (resnet.backbone, resnet.lr, resnet.last_stride) == ("resnet50", 0.05, 1)
    assert cvact == resnet
    assert "run_cvact.sh:31" in source("cvact-released", "lr")
    assert "run_cvusa.sh:31 (commented out)" in source("cvusa-released-resnet50", "lr")
    assert not any("SAFA" in source("cvact-released", name) for name in ("linear", "class_init"))
    # Each line is of the scripts for the data set that the recipe is named after.
    assert not any("cvusa" in source("cvact-released", field.name).replace("CVUSA", "") for field in fields(Recipe))


def test_the_metric_losses_are_the_released_ones_in_every_recipe() -> None:
    given = ["--data", "places", "--out", "run", "--recipe", "metric-released"]
    settings = TrainCommand.parse(given, "lpn train").settings
    assert settings == RECIPES["metric-released"]
    assert (settings.epochs, settings.decay_epoch, settings.second_decay_epoch) == (70, 40, 60)
    assert (settings.batch, settings.positives, settings.pool, settings.padding) == (32, 4, 96, 0)
    for method, loss in (
        ("contrastive", ("contrastive", 0.3)),
        ("triplet-0.3", ("triplet", 0.3)),
        ("triplet-0.5", ("triplet", 0.5)),
        ("soft-margin", ("soft_margin", 0.3)),
    ):
        for recipe in ("metric-released", "paper", "small"):
            made = TrainCommand.parse([*given[:-1], recipe, "--method", method], "lpn train").settings
            assert (made.metric, made.margin, made.alpha) == (*loss, 1.0)
            assert (made.positives, made.pool, made.street, made.google) == (4, 96, False, False)
    with pytest.raises(InputError, match="choose one of them with --method in place of lpn"):
        TrainCommand.parse([*given, "--method", "lpn"], "lpn train")
    with pytest.raises(
        InputError, match="metric = triplet with street = True; expected street = False, as the loss compares"
    ):
        replace(RECIPES["metric-released"], street=True)
    with pytest.raises(InputError, match="positives = 4 without a metric loss on drone pictures"):
        replace(RECIPES["released"], positives=4)


def test_the_difference_names_each_setting_that_differs_with_both_sources() -> None:
    text = difference("paper", "released")
    first, second = asdict(find("paper")), asdict(find("released"))
    rows = [line.split() for line in text.splitlines()]
    named = [row for row in rows if len(row) == 3 and row[0] in first]
    assert {row[0] for row in named} == {setting for setting in first if first[setting] != second[setting]}
    for setting, *values in named:
        assert values == [str(first[setting]), str(second[setting])]
    flat = " ".join(text.split())
    assert "run.sh:15" in flat
    assert "model.py:23-27" in flat
    assert difference("safa-paper", "safa-released").endswith("have the same settings.")


def test_the_command_prints_the_difference_and_trains_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main.main(["train", "--compare-recipes", "cvusa-paper", "cvusa-released"]) == 0
    assert capsys.readouterr().out == difference("cvusa-paper", "cvusa-released") + "\n"
    assert not list(tmp_path.iterdir())
    assert main.main(["train", "--compare_recipes", "paper", "released"]) == 0
    assert capsys.readouterr().out == difference("paper", "released") + "\n"
    assert main.main(["train", "--compare-recipes", "paper", "published"]) == 2
    assert "no recipe 'published'; choose one of paper, released" in capsys.readouterr().err
