from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec
from lpn.training.learner import Learner, MixedPrecision, choose_dtype, loss_factor, rate_factor
from lpn.training.loader import TrainingBatch
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES

STEPS = 20
CUDA, CPU = torch.device("cuda"), torch.device("cpu")


def test_the_released_cvusa_run_warms_its_loss_up_and_not_its_rate() -> None:
    recipe = RECIPES["cvusa-released"]
    # The released loop adds 0.9 / iterations to 0.1 before each step.
    factor, expected = 0.1, []
    for _ in range(5 * STEPS):
        factor = min(1.0, factor + 0.9 / (5 * STEPS))
        expected.append(factor)
    assert [loss_factor(recipe, step, STEPS) for step in range(5 * STEPS)] == pytest.approx(expected)
    assert loss_factor(recipe, 5 * STEPS, STEPS) == 1.0
    assert {rate_factor(recipe, step, STEPS) for step in range(80 * STEPS)} == {1.0}


def test_schedules_end_as_they_are_named() -> None:
    def last(recipe: Recipe) -> float:
        return rate_factor(recipe, recipe.epochs * STEPS - 1, STEPS)

    assert (last(RECIPES["released"]), last(RECIPES["safa-released"])) == (0.1, 1.0)
    assert last(RECIPES["small"]) < 0.001
    twice = [rate_factor(RECIPES["metric-released"], epoch * STEPS, STEPS) for epoch in range(70)]
    assert twice == pytest.approx([1.0] * 40 + [0.1] * 20 + [0.01] * 10)
    recipe = replace(RECIPES["paper"], warmup_epochs=2)
    assert [rate_factor(recipe, step, STEPS) for step in (0, 19, 40)] == pytest.approx([1 / 40, 0.5, 1.0])
    assert loss_factor(recipe, 0, STEPS) == 1.0


def test_a_factor_of_the_loss_scales_the_step_and_not_the_loss_that_is_told() -> None:
    spec = ModelSpec("resnet18", "layer3", n_parts=2, embedding=8, classes=4, input_size=(32, 32), dropout=0.0)
    generator = torch.Generator().manual_seed(0)
    pictures, labels = torch.randn(4, 3, 32, 32, generator=generator), torch.arange(4)
    batch = TrainingBatch({"satellite": pictures}, {"satellite": labels})
    moved, losses = [], []
    for start in (1.0, 0.1):
        torch.manual_seed(0)
        network = LPN(spec)
        changes = {"weight_decay": 0.0, "warmup_epochs": 1, "warmup_start": start, "precision": "float32"}
        learner = Learner(network, replace(RECIPES["cvusa-released"], **changes), torch.device("cpu"))
        network.train()
        weight = network.heads[0].classifier[0].weight
        before = weight.detach().clone()
        terms, rate = learner.step(batch, 0, 9)
        losses.append(float(terms["loss"]))
        moved.append(weight.detach() - before)
        assert rate == 0.1
    torch.testing.assert_close(moved[1], moved[0] * 0.2, rtol=1e-4, atol=1e-8)
    assert losses[0] == pytest.approx(losses[1])
    assert moved[0].abs().max() > 0


def test_float16_is_for_cuda_and_a_cpu_computes_what_auto_chooses() -> None:
    recipe = RECIPES["released"]
    assert recipe.precision == "float16"
    assert choose_dtype(recipe, CUDA) == torch.float16
    precision = MixedPrecision(recipe, CPU)
    assert precision.fell_back
    assert precision.dtype == choose_dtype(replace(recipe, precision="auto"), CPU) != torch.float16
    assert not MixedPrecision(replace(recipe, precision="float32"), CPU).fell_back
