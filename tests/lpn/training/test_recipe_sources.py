from __future__ import annotations

from dataclasses import asdict, fields
from pathlib import Path

import pytest

from lpn.cli import main
from lpn.cli.train import parse_train
from lpn.training import recipe_sources, recipes
from lpn.training.recipe_sources import PAIRS, difference, source
from lpn.training.recipes import RECIPES, Recipe, find

PUBLISHED = [name for pair in PAIRS for name in pair]
KINDS = ("paper, ", "wtyhub/LPN ", "wtyhub/SAFA_LPN script/", "layumi/University1652-Baseline ", "ours: ")


@pytest.mark.parametrize("recipe", PUBLISHED)
def test_every_setting_of_a_published_recipe_has_a_source(recipe: str) -> None:
    settings = [field.name for field in fields(Recipe)]
    assert set(recipe_sources._SOURCES) == set(settings)
    for setting in settings:
        found = source(recipe, setting)
        assert found.startswith(KINDS), (setting, found)
        # The released code never speaks for the paper without saying so.
        assert not recipe.endswith("released") or not found.startswith("paper"), setting
        if recipe.endswith("paper") and found.startswith("wtyhub"):
            assert found.endswith("; the paper is silent"), setting


def test_sources_name_recipes_that_exist() -> None:
    assert {name for of in recipe_sources._SOURCES.values() for name in of} <= {*PUBLISHED, "*"}
    assert set(recipe_sources._CHAINS) == set(PUBLISHED) <= set(RECIPES)


def test_a_paper_s_recipe_is_the_released_one_where_the_paper_is_silent() -> None:
    for paper, released in PAIRS:
        stated, done = asdict(find(paper)), asdict(find(released))
        for setting, value in stated.items():
            if source(paper, setting).endswith("; the paper is silent"):
                assert value == done[setting], (paper, setting)


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
    assert (parse_train(given, "lpn train").settings.lr, parse_train(given, "lpn train").settings.n_parts) == (0.01, 1)
    assert parse_train([*given, "--lr", "0.02"], "lpn train").settings.lr == 0.02


@pytest.mark.parametrize("recipe", ["released", "cvusa-released"])
def test_metric_losses_train_the_baseline_at_the_baseline_s_rate(recipe: str) -> None:
    baseline = asdict(find(recipe, "instance"))
    assert baseline["lr"] != find(recipe).lr
    for method in ("contrastive", "triplet-0.3", "triplet-0.5", "soft-margin"):
        found = asdict(find(recipe, method))
        differs = {setting for setting in found if found[setting] != baseline[setting]}
        assert {"metric", "instance", "sampling"} <= differs <= {"metric", "instance", "sampling", "margin"}, method
        assert source(recipe, "lr", method) == "ours: the rate of the released baseline"


def test_a_width_of_0_is_shown_as_the_height() -> None:
    assert "| `width` | 0 (as the height) |" in recipe_sources.table("paper", "released")
    assert "0 (as the height)" in difference("paper", "safa-paper")
    assert "| `width` | 616 |" in recipe_sources.table("safa-paper", "safa-released")


def test_the_released_runs_have_their_numbers_of_updates() -> None:
    """University-1652 has 701 places with a satellite each, CVUSA 35,532 pairs."""
    university, cvusa = RECIPES["released"], RECIPES["cvusa-released"]
    assert 701 // university.batch * university.epochs == 10_440
    assert 35_532 // cvusa.batch * cvusa.epochs == 266_400


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
    assert "RandomAffine(90)" in flat
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
