"""The laboratory's table as JSON: its columns, and the rows that the page asks for in pieces."""

from __future__ import annotations

from typing import Any

import numpy as np

from explorer.screen.panels.lab.selection import LabSelection, outcome_masks
from explorer.screen.panels.lab.service import LabFindings
from lpn.core.arrays import Int64Array
from lpn.core.tables import Column
from lpn.tasks.query_outcomes import RANK_A, RANK_B

_RANKS = ("rank", RANK_A, RANK_B)
_HINTS = {
    "rank": "Rank of the nearest true tile",
    "margin": "d² of the hardest negative minus d² of the nearest true tile; negative for a miss",
    "part": "The part that lowers the margin most in a miss, and raises it most otherwise",
    "answer": "The tile that was ranked first",
    "distance": "From what the photo shows to the centre of the answer",
}


def columns(selection: LabSelection) -> list[dict[str, str]]:
    """Return the headings of the table: name, unit, kind, and hint of each column."""
    second = selection.findings.second
    hints = dict(_HINTS)
    if second is not None:
        hints |= {
            rank: f"{_HINTS['rank']} by {name}" for rank, name in zip((RANK_A, RANK_B), second.names, strict=True)
        }
    return [
        {
            "name": one.name,
            "unit": one.unit,
            "kind": _kind(one),
            "hint": hints.get(one.name) or one.about or one.name,
        }
        for one in selection.columns()
    ]


def _kind(column: Column) -> str:
    if column.name in _RANKS:
        return "rank"
    return column.name if column.name in ("margin", "part", "answer") else column.kind


def entries(findings: LabFindings, shown: list[Column], rows: Int64Array) -> list[tuple[int, list[Any]]]:
    """Return rows of the table: each query and its cells."""
    return [(row, [_cell(findings, column, row) for column in shown]) for row in rows.tolist()]


def _cell(findings: LabFindings, column: Column, row: int) -> Any:
    """Return a cell as its column's kind needs it: a text, a number, or a text with a verdict, a part, or a tile."""
    text, graded = column.text(row), findings.graded
    if column.name in _RANKS:
        second = findings.second if column.name == RANK_B else None
        found = bool(second.hits[row]) if second is not None else bool(graded.hits[row])
        return text or "–", found if graded.known[row] else None
    if column.name == "margin":
        return round(float(column.values[row]), 4) if text else None
    if column.name == "part":
        return text, int(findings.outcomes.deciding_part[row])
    if column.name == "answer":
        tile = int(findings.outcomes.answer[row])
        return (findings.task.gallery[tile].title, tile) if text else ("", -1)
    if column.name == "distance" and text:
        return f"{float(column.values[row]):,.0f}"
    return text


def message(selection: LabSelection, rows: Int64Array) -> dict[str, Any]:
    """Return what stands above the table: the choices with their counts, the filter's error, and a sentence of numbers.

    Args:
        rows: the selected queries.
    """
    findings = selection.findings
    table, graded, second = findings.table, findings.graded, findings.second
    margins = np.abs(findings.outcomes.margin)
    known = int(graded.known[rows].sum())
    unlike = ""
    if second is not None and len(set(second.scorings)) > 1:
        unlike = "A is ranked {}, B {}: their ranks differ not by the models alone.".format(*second.scorings)
    name, descending = selection.sort
    return {
        "total": len(rows),
        "queries": len(table),
        "counts": {name: int(mask.sum()) for name, mask in outcome_masks(findings).items()},
        "missed": int(graded.failed[rows].sum()),
        "graded": known,
        "columns": columns(selection),
        "further": selection.further_columns(),
        "names": list(table.columns),
        "longest": max(map(len, table.columns["name"].values)),
        "sort": name,
        "descending": descending,
        "limit": float(np.nanmax(margins)) if np.isfinite(margins).any() else 1.0,
        "where": selection.where,
        "error": selection.error,
        "notes_error": findings.notes_error and f"Notes are left out: {findings.notes_error}",
        "picked": len(selection.picked) if len(selection.picked) < len(table) else 0,
        "claim": findings.task.contract.claim,
        "models": None if second is None else second.names,
        "unlike": unlike,
    }
