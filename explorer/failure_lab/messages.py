"""What the laboratory's html may ask for, as pure functions of one browser's choices. No value is trusted; None is ignored."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

from explorer.failure_lab import lab_state
from explorer.failure_lab.lab_state import MAPS, OUTCOMES, TABS, LabState, Pick
from explorer.failure_lab.map_drawing import Drawn
from explorer.failure_lab.service import Findings
from lpn.core.arrays import Int64Array

Changed = LabState | None


def integer(value: Any, low: int, high: int) -> int | None:
    """A whole number within low .. high, or None."""
    if isinstance(value, bool) or not isinstance(value, int) or not low <= value <= high:
        return None
    return value


def point(value: Any) -> tuple[float, float] | None:
    """Fractions from the left and the top, 0 .. 1, or None."""
    if not isinstance(value, list) or len(value) != 2:
        return None
    if any(isinstance(v, bool) or not isinstance(v, (int, float)) or not 0 <= v <= 1 for v in value):
        return None
    return float(value[0]), float(value[1])


def tab(lab: LabState, _: Findings, value: Any) -> Changed:
    """Show another tab."""
    return replace(lab, tab=value, page=0) if value in TABS else None


def outcome(lab: LabState, _: Findings, value: Any) -> Changed:
    """All queries, or those that failed or did not."""
    return replace(lab, outcome=value, page=0) if value in OUTCOMES else None


def sort(lab: LabState, found: Findings, value: Any) -> Changed:
    """Sort by a column."""
    return lab_state.sorted_by(lab, value) if _is_column(found, value) else None


def find(lab: LabState, _: Findings, value: Any) -> Changed:
    """Search names."""
    return replace(lab, find=value[:200], page=0) if isinstance(value, str) else None


def where(lab: LabState, found: Findings, value: Any) -> Changed:
    """Filter."""
    return lab_state.filtered(lab, value[:2000], found.table) if isinstance(value, str) else None


def column(lab: LabState, found: Findings, value: Any) -> Changed:
    """Show a column, or no longer."""
    return lab_state.with_column(lab, found.table, value) if _is_column(found, value) else None


def unpick(lab: LabState, _: Findings, value: Any) -> Changed:
    """Take a choice away."""
    return lab_state.unpicked(lab, value) if isinstance(value, str) else None


def part(lab: LabState, found: Findings, value: Any, names: list[str]) -> Changed:
    """Choose the failures that a part costs most."""
    chosen = integer(value, 0, len(names) - 1)
    return None if chosen is None else _toggled(lab, lab_state.pick_part(found, chosen, names[chosen]))


def pair(lab: LabState, found: Findings, value: Any) -> Changed:
    """Choose the queries of one place that were answered with another."""
    if not isinstance(value, list) or len(value) != 2 or not all(type(v) is int for v in value):
        return None
    return _toggled(lab, lab_state.pick_pair(found, lab, *value))


def of_bin(lab: LabState, found: Findings, value: Any) -> Changed:
    """Choose the queries of one bin of a column: [column, the bin's index, its name]."""
    if not isinstance(value, list) or len(value) != 3 or not isinstance(value[0], str) or type(value[1]) is not int:
        return None
    return _toggled(lab, lab_state.pick_bin(found, lab, *value))


def map_kind(lab: LabState, found: Findings, value: Any) -> Changed:
    """Show another map; a UMAP takes long, and so is made only when asked for."""
    if value not in MAPS or (value == "ground" and found.task.geometry is None):
        return None
    return replace(lab, map=value, stopped=lab.stopped - {value})


def rectangle(lab: LabState, value: Any, drawn: Drawn | None) -> Changed:
    """Choose the queries in a rectangle of the map that is shown: [map, its corners' fractions]."""
    if drawn is None or not isinstance(value, list) or len(value) != 3 or value[0] != lab.map:
        return None
    one, other = point(value[1]), point(value[2])
    if one is None or other is None:
        return None
    words = "rectangle on the ground" if lab.map == "ground" else f"rectangle in the {lab.map.upper()}"
    rows: Int64Array = drawn.inside(one, other)
    return lab_state.picked(lab, Pick(f"in {lab.map}", words, rows))


def stop(lab: LabState, _: Findings | None, value: Any) -> Changed:
    """Wait for a table or map no longer."""
    return replace(lab, stopped=lab.stopped | {value}) if value in ("table", *MAPS) else None


def go(lab: LabState, _: Findings | None, value: Any) -> Changed:
    """Make a table or map after all."""
    return replace(lab, stopped=lab.stopped - {value}) if value in ("table", *MAPS) else None


WITH_TABLE: dict[str, Callable[[LabState, Findings, Any], Changed]] = {
    "lab-tab": tab,
    "lab-outcome": outcome,
    "lab-sort": sort,
    "lab-find": find,
    "lab-where": where,
    "lab-column": column,
    "lab-unpick": unpick,
    "lab-pair": pair,
    "lab-bin": of_bin,
    "lab-map": map_kind,
    "lab-clear": lambda lab, _, __: lab_state.cleared(lab),
    "lab-choose": lambda lab, _, __: replace(lab, choosing=not lab.choosing),
    "lab-fit": lambda lab, _, __: replace(lab, fit=not lab.fit),
}
"""Messages that mean something once there is a table."""


def _toggled(lab: LabState, pick: Pick | None) -> Changed:
    """Choose, or no longer where that is what is chosen."""
    if pick is None:
        return None
    same = any(one.same(pick) for one in lab.picks)
    return lab_state.unpicked(lab, pick.kind) if same else lab_state.picked(lab, pick)


def _is_column(found: Findings, value: Any) -> bool:
    return isinstance(value, str) and value in found.table.columns
