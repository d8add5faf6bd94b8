"""HTML of the failure laboratory's table, controls, and messages, from the templates in `web/templates/failure_lab`."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, get_args

import numpy as np

from explorer.browse.feeds import Feeds
from explorer.compute import scorings
from explorer.compute.background_jobs import BackgroundJob
from explorer.failure_lab.service import TERMS, Findings, SecondProgress
from explorer.failure_lab.state import Drawer, LabState, extra_columns, fixed_columns, outcome_masks
from explorer.lab_choices import Tab, show_all
from explorer.web.render import call, render, run
from explorer.workspace import Workspace
from lpn.analysis.named_views import LONGEST_NAME, NamedView
from lpn.core.arrays import BoolArray, Int64Array
from lpn.core.numbers import signed
from lpn.core.tables import Column
from lpn.drawing import theme, words
from lpn.report.page import MOST
from lpn.tasks.notes import Note
from lpn.tasks.query_outcomes import RANK_A, RANK_B

# Digits of a margin: that of an answer that is computed anew may differ in the next one.
_DIGITS = 2
_HINTS = {
    "rank": "Rank of the nearest true tile",
    "margin": "d² of the hardest negative minus that of the nearest true tile; negative where the query failed. "
    "It is of the stored descriptors, which may be rounded, so it has two digits",
    "part": "The part that decides: it lowers the margin most in a failure, and raises it most in a success",
    "answer": "The tile that was ranked first",
    "distance": "From what the query shows to the centre of the answer",
}
_UNGRADED = "Not graded, as no piece is right for certain"
# The verdicts on photos of a flight in plain words.
PLAIN_VERDICTS = {
    "registered": "placed, not in doubt",
    "contradicted": "placed, but in doubt",
    "not verified": "only guessed",
    "not located": "no place",
}
# The bar's choices in plain words.
_PLAIN_CHOICES = {"breakdown": "charts", "failed": "wrong", "found": "right"}
# Examples of filters, without and with a second model.
_EXAMPLE, _EXAMPLE_OF_TWO = "rank > 5", f"{RANK_A} > 1 and {RANK_B} = 1"


class _Cell(NamedTuple):
    """A cell of the table; `bar` is the start and the width of its bar in percent, and the colour."""

    style: str
    text: str
    title: str = ""
    picture: str = ""
    right: bool | None = None
    swatch: int | None = None
    bar: tuple[float, float, str] | None = None


def bar(findings: Findings, lab: LabState, selected: int, chosen: int = 0, tall: bool = False) -> str:
    """Return the bar of tabs, outcomes, and actions, given the numbers of selected queries and of chosen rows.

    Args:
        tall: the window covers the whole stage.
    """
    counts = {outcome: int(mask.sum()) for outcome, mask in outcome_masks(findings).items()}
    names = None if findings.second is None else findings.second.names
    return render(
        "failure_lab/bar",
        lab=lab,
        tabs=get_args(Tab),
        plain_choices=_PLAIN_CHOICES if words.plain() else {},
        counts=counts,
        names=names,
        number=chosen or selected,
        what="chosen" if chosen else "shown",
        most=MOST,
        tall=tall,
    )


def search_boxes(findings: Findings, lab: LabState) -> str:
    """Return the text boxes. Sending them again discards what the user is typing: do so after other changes only."""
    altitude = findings.table.columns.get("altitude")
    example = "" if altitude is None else f" and altitude > {np.nanmedian(altitude.values):.0f}"
    first = _EXAMPLE if findings.second is None else _EXAMPLE_OF_TWO
    return render("failure_lab/search_boxes", lab=lab, example=f"{first}{example}")


def summary(findings: Findings, lab: LabState, rows: Int64Array, chosen: int = 0, preparing: bool = False) -> str:
    """Return the numbers of selected queries and of chosen rows, the selections, and errors of the filter and the notes.

    Args:
        preparing: the second model is being prepared for further scorings.
    """
    return render(
        "failure_lab/summary",
        lab=lab,
        selected=len(rows),
        chosen=chosen,
        queries=len(findings.table),
        failed=int(findings.failed[rows].sum()),
        ungraded=findings.not_graded(rows),
        by_look=_by_look(findings),
        narrowed=show_all(lab) != lab,
        notes_error=findings.notes_error,
        claim=findings.task.contract.claim,
        several=len(findings.part_names) > 1,
        second=findings.second,
        preparing=preparing,
        terms=scorings.TERMS,
        drawers=_drawers(lab, len(rows)),
    )


def _by_look(findings: Findings) -> str:
    """Return by which method answers are wrong or right where others place the pictures, too, as in a flight; else ""."""
    if "verdict" not in findings.table.columns:
        return ""
    return "by its look" if words.plain() else "of retrieval"


def _drawers(lab: LabState, selected: int) -> dict[Drawer, str]:
    """Return the labels of what can be opened below the summary."""
    columns: dict[Drawer, str] = {"columns": "Columns"} if lab.tab == "table" else {}
    return columns | ({"tag": "Tag"} if selected else {}) | {"views": "Views"}


def second_progress(progress: SecondProgress) -> str:
    """Return a line about the second model's ranks while they are not there; empty without a second model."""
    return render("failure_lab/second", second=progress) if progress.text or progress.offered else ""


