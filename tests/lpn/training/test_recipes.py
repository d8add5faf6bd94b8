"""Recipes: their values and sources, ranges, and the settings that exclude each other."""

from __future__ import annotations

from dataclasses import asdict, fields, replace

import pytest

from lpn.cli import main
from lpn.cli.train import TrainCommand
from lpn.core.errors import InputError
from lpn.training.recipe import Recipe
from lpn.training.recipes import METHODS, METRIC_LOSSES, OF_BASELINE, RECIPES, difference, find, method, source
from tests.conftest import Refused

PAPERS = {"paper": "released", "cvusa-paper": "cvusa-released"}
PUBLISHED = [*PAPERS, *PAPERS.values(), "cvact-released", "metric-released", "safa-released"]
KINDS = (
    *("paper, ", "wtyhub/LPN ", "wtyhub/SAFA_LPN script/", "layumi/University1652-Baseline "),
    *("layumi/University1652-triplet-loss ", "ours: "),
)


def parsed(*given: str) -> Recipe:
    return TrainCommand.parse(["--data", "places", "--out", "run", *given], "lpn train").settings


@pytest.mark.parametrize("recipe", PUBLISHED)
def test_every_setting_of_a_published_recipe_has_a_source(recipe: str) -> None:
    released = PAPERS.get(recipe)
    for setting, value in asdict(find(recipe)).items():
        found = source(recipe, setting)
        assert found.startswith(KINDS), (setting, found)
        # The released code never speaks for the paper without saying so.
        assert released or not found.startswith("paper"), setting
        if released and not found.startswith(("paper", "ours")):
            assert found == f"{source(released, setting)}; the paper is silent"
            assert value == asdict(find(released))[setting]
        # Whatever has no source is off.
        if found.startswith("ours: off"):
            assert value == getattr(Recipe(), setting), setting


def test_the_paper_s_recipe_is_the_default_and_states_what_the_text_does() -> None:
    paper, cvusa = RECIPES["paper"], RECIPES["cvusa-paper"]
    assert paper == Recipe()
    # Section IV-B.
    assert (paper.backbone, paper.size, paper.epochs, paper.decay_epoch) == ("resnet50", 256, 120, 80)
    assert (paper.optimizer, paper.lr, paper.backbone_ratio, paper.weight_decay) == ("sgd", 0.01, 0.1, 5e-4)
    # Sections IV-B (classifier module) and IV-D (n = 4; drone pictures alone are not rotated).
    assert (paper.class_init, paper.n_parts, paper.satellite_rotation, paper.rotation) == ("kaiming", 4, 90.0, 0.0)
    assert "drone pictures are not rotated" in source("paper", "satellite_rotation")
    # Sections III-B and IV-C: the sequential partition.
    assert (cvusa.layout, cvusa.n_parts, cvusa.polar, cvusa.backbone) == ("strips", 4, False, "vgg16_bn")
    assert (cvusa.batch, cvusa.lr, cvusa.class_init) == (paper.batch, paper.lr, "kaiming")
    assert source("cvusa-paper", "satellite_rotation") == (
        "wtyhub/LPN train_cvusa.py:105: RandomAffine(90); the paper is silent"
    )
    # Section III-A shares the weights of satellite and drone alone.
    for recipe, views in (("paper", "the satellite and the drone branch"), ("cvusa-paper", "satellite and drone")):
        assert views in source(recipe, "shared")
        assert ("CVUSA has no drone pictures" in source(recipe, "shared")) == (not find(recipe).shared)


def test_the_released_recipes_are_those_of_the_scripts() -> None:
    """run_cvusa.sh:2-13, run_cvact.sh:22-34; University-1652 has 701 satellites, CVUSA 35,532 pairs."""
    university, vgg, cvact, metric = (
        RECIPES[f"{name}-released" if name else "released"] for name in ("", "cvusa", "cvact", "metric")
    )
    assert 701 // university.batch * university.epochs == 10_440
    assert 35_532 // vgg.batch * vgg.epochs == 266_400
    assert 701 // metric.batch * metric.epochs == 1_470
    assert (vgg.layout, vgg.n_parts, vgg.lr, vgg.batch, vgg.warmup_epochs) == ("cvusa", 8, 0.1, 16, 5)
    assert {name for name, value in asdict(cvact).items() if asdict(vgg)[name] != value} == {"backbone", "lr"}
    assert (cvact.backbone, cvact.lr, cvact.last_stride) == ("resnet50", 0.05, 1)
    # Each line is of the scripts for the data set that the recipe is named after.
    lines = [source("cvact-released", field.name).replace("CVUSA", "") for field in fields(Recipe)]
    assert not any("cvusa" in line or "SAFA" in line for line in lines)


@pytest.mark.parametrize("recipe", ["released", "cvusa-released"])
def test_methods_of_the_baseline_train_at_its_rate(recipe: str) -> None:
    own, baseline = find(recipe).lr, find(recipe, "instance").lr
    assert (own, baseline) == {"released": (0.001, 0.01), "cvusa-released": (0.1, 0.02)}[recipe]
    assert source(recipe, "lr", "instance").endswith(", the baseline")
    assert {find(recipe, name).lr for name in OF_BASELINE} == {baseline}
    assert {source(recipe, "lr", name) for name in METRIC_LOSSES} == {"ours: the rate of the released baseline"}
    assert find(recipe, "lpn").lr == own
    assert parsed("--recipe", recipe, "--method", "instance").lr == baseline
    assert parsed("--recipe", recipe, "--method", "instance", "--lr", "0.5").lr == 0.5


