"""Tuning of the losses of Table I: the same number of short trainings each, judged on training places that are held out."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from lpn.core.files import write_json
from lpn.reproduce.record import here
from lpn.reproduce.sources import Source
from lpn.reproduce.tables import Scale, Training
from lpn.reproduce.trainings import TrainingJob
from lpn.training.recipes import METRIC_LOSSES, Recipe

# Share of the training places that a trial does not train on.
HELD_OUT = 0.2
# A trial takes this fraction of a training's epochs.
FRACTION = 1 / 3
# The settings tried for each network, "rate" as a factor of the recipe's learning rate. The first are the recipe's own, and
# win a tie. Margins of triplets tell rows of Table I apart, so negatives are mined in another way instead.
TRIALS: dict[str, tuple[dict[str, Any], ...]] = {
    "instance": ({"rate": 1.0}, {"rate": 0.3}, {"rate": 3.0}, {"rate": 0.1}),
    "contrastive": ({"rate": 1.0}, {"rate": 0.3}, {"rate": 3.0}, {"rate": 1.0, "margin": 0.5}),
    "triplet-0.3": ({"rate": 1.0}, {"rate": 0.3}, {"rate": 3.0}, {"rate": 1.0, "mining": "hardest"}),
    "triplet-0.5": ({"rate": 1.0}, {"rate": 0.3}, {"rate": 3.0}, {"rate": 1.0, "mining": "hardest"}),
    "soft-margin": ({"rate": 1.0}, {"rate": 0.3}, {"rate": 3.0}, {"rate": 1.0, "alpha": 20.0}),
}


@dataclass(frozen=True)
class Trial:
    """One short training of a network, with the settings that it tries."""

    settings: Mapping[str, Any]
    job: TrainingJob


def plan(
    training: Training, scale: Scale, seed: int, out: Path, source: Source, starts: Mapping[str, Path]
) -> list[Trial]:
    """Plan the trials of a network; empty if it is not tuned, as losses are not that are trained as released.

    Args:
        out: folder of all trials.
        starts: pretrained weights by backbone.
    """
    if scale.released and training.method in METRIC_LOSSES:
        return []
    recipe = scale.recipe(training, seed)
    short = _shortened(recipe)
    trials = []
    # At the other scales the baseline is the paper's or the released one.
    tuned = scale.name == "reduced" or training.name != "instance"
    for number, tried in enumerate(TRIALS.get(training.name, ()) if tuned else (), 1):
        settings = {"lr": recipe.lr * tried["rate"], **{name: tried[name] for name in tried if name != "rate"}}
        job = TrainingJob(
            training,
            seed,
            replace(short, **settings),
            out / f"{training.name}-{number}",
            source,
            starts.get(recipe.backbone),
            HELD_OUT,
        )
        trials.append(Trial(settings, job))
    return trials


def _shortened(recipe: Recipe) -> Recipe:
    """Return the recipe with fewer epochs, and warm-up and decay at the same share of them."""
    epochs = max(round(recipe.epochs * FRACTION), 1)
    share = epochs / recipe.epochs
    decay, second = (
        min(max(round(epoch * share), 1), epoch) for epoch in (recipe.decay_epoch, recipe.second_decay_epoch)
    )
    warmup = round(recipe.warmup_epochs * share)
    return replace(recipe, epochs=epochs, decay_epoch=decay, second_decay_epoch=second, warmup_epochs=warmup)


def best(trials: Sequence[Trial]) -> Trial | None:
    """Return the first trial with the highest score; None if none has one."""
    scored = [trial for trial in trials if trial.job.score is not None]
    return max(scored, key=lambda trial: trial.job.score or 0.0, default=None)


def write(trials: Mapping[str, Sequence[Trial]], path: Path) -> None:
    """Write all trials and the chosen ones as JSON."""
    chosen = {name: best(of_network) for name, of_network in trials.items()}
    values = {
        "held out": HELD_OUT,
        "command": here().command,
        "trials": {
            name: [
                {
                    **trial.settings,
                    "epochs": trial.job.recipe.epochs,
                    "seed": trial.job.seed,
                    "held-out R@1": trial.job.score,
                    "chosen": trial is chosen[name],
                }
                for trial in of_network
            ]
            for name, of_network in trials.items()
        },
    }
    write_json(path, values)


def note(trials: Mapping[str, Sequence[Trial]]) -> str:
    """Say in one paragraph what was tried and chosen; empty without trials."""
    if not trials:
        return ""
    counts = {len(of_network) for of_network in trials.values()}
    choices = []
    for name, of_network in trials.items():
        chosen = best(of_network)
        if chosen is None:
            choices.append(f"{name}: no trial ended, so the recipe's own settings")
            continue
        scores = ", ".join("diverged" if t.job.score is None else f"{t.job.score:.1f}" for t in of_network)
        settings = ", ".join(f"{setting} {value:g}" if isinstance(value, float) else f"{setting} {value}"
                             for setting, value in chosen.settings.items())  # fmt: skip
        choices.append(f"{name}: {settings} (R@1 {chosen.job.score:.1f} of {scores})")
    return (
        f"Tuned by {'/'.join(map(str, sorted(counts)))} short trainings each, a third of the epochs, and chosen by R@1 on "
        f"{HELD_OUT:.0%} of the training places held out: {'; '.join(choices)}. All other networks keep their recipes, untuned."
    )
