"""Recipes by name, the source of each of their settings, and the paper's compared methods: `recipes.toml`."""

from __future__ import annotations

import io
import shutil
import tomllib
from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any, cast

from rich import box
from rich.table import Table

from lpn.core.consoles import Console
from lpn.core.errors import InputError
from lpn.training.recipe import Recipe

DEFAULT = "paper"
# The source of a setting that no table of `recipes.toml` names.
_UNNAMED = "ours: off or without effect, in neither the paper nor the code"
_OF_BASELINE = "ours: the rate of the released baseline"

_DATA: dict[str, dict[str, dict[str, Any]]] = tomllib.loads(Path(__file__).with_suffix(".toml").read_text("utf-8"))
_PUBLISHED = _DATA["published"]
# Keys of a published recipe that are not settings.
_KEYS = ("of", "silent", "baseline")


def _own(entries: Mapping[str, Any]) -> dict[str, tuple[Any, str]]:
    """Return value and source of each setting in a table of a published recipe."""
    default = Recipe()
    return {
        name: (getattr(default, name), entry) if isinstance(entry, str) else tuple(entry)
        for name, entry in entries.items()
        if name not in _KEYS
    }


def _published(recipe: str) -> dict[str, tuple[Any, str]]:
    """Return value and source of each setting that a published recipe states."""
    entries = _PUBLISHED[recipe]
    own, found = _own(entries), {}
    for name, (value, source) in _published(entries["silent"]).items() if "silent" in entries else ():
        found[name] = value, source if source.startswith("ours") else f"{source}; the paper is silent"
    if "of" in entries:
        found |= {name: stated for name, stated in _own(_PUBLISHED[entries["of"]]).items() if name not in own}
    return found | {name: stated for name, stated in own.items() if stated[1]}


def _resolved(tables: Mapping[str, Mapping[str, Any]], name: str) -> dict[str, Any]:
    """Return the settings of one of our recipes or of a method, with those of its base."""
    base = _resolved(tables, tables[name]["of"]) if "of" in tables[name] else {}
    return base | {setting: value for setting, value in tables[name].items() if setting != "of"}


_STATED = {name: _published(name) for name in _PUBLISHED}
# All recipes by name; docs/recipes.md has their purposes.
RECIPES: dict[str, Recipe] = {
    **{name: Recipe(**{setting: value for setting, (value, _) in of.items()}) for name, of in _STATED.items()},
    **{name: Recipe(**_resolved(_DATA["ours"], name)) for name in _DATA["ours"]},
}
# For each method of the paper's tables, its loss and other settings; they replace those of a recipe.
METHODS = {name: _resolved(_DATA["methods"], name) for name in _DATA["methods"]}
# The methods with a loss on cosines of satellites with drone pictures; all have the baseline's network.
METRIC_LOSSES = tuple(name for name, of in METHODS.items() if of["metric"] != "none" and of["pooling"] == "average")
OF_BASELINE = ("instance", *METRIC_LOSSES)


def method(name: str, recipe: Recipe) -> Recipe:
    """Apply a method of `METHODS` to a recipe; InputError if there is no such method, or the recipe has none."""
    if name not in METHODS:
        raise InputError(f"There is no method {name!r}; choose one of {', '.join(METHODS)}.")
    if recipe.windows:
        raise InputError(f"A map is trained on with the loss of its recipe; leave --method {name} out.")
    if recipe.compares_drones and name not in METRIC_LOSSES:
        raise InputError(
            f"The recipe is for the metric losses {', '.join(METRIC_LOSSES)}; choose one of them with --method in place of "
            f"{name}, or another --recipe."
        )
    return replace(recipe, **METHODS[name])


def find(recipe: str, method_name: str | None = None) -> Recipe:
    """Return a recipe of `RECIPES`, for its own method, or for one of `METHODS` at the rates of its released script.

    Raises:
        InputError: if there is no such recipe or method, or the recipe has no methods.
    """
    if recipe not in RECIPES:
        raise InputError(f"There is no recipe {recipe!r}; choose one of {', '.join(RECIPES)}.")
    if method_name is None:
        return RECIPES[recipe]
    values = {name: value for name, (value, _) in _of_baseline(recipe, method_name).items()}
    return replace(method(method_name, RECIPES[recipe]), **values)


def _of_baseline(recipe: str, method_name: str | None) -> dict[str, tuple[Any, str]]:
    """Return the settings of a published recipe that the baseline's script replaces."""
    found = _own(_PUBLISHED.get(recipe, {}).get("baseline", {})) if method_name in OF_BASELINE else {}
    return found if method_name == "instance" else {name: (value, _OF_BASELINE) for name, (value, _) in found.items()}


def source(recipe: str, setting: str, method_name: str | None = None) -> str:
    """Return the source of a setting: "paper, ...", a file and line of released code, or "ours: ...".

    Args:
        recipe: one of `RECIPES`; unpublished ones are ours.
        method_name: one of `METHODS`; the released code may have another value for it.
    """
    if recipe not in _STATED:
        return "ours"
    stated = _STATED[recipe] | _of_baseline(recipe, method_name)
    return stated[setting][1] if setting in stated else _UNNAMED


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
