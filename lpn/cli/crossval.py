"""The command crossval: recipes compared on the training places alone."""

from __future__ import annotations

from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, cast

import tyro

from lpn.cli.train import flag_value
from lpn.core.errors import InputError
from lpn.training import recipes
from lpn.training.recipes import Recipe, RecipeName


@dataclass
class CrossvalCommand:
    """Compare recipes by cross-validation on the training places; resumable."""

    data: Path
    """Data set with pictures to train on, in any layout of docs/data.md. Its test split is not read."""
    out: Path
    """Folder of all runs."""
    table: Path
    """File to write the table to, as JSON, after each fold."""
    trial: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """A recipe to try, NAME or NAME:setting=value,setting=value with settings of lpn train --help; once for each. The others are
    compared with the first one; without any, the recipe alone is tried as base."""
    recipe: RecipeName = "small"
    """Recipe of all trials; its settings are flags as well."""
    init: Annotated[tuple[Path, ...], tyro.conf.UseAppendAction] = ()
    """ImageNet weights a backbone starts from, or a trained model; once for each backbone. auto finds what is not given."""
    from_scratch: bool = False
    """Start from random weights instead of --init."""
    folds: int = 5
    """Number of folds of the training places."""
    run_folds: int = 0
    """Number of folds that are trained, from the first; 0 for all."""
    seeds: tuple[int, ...] = (0,)
    """Random seeds: one training of each trial and fold for each."""
    settings: tyro.conf.OmitArgPrefixes[Recipe] = field(default_factory=lambda: recipes.RECIPES["small"])

    def run(self) -> None:
        made = import_module("lpn.reproduce.cross_validation")
        if self.settings.windows:
            raise InputError("A map has no places to cross-validate on; choose a recipe for places.")
        trials = [made.parse_trial(text, self.settings) for text in self.trial or ("base",)]
        dataset = import_module("lpn.datasets").open_dataset(self.data)
        made.CrossValidation(
            dataset,
            self.out,
            self.settings,
            trials,
            self.init,
            self.folds,
            self.run_folds,
            self.seeds,
            self.from_scratch,
        ).run(self.table)
        print(f"Wrote {self.table}.")

    def resume_hint(self) -> str:
        """Return how to resume after a stop."""
        return f"Whole epochs and measurements in {self.out} are kept; the same command goes on."


def parse_crossval(arguments: list[str], program: str) -> CrossvalCommand:
    """Parse the options of a cross-validation; the recipe sets the defaults of the other flags.

    Raises:
        InputError: if the recipe is unknown.
    """
    name = flag_value(arguments, "--recipe") or "small"
    default = CrossvalCommand(
        tyro.MISSING, tyro.MISSING, tyro.MISSING, recipe=cast(RecipeName, name), settings=recipes.find(name)
    )
    return cast(CrossvalCommand, tyro.cli(cast(Any, CrossvalCommand), args=arguments, prog=program, default=default))