@pytest.mark.parametrize(
    ("field", "value", "expected"),
    [
        ("dropout", 1.0, "a number below 1.0"),
        ("ema", -0.5, "a number of at least 0.0"),
        ("lr", 0.0, "a number above 0.0"),
        ("lr", float("nan"), "a number above 0.0"),
        ("colour", float("inf"), "a number of at most 1.0"),
        ("weight_decay", float("inf"), "a finite number"),
        ("seed", -1, "a whole number of at least 0"),
        ("batch", 1, "a whole number of at least 2"),
        ("epochs", 2.5, "a whole number, got"),
        ("size", 16, "a whole number of at least 32"),
        ("metric", "best", "one of none, contrastive, triplet, soft_margin"),
        ("backbone", "resnet\x1b9", "one of resnet18"),
    ],
)
def test_a_value_out_of_range_is_refused_in_words(field: str, value: object, expected: str) -> None:
    with pytest.raises(InputError, match=rf"^The recipe has {field} = .*; expected {expected}") as error:
        replace(RECIPES["small"], **{field: value})
    assert "\x1b" not in str(error.value)


@pytest.mark.parametrize(
    ("recipe", "changes", "said"),
    [
        ("paper", {"instance": 0.0}, "no loss, as instance and infonce are 0"),
        ("small", {"backbone": "vgg16_bn"}, "last_layer = layer3 with vgg16_bn, .* expected last_layer = layer4"),
        ("paper", {"backbone_dropout": 0.2}, "backbone_dropout = 0.2 with resnet50, which has no dropout; .* = 0"),
        ("small", {"backbone": "timm:x", "linear": False}, "linear = False with timm:x"),
        ("safa-released", {"instance": 1.0}, "instance = 1.0 with pooling = safa, which has no class layer"),
        ("safa-released", {"metric": "triplet"}, "metric = triplet with pooling = safa.* metric = soft_margin"),
        ("safa-released", {"ground_ratio": 2.0}, "ground_ratio = 2.0 with polar, as an unrolled tile has no zoom"),
        ("released", {"infonce": 1.0}, "infonce = 1.0 with sampling = pictures, .*, or sampling = places"),
        ("released", {"flip": "place"}, "flip = place with sampling = pictures.* flip = picture or flip = none, or"),
        ("released", {"place_rotation": 5.0}, "place_rotation = 5.0 with sampling = pictures"),
        ("released", {"positives": 4}, "positives = 4 with no metric loss on drone pictures"),
        ("metric-released", {"street": True}, "street = True with metric = triplet, .* expected street = False"),
        ("map", {"instance": 1.0}, "instance = 1.0 with windows of a map, which have no classes"),
        ("map", {"width": 64}, "width = 64 with windows of a map, which are square"),
    ],
)
def test_settings_that_exclude_each_other_are_refused(recipe: str, changes: dict[str, object], said: str) -> None:
    with pytest.raises(InputError, match=rf"The recipe has .*{said}"):
        replace(RECIPES[recipe], **changes)


def test_the_difference_names_each_setting_that_differs_with_both_sources() -> None:
    text = difference("paper", "released")
    first, second = asdict(find("paper")), asdict(find("released"))
    named = [row for row in map(str.split, text.splitlines()) if len(row) == 3 and row[0] in first]
    assert {row[0] for row in named} == {setting for setting in first if first[setting] != second[setting]}
    for setting, *values in named:
        assert values == [str(first[setting]), str(second[setting])]
    flat = " ".join(text.split())
    assert "run.sh:15" in flat
    assert "model.py:23-27" in flat
    assert difference("paper", "paper").endswith("have the same settings.")
    assert "0 (as the height)" in difference("paper", "safa-released")


def test_the_command_prints_the_difference(capsys: pytest.CaptureFixture[str], refused: Refused) -> None:
    assert main.main(["train", "--compare_recipes", "cvusa-paper", "cvusa-released"]) == 0
    assert capsys.readouterr().out == difference("cvusa-paper", "cvusa-released") + "\n"
    for given, said in (
        (["--compare-recipes", "paper", "published"], "no recipe 'published'; choose one of paper, released"),
        (["--recipe", "metric-released", "--method", "lpn"], "choose one of them with --method in place of lpn"),
        (["--method", "best"], "no method 'best'; choose one of lpn"),
    ):
        assert said in refused("train", *given)


def test_a_method_is_the_same_network_and_loss_in_every_recipe() -> None:
    recipes = [recipe for recipe in RECIPES.values() if not recipe.windows and not recipe.compares_drones]
    same = ("pooling", "maps", "instance", "infonce", "metric", "margin", "metric_per_part")
    # The layout, whether tiles are unrolled, and the number of parts; all others are the baseline's.
    networks = {
        "lpn-sequential": ("strips", False, 4),
        "lpn-cvusa": ("cvusa", False, 8),
        "lpn-strips": ("strips", True, 8),
        "safa": ("university", True, 1),
        "safa-lpn": ("university", True, 8),
    }
    for name in METHODS:
        made = [method(name, recipe) for recipe in recipes]
        assert len({tuple(getattr(one, setting) for setting in same) for one in made}) == 1, name
        for one, recipe in zip(made, recipes, strict=True):
            baseline = ("university", False, recipe.n_parts if name == "lpn" else 1)
            assert (one.layout, one.polar, one.n_parts) == networks.get(name, baseline), name
