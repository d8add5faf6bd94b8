from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import pytest

from lpn.reproduce import tuning
from lpn.reproduce.tables import SCALES, find
from lpn.training.optimizer import rate_factor
from lpn.training.recipes import Recipe

STEPS = 6


def trial(scale: str, **changes: Any) -> Recipe:
    """Return the recipe of the first trial of the contrastive loss."""
    of = replace(SCALES[scale], changes=changes)
    training = next(training for training in find("table1", of).trainings if training.name == "contrastive")
    # A plan reads no picture.
    return tuning.plan(training, of, 0, Path("trials"), cast(Any, None), {})[0].job.recipe


def test_a_trial_decays_and_warms_up_at_the_same_share_of_its_epochs() -> None:
    recipe = trial("paper", warmup_epochs=6, second_decay_epoch=105)
    assert recipe.second_decay_epoch == 35
    recipe = trial("paper", warmup_epochs=6)
    assert (recipe.epochs, recipe.decay_epoch, recipe.warmup_epochs) == (40, 27, 2)
    factors = [rate_factor(recipe, step, STEPS) for step in range(recipe.epochs * STEPS)]
    assert factors[0] == pytest.approx(1 / (2 * STEPS))
    assert (factors[2 * STEPS], factors[27 * STEPS - 1], factors[27 * STEPS], factors[-1]) == (1.0, 1.0, 0.1, 0.1)


def test_a_trial_of_one_epoch_does_not_begin_with_the_decayed_rate() -> None:
    recipe = trial("paper", epochs=3, decay_epoch=1)
    assert (recipe.epochs, recipe.decay_epoch, rate_factor(recipe, 0, STEPS)) == (1, 1, 1.0)
    assert trial("paper", decay_epoch=0).decay_epoch == 0