def drawer(
    findings: Findings,
    lab: LabState,
    selected: int,
    views: Sequence[NamedView],
    message: tuple[str, bool] | None,
    chosen: int = 0,
    refused: str = "",
) -> str:
    """Return what is open below the summary.

    Args:
        selected: number of selected queries.
        views: of the task.
        message: the result of the last change made there, and whether it succeeded.
        chosen: number of selected queries whose rows are chosen.
        refused: the text of the last change, if it failed; it stays in its box.
    """
    if lab.drawer not in _drawers(lab, selected):
        return ""
    if lab.drawer == "columns":
        return column_choice(findings, lab)
    if lab.drawer == "tag":
        return render("failure_lab/tag", selected=selected, chosen=chosen, message=message, refused=refused)
    return render("failure_lab/views", views=views, message=message, longest=LONGEST_NAME, refused=refused)


def column_choice(findings: Findings, lab: LabState) -> str:
    """Return the columns to choose from."""
    fixed = fixed_columns(findings.table)
    names = {name: column.about for name, column in findings.table.columns.items() if name not in fixed}
    return render("failure_lab/columns", names=names, extra=extra_columns(lab, findings.table))


def visible_columns(findings: Findings, lab: LabState) -> list[Column]:
    """Return the columns of the table."""
    # A column of the user's choice may have become one that is always shown.
    names = dict.fromkeys((*fixed_columns(findings.table), *extra_columns(lab, findings.table)))
    return [findings.table.columns[name] for name in names]


def table(findings: Findings, lab: LabState, selected: int, shell: int, height: int) -> str:
    """Return the table without its rows, which the script fetches and draws.

    Args:
        selected: the number of rows.
        shell: number of the table, another one if its columns, rows, or their order are others.
        height: of the table in pixels.
    """
    hints = _HINTS
    if findings.second is not None:
        of_both = zip((RANK_A, RANK_B), findings.second.names, strict=True)
        hints = hints | {rank: f"{_HINTS['rank']} by {name}" for rank, name in of_both}
    columns = visible_columns(findings, lab)
    headings = {name: words.say(term) for name, term in TERMS.items()} if words.plain() else {}
    if by := _by_look(findings):
        headings = headings | {"distance": f"distance {by}", "verdict": "verdict of all methods"}
    return render(
        "failure_lab/table",
        lab=lab,
        columns=columns,
        hints=hints,
        headings=headings,
        selected=selected,
        shell=shell,
        height=height,
    )


def publish(feeds: Feeds, owner: object, findings: Findings, lab: LabState, rows: Int64Array) -> str:
    """Publish the table's rows, and return their feed.

    Args:
        rows: the selected queries, in the table's order.
    """
    columns, vocabulary = visible_columns(findings, lab), words.spoken()

    def entries(start: int, end: int) -> list[tuple[int, str]]:
        with words.speaking(vocabulary):
            return lines(findings, columns, feeds, rows[start:end])

    return feeds.publish_list(owner, "rows", len(rows), entries)


