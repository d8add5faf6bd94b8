"""HTML of the failure laboratory's table, controls, and messages, from the templates in `web/templates/failure_lab`."""

from __future__ import annotations

from typing import Any, NamedTuple, get_args

import numpy as np

from explorer.compute.background_jobs import BackgroundJob
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import FIXED_COLUMNS, LabState, OutcomeFilter, Tab, extra_columns
from explorer.web.render import render
from explorer.workspace import Workspace
from lpn.analysis.notes import Note
from lpn.core.arrays import Int64Array
from lpn.core.tables import Column
from lpn.drawing import theme

_HINTS = {
    "rank": "Rank of the nearest true tile",
    "margin": "d² of the hardest negative minus that of the nearest true tile; negative where the query failed",
    "part": "The part that decides: it lowers the margin most in a failure, and raises it most in a success",
    "answer": "The tile that was ranked first",
    "distance": "From what the query shows to the centre of the answer",
}


class _Cell(NamedTuple):
    """A cell of the table; `bar` is the start and the width of its bar in percent, and the colour."""

    style: str
    text: str
    title: str = ""
    picture: str = ""
    right: bool | None = None
    swatch: int | None = None
    bar: tuple[float, float, str] | None = None


def bar(findings: Findings, lab: LabState) -> str:
    """Return the bar of tabs, outcomes, and actions."""
    failed, found = int(findings.outcomes.failed.sum()), int(findings.outcomes.found.sum())
    counts = dict(zip(get_args(OutcomeFilter), (len(findings.table), failed, found), strict=True))
    return render("failure_lab/bar", lab=lab, tabs=get_args(Tab), counts=counts)


def search_boxes(findings: Findings, lab: LabState) -> str:
    """Return the text boxes. Sending them again discards what the user is typing: do so after other changes only."""
    altitude = findings.table.columns.get("altitude")
    example = "" if altitude is None else f" and altitude > {np.nanmedian(altitude.values):.0f}"
    return render("failure_lab/search_boxes", lab=lab, example=f"rank > 5{example}")


def summary(findings: Findings, lab: LabState, rows: Int64Array, page: tuple[int, int]) -> str:
    """Return the number of selected queries, the selections, and errors of the filter and the notes.

    Args:
        page: position of the first row on the page, and rows on a page.
    """
    return render(
        "failure_lab/summary",
        lab=lab,
        selected=len(rows),
        queries=len(findings.table),
        failed=int(findings.outcomes.failed[rows].sum()),
        first=min(page[0] + 1, len(rows)),
        last=min(sum(page), len(rows)),
        narrowed=bool(lab.selections or lab.filter or lab.name_search.strip() or lab.outcome != "all"),
        notes_error=findings.notes_error,
        claim=findings.task.contract.claim,
    )


def column_choice(findings: Findings, lab: LabState) -> str:
    """Return the columns to choose from."""
    names = [name for name in findings.table.columns if name not in FIXED_COLUMNS]
    return render("failure_lab/columns", names=names, shown=extra_columns(lab, findings.table))


def table(findings: Findings, lab: LabState, workspace: Workspace, rows: Int64Array, query: int | None) -> str:
    """Return one page of the table.

    Args:
        rows: the queries on the page.
        query: the query that the explorer shows.
    """
    names = [name for name in (*FIXED_COLUMNS, *extra_columns(lab, findings.table)) if name in findings.table.columns]
    columns = [findings.table.columns[name] for name in names]
    margins = findings.outcomes.margin
    limit = float(np.nanmax(np.abs(margins))) if np.isfinite(margins).any() else 1.0
    lines = [
        (
            row,
            workspace.thumbnail(findings.task.queries[row]),
            [_cell(findings, workspace, column, row, limit) for column in columns],
        )
        for row in rows.tolist()
    ]
    return render("failure_lab/table", lab=lab, columns=columns, hints=_HINTS, lines=lines, query=query)


def note(findings: Findings, row: int, note: Note, revision: int) -> str:
    """Return the boxes for the tags and the note of a query; `revision` counts how often they were filled."""
    name = findings.task.queries[row].name
    return render("failure_lab/note", task=findings.task.name, row=row, name=name, note=note, revision=revision)


def message(text: str, good: bool) -> str:
    """Return a line that reports success or an error."""
    return render("failure_lab/message", text=text, good=good)


def waiting(job: BackgroundJob[Any] | None, subject: str, paused: bool, work: str) -> str:
    """Return the progress of some work with a link that cancels it, or a link that starts it again.

    Args:
        subject: the work in words.
        work: the work as messages call it.
    """
    error = None if job is None else job.error
    done, total, seconds = (0, 0, 0.0) if job is None else (job.done, job.total, job.elapsed)
    return render(
        "failure_lab/waiting",
        subject=subject,
        paused=paused,
        work=work,
        error=error,
        done=done,
        total=total,
        seconds=seconds,
    )


def tip(findings: Findings, workspace: Workspace, rows: Int64Array, revision: int) -> str:
    """Return the tip on a map's queries; the page places it beside the mouse when its picture has loaded.

    Args:
        rows: the queries at one place, at least one; the tip shows the first.
        revision: counts the tips, so that the same tip is sent again.
    """
    row = int(rows[0])
    picture = findings.task.queries[row]
    rank, answer, margin = (findings.table.columns[name].text(row) for name in ("rank", "answer", "margin"))
    return render(
        "failure_lab/tip",
        row=row,
        revision=revision,
        thumbnail=workspace.thumbnail(picture),
        name=picture.name,
        right=findings.outcomes.verdict(row),
        rank=rank,
        answer=answer,
        margin=margin,
        count=len(rows),
        failed=int(findings.outcomes.failed[rows].sum()),
    )


def _cell(findings: Findings, workspace: Workspace, column: Column, row: int, limit: float) -> _Cell:
    """Format a cell; `limit` is the margin at the end of the margins' scale."""
    text, outcomes = column.text(row), findings.outcomes
    if column.name == "rank":
        return _Cell("number", text or "–", right=outcomes.verdict(row))
    if not text:
        return _Cell(column.kind, "")
    if column.name == "answer":
        tile = findings.task.gallery[outcomes.answer[row]]
        return _Cell("text pic", text, picture=workspace.thumbnail(tile))
    if column.name == "part":
        return _Cell("text", text, swatch=int(outcomes.deciding_part[row]))
    if column.name == "margin":
        value = float(column.values[row])
        start, width = 50 - max(-value, 0) / limit * 50, abs(value) / limit * 50
        colour = theme.css(theme.verdict_colour(value >= 0))
        return _Cell("number margin", f"{value:+.3f}", bar=(start, width, colour))
    if column.name == "distance":
        text = f"{float(column.values[row]):,.0f}"
    elif column.name.startswith("margin_"):
        text = f"{float(column.values[row]):+.3f}"
    return _Cell(column.kind, text, title=text)
