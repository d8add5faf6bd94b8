"""The laboratory's table as JSON: its columns, and the rows that the page asks for in pieces."""

from __future__ import annotations

from typing import Any

import numpy as np
from markupsafe import Markup

from explorer.screen.fragments import part_colour
from explorer.screen.panels.lab.selection import LabSelection, outcome_masks
from explorer.screen.panels.lab.service import LabFindings
from lpn.core.arrays import Int64Array
from lpn.core.files import printable
from lpn.core.numbers import signed
from lpn.core.tables import Column
from lpn.tasks.query_outcomes import RANK_A, RANK_B

_RANKS = ("rank", RANK_A, RANK_B)
_FOUND, _MISSED = Markup('<b class="right">✓</b>'), Markup('<b class="wrong">✗</b>')
_BAR = Markup('<i class="{}" style="left:{}%;width:{}%"></i>')
_SWATCH = Markup('<i class="swatch" style="background:{}"></i>{}')
_HINTS = {
    "rank": "Rank of the nearest true tile",
    "margin": "d² of the hardest negative minus d² of the nearest true tile; negative for a miss",
    "part": "The part that lowers the margin most in a miss, and raises it most otherwise",
    "answer": "The tile that was ranked first",
    "distance": "The distance from the ground in the photo to the centre of the answer",
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


def entries(findings: LabFindings, shown: list[Column], rows: Int64Array, tiles: str) -> list[tuple[int, list[str]]]:
    """Return rows of the table: each query with its cells as HTML; `tiles` is the folder of the tiles' thumbnails."""
    margins = np.abs(findings.outcomes.margin)
    limit = float(np.nanmax(margins)) if np.isfinite(margins).any() else 1.0
    return [(row, [_cell(findings, column, row, tiles, limit) for column in shown]) for row in rows.tolist()]


def _cell(findings: LabFindings, column: Column, row: int, tiles: str, limit: float) -> Markup:
    text, graded = printable(column.text(row)), findings.graded
    if column.name in _RANKS:
        second = findings.second if column.name == RANK_B else None
        found = bool(second.hits[row]) if second is not None else bool(graded.hits[row])
        sign = {True: _FOUND, False: _MISSED}[found] if graded.known[row] else ""
        return Markup("{} {}").format(sign, text or "–")
    if column.name == "margin" and text:
        share = 50 * float(column.values[row]) / limit
        kind, left = ("less", 50 + share) if share < 0 else ("more", 50)
        bar = _BAR.format(kind, f"{left:.2f}", f"{abs(share):.2f}")
        return Markup('<span class="margin">{}<u>{}</u></span>').format(
            signed(float(column.values[row]), 2).lstrip("+"), bar
        )
    if column.name == "part":
        part = int(findings.outcomes.deciding_part[row])
        return _SWATCH.format("none" if part < 0 else f"var({part_colour(part, 2)})", text)
    if column.name == "answer" and text:
        tile = int(findings.outcomes.answer[row])
        title = printable(findings.task.gallery[tile].title)
        return Markup('<span title="{0}"><img src="{1}{2}" alt="">{0}</span>').format(title, tiles, tile)
    if column.name == "distance" and text:
        text = f"{float(column.values[row]):,.0f}"
    return Markup('<span title="{0}">{0}</span>').format(text)


def message(selection: LabSelection, rows: Int64Array) -> dict[str, Any]:
    """Return the header above the table: the choices with their counts, the filter's error, and the numbers of queries.

    Args:
        rows: the selected queries.
    """
    findings = selection.findings
    table, graded, second = findings.table, findings.graded, findings.second
    known = int(graded.known[rows].sum())
    unlike = ""
    if second is not None and len(set(second.scorings)) > 1:
        unlike = "A is ranked {}, B {}, so ranks do not compare the models alone.".format(*second.scorings)
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
        "where": selection.where,
        "error": selection.error,
        "notes_error": findings.notes_error and f"Notes are left out: {findings.notes_error}",
        "picked": len(selection.picked) if len(selection.picked) < len(table) else 0,
        "claim": findings.task.contract.claim,
        "placeholder": f"Filter, such as {_example(selection)}",
        "models": None if second is None else second.names,
        "unlike": unlike,
    }


def _example(selection: LabSelection) -> str:
    if selection.findings.second is not None:
        return "rank A > 1 and rank B = 1"
    names = selection.findings.table.columns
    return f"rank > 5 and {'altitude > 120' if 'altitude' in names else 'margin < -0.1'}"