def runs(chosen: BoolArray) -> list[tuple[int, int]]:
    """Return the first and the last position of each run of chosen rows."""
    steps = np.diff(chosen.astype(np.int8), prepend=0, append=0)
    return list(zip(np.flatnonzero(steps == 1).tolist(), (np.flatnonzero(steps == -1) - 1).tolist(), strict=True))


def lines(findings: Findings, columns: Sequence[Column], feeds: Feeds, rows: Int64Array) -> list[tuple[int, str]]:
    """Return rows of the table: each query, and the HTML of its cells."""
    margins = findings.outcomes.margin
    limit = float(np.nanmax(np.abs(margins))) if np.isfinite(margins).any() else 1.0
    return [
        (
            row,
            render(
                "failure_lab/row",
                picture=feeds.thumbnail(findings.task, "query", row),
                cells=[_cell(findings, feeds, column, row, limit) for column in columns],
            ),
        )
        for row in rows.tolist()
    ]


def note(findings: Findings, row: int, note: Note, revision: int) -> str:
    """Return the boxes for the tags and the note of a query; `revision` counts how often they were filled."""
    path = findings.table.paths[row]
    boxes = render(
        "failure_lab/note",
        task=findings.task.key,
        row=row,
        path=path,
        name=findings.task.queries[row].name,
        note=note,
        revision=revision,
    )
    return boxes + run(call("noteOpened", path))


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
    rank, answer = findings.table.columns["rank"].text(row), _answer(findings, row)
    margin = float(findings.outcomes.margin[row])
    return render(
        "failure_lab/tip",
        row=row,
        revision=revision,
        thumbnail=workspace.thumbnail(picture),
        name=picture.name,
        right=findings.verdict(row),
        doubtful=findings.is_doubtful(row),
        rank=rank,
        answer=answer,
        margin="" if np.isnan(margin) else signed(margin, _DIGITS),
        count=len(rows),
        failed=int(findings.failed[rows].sum()),
    )


def _answer(findings: Findings, row: int) -> str:
    """Return what people call the tile that was answered."""
    tile, task = int(findings.outcomes.answer[row]), findings.task
    return task.gallery[tile].title if 0 <= tile < len(task.gallery) else ""


def _cell(findings: Findings, feeds: Feeds, column: Column, row: int, limit: float) -> _Cell:
    """Format a cell; `limit` is the margin at the end of the margins' scale."""
    text, outcomes, right = column.text(row), findings.outcomes, findings.verdict(row)
    if column.name in ("rank", RANK_A, RANK_B):
        if column.name == RANK_B and findings.second is not None and right is not None:
            right = bool(findings.second.hits[row])
        return _Cell("number", text or "–", _UNGRADED if findings.is_doubtful(row) else "", right=right)
    if not text:
        return _Cell(column.kind, "")
    if column.name == "answer":
        return _Cell(
            "text pic",
            _answer(findings, row),
            picture=feeds.thumbnail(findings.task, "tile", int(outcomes.answer[row])),
        )
    if column.name == "verdict" and words.plain():
        return _Cell("text", PLAIN_VERDICTS.get(text, text), title=f"In filters: {text}")
    if column.name == "part":
        return _Cell("text", text, swatch=int(outcomes.deciding_part[row]))
    if column.name == "margin":
        value = float(column.values[row])
        start, width = 50 - max(-value, 0) / limit * 50, abs(value) / limit * 50
        colour = theme.css(theme.verdict_colour(None if findings.is_doubtful(row) else value >= 0))
        return _Cell("number margin", signed(value, _DIGITS), bar=(start, width, colour))
    if column.name == "distance" and column.kind == "number":
        text = f"{float(column.values[row]):,.0f}"
    elif column.name.startswith("margin_") and column.kind == "number":
        text = signed(float(column.values[row]), _DIGITS)
    return _Cell(column.kind, text, title=text)
