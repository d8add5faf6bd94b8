"""The program of test_multi_process.py, which torchrun starts twice: a whole training, and one that is cut and resumed."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from rich.console import Console
from torch import nn

from lpn.datasets import open_dataset
from lpn.training.multi_process import ProcessGroup, join
from lpn.training.recipes import RELEASED_METRIC, Recipe
from lpn.training.trainer import Trainer
from tools.fixtures.trainings import QUICK, make_resnets_shallow

RECIPE = replace(QUICK, epochs=2, batch=8, optimizer="sgd", lr=0.01, dropout=0.0, ema=0.8)


# Sets shuffled on their own, each with its own labels.
INDEPENDENT = replace(
    RECIPE, epochs=1, sampling="pictures", infonce=0.0, flip="picture", place_rotation=0.0, joint_views=False
)

# A released metric loss, with two drone pictures of each place and a pool that is drawn anew each step.
METRIC = replace(RECIPE, epochs=1, instance=0.0, n_parts=1, linear=False, metric="triplet", infonce=0.0)
METRIC = replace(METRIC, **{**RELEASED_METRIC, "positives": 2, "pool": 10})


def trainer(
    data: Path,
    out: Path,
    group: ProcessGroup | None = None,
    resume: bool = False,
    recipe: Recipe = RECIPE,
) -> Trainer:
    """Make a training with frozen BatchNorm, so that the division of a batch changes nothing."""
    with (out.parent / f"{out.name}.txt").open("a") as said:
        run = Trainer(
            open_dataset(data),
            out,
            recipe,
            resume=resume,
            console=Console(file=said),
            group=group,
            from_scratch=True,
        )
    run.console = Console(quiet=True)
    for module in run.network.modules():
        if isinstance(module, nn.BatchNorm1d | nn.BatchNorm2d):
            module.eval()
            module.train = lambda _=True, module=module: module  # type: ignore[method-assign, misc]
    return run


def main(data: Path, out: Path) -> None:
    group = join()
    run = trainer(data, out / "whole", group)
    run.run()
    torch.save(dict(run.network.named_parameters()), out / f"weights{group.rank}.pt")
    trainer(data, out / "independent", group, recipe=INDEPENDENT).run()
    trainer(data.with_name("gaps"), out / "gaps", group).run()
    trainer(data.with_name("gaps"), out / "metric", group, recipe=METRIC).run()
    run = trainer(data, out / "cut", group)
    original = Trainer._epoch

    def killed(self: Trainer, epoch: int, *rest: object) -> dict[str, float]:
        if epoch == 1:
            raise KeyboardInterrupt
        return original(self, epoch, *rest)  # type: ignore[arg-type]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Trainer, "_epoch", killed)
        with pytest.raises(KeyboardInterrupt):
            run.run()
    # Wait until the leader has written the state.
    group.run_on_leader(lambda: None)
    trainer(data, out / "cut", group, resume=True).run()
    group.leave()


if __name__ == "__main__":
    make_resnets_shallow(pytest.MonkeyPatch())
    main(Path(sys.argv[1]), Path(sys.argv[2]))
