"""The source of every setting of the published recipes: the paper, a line of the released code, or ours.

`recipe_sources.toml` has them, with the commits of the released code whose lines it names.
"""

from __future__ import annotations

import io
import shutil
import tomllib
from dataclasses import asdict
from pathlib import Path
from typing import cast

from rich import box
from rich.table import Table

from lpn.core.consoles import Console
from lpn.training.recipes import OF_BASELINE, find

# Pairs of a recipe of a paper's text and the recipe of its released code.
PAIRS = (("paper", "released"), ("cvusa-paper", "cvusa-released"), ("safa-paper", "safa-released"))
_RELEASED = dict(PAIRS)

# By setting: its source by recipe; "*" for all others. Where the text of a paper is silent, its recipe has the source of the
# released code.
_SOURCES: dict[str, dict[str, str]] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))

# Sources of the settings that another method of `METHODS` replaces, see `recipes.find`.
_OF_METHOD = {
    ("released", "instance", "lr"): "wtyhub/LPN run.sh:36, the baseline",
    ("cvusa-released", "instance", "lr"): "layumi/University1652-Baseline README.md:225, the baseline",
}
_OF_METHOD |= {
    (recipe, method, "lr"): "ours: the rate of the released baseline"
    for recipe in ("released", "cvusa-released")
    for method in OF_BASELINE
    if method != "instance"
}


# Recipes whose sources are tried in turn, before those of the released code that belongs to a paper.
_CHAINS: dict[str, tuple[str, ...]] = {
    **{name: (name,) for pair in PAIRS for name in pair},
    "cvact-released": ("cvact-released",),
    "metric-released": ("metric-released",),
    "cvusa-paper": ("cvusa-paper", "paper"),
    "cvusa-released-resnet50": ("cvusa-released-resnet50", "cvusa-released"),
}


def source(recipe: str, setting: str, method: str | None = None) -> str:
    """Return the source of a setting: "paper, ...", a file and line of released code, or "ours: ...".

    Args:
        recipe: one of `lpn.training.recipes.RECIPES`; those that are not published are ours.
        method: one of `lpn.training.recipes.METHODS`, for which the released code may have another value.
    """
    if recipe not in _CHAINS:
        return "ours"
    if method is not None and (recipe, method, setting) in _OF_METHOD:
        return _OF_METHOD[recipe, method, setting]
    of = _SOURCES[setting]
    stated = next((of[name] for name in _CHAINS[recipe] if name in of), "")
    if stated:
        return stated
    if recipe in _RELEASED and _RELEASED[recipe] in of:
        return f"{of[_RELEASED[recipe]]}; the paper is silent"
    return of["*"]


def difference(first: str, second: str) -> str:
    """Return the settings in which two recipes differ, each with its value and source, as text.

    Raises:
        InputError: if there is no such recipe.
    """
    recipes = {name: asdict(find(name)) for name in (first, second)}
    differs = [setting for setting in recipes[first] if recipes[first][setting] != recipes[second][setting]]
    if not differs:
        return f"The recipes {first} and {second} have the same settings."
    table = Table("setting", first, second, box=box.SIMPLE_HEAD)
    for setting in differs:
        cells = (f"{_cell(setting, of[setting])}\n{source(name, setting)}\n" for name, of in recipes.items())
        table.add_row(setting, *cells)
    console = Console(width=max(100, shutil.get_terminal_size().columns), file=io.StringIO(), markup=False)
    console.print(table)
    return cast(io.StringIO, console.file).getvalue().rstrip()


def _cell(setting: str, value: object) -> str:
    return "0 (as the height)" if setting == "width" and value == 0 else f"{value}"
