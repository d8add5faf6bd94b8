"""A measure, the bounds of its figures, and the registry that finds all measures.

A module of this package declares

    MEASURES = (Measure("ranks", run, {"* scores": within(1e-6), "seconds": reported()}),)

where `run` returns a flat dictionary of figures: numbers, texts, or lists of numbers. Heavy imports belong inside `run`, because
the registry imports all modules.
"""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from importlib import import_module
from pathlib import Path
from pkgutil import iter_modules

Value = float | str | list[float]
Figures = Mapping[str, Value]


class NotMeasuredError(Exception):
    """Data for a measure are missing; the message names them, and a way to provide them."""


@dataclass(frozen=True)
class Bound:
    """The bound of a figure.

    Attributes:
        text: in words, such as "within 1e-06".
        error: receives the value and the baseline's figures, and returns the fault, such as "found 2", or "".
        relative: whether the figure must be in the baseline.
    """

    text: str
    error: Callable[[str, Value, Figures], str]
    relative: bool = False


@dataclass(frozen=True)
class Measure:
    """A measure and its bounds.

    Attributes:
        name: of the measure, one word.
        run: measures. It raises NotMeasuredError if data that it needs is not here.
        bounds: by the figure's name or a pattern of it, such as "* ranks". A name comes before patterns, and of those the first
            counts. Each name must be measured, and each pattern must have a figure.
        slow: whether it belongs to the slow half.
    """

    name: str
    run: Callable[[], Figures]
    bounds: Mapping[str, Bound]
    slow: bool = False

    def bound(self, figure: str) -> Bound | None:
        """The bound of a figure; None without one."""
        if figure in self.bounds:
            return self.bounds[figure]
        return next((bound for pattern, bound in self.bounds.items() if fnmatchcase(figure, pattern)), None)


def reported() -> Bound:
    """No bound: the figure is for the reader."""
    return Bound("reported", lambda *_: "")


def at_most(limit: float | None = None) -> Bound:
    """A number, or each of a list, up to a limit; by default up to the baseline's number."""

    def error(name: str, value: Value, before: Figures) -> str:
        most = _number(before[name]) if limit is None else limit
        over = [one for one in _numbers(value) if not one <= most]
        return f"found {max(over)}, and the limit is {most}" if over else ""

    return Bound("at most the baseline" if limit is None else f"at most {limit:g}", error, relative=limit is None)


def at_least(limit: float | None = None) -> Bound:
    """A number from a limit on; by default from the baseline's number on."""

    def error(name: str, value: Value, before: Figures) -> str:
        least = _number(before[name]) if limit is None else limit
        told = f"found {value}" if limit is not None else f"found {value}; the baseline has {least:g}"
        return "" if _number(value) >= least else told

    return Bound("at least the baseline" if limit is None else f"at least {limit:g}", error, relative=limit is None)


def equal(gaps: str = "", above: float = 0.0) -> Bound:
    """The baseline's value, of a list each value.

    Args:
        gaps: figure of the baseline, a gap for each value; values differ freely where it is not larger than `above`.
    """
    text = f"equal where {gaps} > {above:g}" if gaps else "equal"
    return Bound(text, lambda name, value, before: _difference(name, value, before, 0.0, gaps, above), relative=True)


def within(limit: float) -> Bound:
    """The baseline's number, or each of a list, up to an absolute difference."""
    return Bound(
        f"within {limit:g}", lambda name, value, before: _difference(name, value, before, limit), relative=True
    )


def _number(value: Value) -> float:
    """A number; NaN, which no bound holds, for all else."""
    return value if isinstance(value, int | float) else math.nan


def _numbers(value: Value) -> list[float]:
    return [_number(one) for one in (value if isinstance(value, list) else [value])]


def _difference(name: str, value: Value, before: Figures, limit: float, gaps: str = "", above: float = 0.0) -> str:
    """Return the difference of a value from the baseline's in words; "" within the limit."""
    old = before[name]
    if isinstance(value, str) or isinstance(old, str):
        return "" if value == old else f"found {value}; the baseline has {old}"
    new, olds = _numbers(value), _numbers(old)
    if len(new) != len(olds):
        return f"found {len(new)} values; the baseline has {len(olds)}"
    free = [one <= above for one in _numbers(before[gaps])] if gaps else [False] * len(olds)
    # A value that is not a number is not within the limit.
    wrong = [i for i, (a, b) in enumerate(zip(new, olds, strict=True)) if not (free[i] or abs(a - b) <= limit)]
    if not wrong:
        return ""
    if not isinstance(value, list):
        return f"found {value}; the baseline has {old}"
    worst = max(wrong, key=lambda i: abs(new[i] - olds[i]))
    return (
        f"{len(wrong)} of {len(new)} values differ; value {worst} is {new[worst]}, and the baseline has {olds[worst]}"
    )


def errors(measure: Measure, figures: Figures, baseline: Figures) -> dict[str, str]:
    """Return the fault of each figure that breaks its bound, is missing, has no bound, or has no baseline."""
    wrong = {}
    for name in {**figures, **baseline}:
        bound = measure.bound(name)
        if bound is None:
            wrong[name] = f"the figure has no bound; declare one in the measure {measure.name}"
        elif name not in figures:
            wrong[name] = "the figure was not measured"
        elif bound.relative and name not in baseline:
            wrong[name] = f"the baseline lacks it; write it by python -m tools.keep --accept {measure.name}"
        elif error := bound.error(name, figures[name], baseline):
            wrong[name] = f"{error}; expected {bound.text}"
    for pattern in measure.bounds:
        if not any(name == pattern or fnmatchcase(name, pattern) for name in {**figures, **baseline}):
            wrong[pattern] = "the figure was not measured"
    return wrong


def data_folder(variable: str) -> Path:
    """The folder that an environment variable names.

    Raises:
        NotMeasuredError: if the variable is not set or names no folder.
    """
    if not os.environ.get(variable):
        raise NotMeasuredError(f"{variable} is not set; it names the folder of the data")
    folder = Path(os.environ[variable])
    if not folder.is_dir():
        raise NotMeasuredError(f"{variable} is {folder}, which is no folder")
    return folder


def all_measures() -> dict[str, Measure]:
    """All measures by their names, those of a module in its order."""
    package = __name__.rpartition(".")[0]
    names = [found.name for found in iter_modules([str(Path(__file__).parent)]) if not found.name.startswith("_")]
    modules = [import_module(f"{package}.{name}") for name in names]
    return {measure.name: measure for module in modules for measure in getattr(module, "MEASURES", ())}
