"""The html of the failure laboratory: what is chosen, the table, and notes. Everything from a file is escaped."""

from __future__ import annotations

from html import escape
from typing import Any

import numpy as np

from explorer.compute.background_jobs import BackgroundJob
from explorer.failure_lab.lab_state import ALWAYS, OUTCOMES, TABS, LabState, extra_columns
from explorer.failure_lab.service import Findings
from explorer.web.render import SIGNS, send
from explorer.web.style import verdict_ink
from explorer.workspace import Workspace
from lpn.analysis.notes import Note
from lpn.core.arrays import Int64Array
from lpn.core.tables import Column
from lpn.drawing import overlays

_HINTS = {
    "rank": "Rank of the first true tile",
    "margin": "Score of the nearest true tile minus that of the best wrong one; negative where the query failed",
    "part": "The part that decides: it costs the truth most in a failure, and gains it most in a success",
    "answer": "The tile that came first",
    "distance": "From what the query shows to the centre of the answer",
}
_STAY = "onkeydown='event.stopPropagation()'"
"""What is typed into a box is no command and moves no camera."""


def bar(found: Findings, lab: LabState) -> str:
    """Which tab, which outcome, and what can be done."""
    tabs = "".join(_choice("lab-tab", tab, tab.capitalize(), tab == lab.tab) for tab in TABS)
    failed = int(found.outcomes.failed.sum())
    counts = dict(zip(OUTCOMES, (len(found.table), failed, len(found.table) - failed), strict=True))
    outcomes = "".join(
        _choice("lab-outcome", name, f"{_sign(name)}{name} {counts[name]:,}", name == lab.outcome) for name in OUTCOMES
    )
    size = ("⤡", "Leave the compared pair in sight") if lab.tall else ("⤢", "Over the whole stage")
    return (
        f"<div class='lpn lab-bar num'><span class='seg'>{tabs}</span><span class='seg'>{outcomes}</span>"
        "<span class='acts'>"
        f"<a {send('lab-csv')} title='Save the chosen queries with all columns, tags, and notes'>CSV</a>"
        f"<a {send('lab-report')} title='Save a page about each of the chosen queries (200 at most)'>Report</a>"
        f"<a id='lpn-lab-tall' {send('lab-tall')} title='{size[1]}'>{size[0]}</a>"
        f"<a {send('lab-close')} title='Close (B)'>✕</a></span></div>"
    )


def boxes(found: Findings, lab: LabState) -> str:
    """The boxes to type into; sent again only when something else than typing changed what they hold."""
    example = "rank > 5"
    column = found.table.columns.get("altitude")
    if column is not None:
        example += f" and altitude > {np.nanmedian(column.values):.0f}"
    return (
        f"<div class='lpn lab-boxes' data-texts='{lab.texts}'>"
        f"<input type='search' id='lpn-lab-find' aria-label='Name contains' placeholder='Name contains' "
        f"value='{escape(lab.find)}' maxlength='200' oninput='lpn.typed(this,\"lab-find\")' {_STAY}>"
        f"<input type='search' id='lpn-lab-where' aria-label='Filter' placeholder='Filter, such as {escape(example)}' "
        f"value='{escape(lab.typed)}' maxlength='1100' spellcheck='false' oninput='lpn.typed(this,\"lab-where\")' {_STAY}></div>"
    )


def said(found: Findings, lab: LabState, rows: Int64Array, page: tuple[int, int]) -> str:
    """How many queries are chosen and by what, and what is wrong with the filter.

    Args:
        page: position of the first row that is shown, and how many a page has.
    """
    first, count = page
    pager = (
        f"<span class='turn'>{_choice('lab-choose', None, 'Columns', lab.choosing)}"
        f"<span class='pager'><a {send('lab-page', -1)} title='Earlier rows'>‹</a><span id='lpn-lab-page'>"
        f"{min(first + 1, len(rows)):,}–{min(first + count, len(rows)):,}</span>"
        f"<a {send('lab-page', 1)} title='Later rows'>›</a></span></span>"
        if lab.tab == "table"
        else ""
    )
    picks = "".join(
        f"<a class='pick' {send('lab-unpick', pick.kind)} title='Take this choice away'>{escape(pick.words)} ✕</a>"
        for pick in lab.picks
    )
    chosen = lab.picks or lab.where or lab.find.strip() or lab.outcome != "all"
    clear = f"<a class='link' {send('lab-clear')}>show all</a>" if chosen else ""
    flaw = f"<div class='flaw' role='alert'>⚠ {escape(lab.flaw)}</div>" if lab.flaw else ""
    unread = f"<div class='flaw'>⚠ Notes are left out: {escape(found.flaw)}</div>" if found.flaw else ""
    failed = int(found.outcomes.failed[rows].sum())
    share = f", {failed:,} failed ({100 * failed / len(rows):.1f} %)" if len(rows) else ""
    return (
        f"<div class='lpn lab-said num'><div class='line'><span id='lpn-lab-count'>{len(rows):,} of {len(found.table):,} queries"
        f"{share}</span>{picks}{clear}<span class='dim'>all parts weigh alike here</span><span class='gap'></span>"
        f"{pager}</div>{flaw}{unread}</div>"
    )


def columns(found: Findings, lab: LabState) -> str:
    """The columns to choose from."""
    shown = extra_columns(lab, found.table)
    chips = "".join(
        f"<a class='{'chosen' if name in shown else ''}' {send('lab-column', name)}>{escape(name)}</a>"
        for name in found.table.columns
        if name not in ALWAYS
    )
    return f"<div class='lpn'><div class='lab-chips' id='lpn-lab-columns'>Columns {chips}</div></div>"


def table(found: Findings, lab: LabState, workspace: Workspace, shown: Int64Array, query: int | None) -> str:
    """One page of the table."""
    if not len(shown):
        return (
            "<div class='lpn lab-empty' id='lpn-lab-table'>No query is left by these choices; "
            f"<a class='link' {send('lab-clear')}>show all</a>.</div>"
        )
    names = [name for name in (*ALWAYS, *extra_columns(lab, found.table)) if name in found.table.columns]
    listed = [found.table.columns[name] for name in names]
    head = "".join(_heading(column, lab) for column in listed)
    limit = float(np.nanmax(np.abs(found.outcomes.margin))) if np.isfinite(found.outcomes.margin).any() else 1.0
    lines = "".join(
        f"<tr class='{'chosen' if row == query else ''}' data-row='{row}' {send('lab-open', row)}>"
        f"<td class='pic'><img src='{workspace.thumbnail(found.task.queries[row].path)}' alt=''></td>"
        f"{''.join(_cell(found, workspace, column, row, limit) for column in listed)}</tr>"
        for row in shown.tolist()
    )
    return (
        f"<div class='lpn lab-table num' id='lpn-lab-table'><table><thead><tr><th class='pic'></th>{head}</tr></thead>"
        f"<tbody>{lines}</tbody></table></div>"
    )


def note(found: Findings, row: int, note: Note, opened: int) -> str:
    """Boxes for the tags and the note of a query; `opened` counts how often they were filled."""
    task, name = found.task.name, found.task.queries[row].name
    return (
        f"<div class='lpn lab-note' data-task='{escape(task)}' data-row='{row}' data-opened='{opened}'><b>{escape(name)}</b>"
        f"<input id='lpn-lab-tags' aria-label='Tags' placeholder='Tags: night blur' value='{escape(' '.join(note.tags))}' "
        f"maxlength='1000' onchange='lpn.note(this)' {_STAY}>"
        f"<textarea id='lpn-lab-note' aria-label='Note' placeholder='Note' rows='1' maxlength='2100' onchange='lpn.note(this)' "
        f"{_STAY}>\n{escape(note.text)}</textarea><a onclick='lpn.note(this)'>Save</a></div>"
    )


def message(text: str, good: bool) -> str:
    """What became of saving."""
    if not text:
        return ""
    return (
        f"<div class='lpn {'dim' if good else 'flaw'}' id='lpn-lab-message'>{'' if good else '⚠ '}{escape(text)}</div>"
    )


def waiting(job: BackgroundJob[Any] | None, what: str, cancelled: bool, key: str) -> str:
    """How far some work is, with cancel; why there is no result, with another try; or that it was cancelled."""
    if cancelled:
        body = f"<div>{escape(what)} was cancelled. <a class='link' {send('lab-go', key)}>Go on</a></div>"
    elif job is not None and job.error is not None:
        body = (
            f"<div class='flaw' role='alert'>⚠ {escape(what)} is not there: {escape(job.error)} "
            f"<a class='link' {send('lab-go', key)}>Try again</a></div>"
        )
    else:
        done, total, seconds = (0, 0, 0.0) if job is None else (job.done, job.total, job.elapsed)
        share = 100 * done / total if total else 0.0
        far = f"{share:.0f} % ({done:,} of {total:,} queries)" if total else f"{seconds:.0f} s so far"
        line = f"<div class='bar'><i style='width:{share:.1f}%'></i></div>" if total else ""
        body = f"<div>{escape(what)}: {far} <a class='link' {send('lab-stop', key)}>Cancel</a></div>{line}"
    return f"<div class='lpn lab-empty' id='lpn-lab-waiting'>{body}</div>"


def tip(found: Findings, workspace: Workspace, rows: Int64Array, count: int) -> str:
    """What is shown beside the mouse over queries on a map, the first of them; the page puts it there when its picture has come.

    Args:
        rows: one or more queries at one place.
        count: tells this one from the last.
    """
    row = int(rows[0])
    entry = found.task.queries[row]
    rank, answer, margin = (found.table.columns[name].text(row) for name in ("rank", "answer", "margin"))
    true = bool(found.outcomes.rank[row] == 0)
    became = "found" if true else f"answer {answer}, truth {f'rank {rank}' if rank else 'not in the gallery'}"
    failed = int(found.outcomes.failed[rows].sum())
    others = f"<div class='dim'>{failed} of the {len(rows)} queries here failed</div>" if len(rows) > 1 else ""
    return (
        f"<div class='lpn lab-tip num' data-count='{count}' data-row='{row}'><img src='{workspace.thumbnail(entry.path)}' alt='' "
        f"onload='lpn.tip(this.parentElement)'><div><b>{escape(entry.name)}</b><div>{_signed(true)} {escape(became)}</div>"
        f"<div class='dim'>margin {margin or 'unknown'}</div>{others}</div></div>"
    )


def _choice(kind: str, value: object, words: str, chosen: bool) -> str:
    return f"<a class='{'chosen' if chosen else ''}' {send(kind, value)}>{words}</a>"


def _sign(outcome: str) -> str:
    return "" if outcome == "all" else f"{_signed(outcome == 'found')} "


def _signed(true: bool) -> str:
    return f"<b style='color:{verdict_ink(true)}'>{SIGNS[true]}</b>"


def _heading(column: Column, lab: LabState) -> str:
    arrow, order = "", "none"
    if column.name == lab.sort:
        arrow, order = (" ▼", "descending") if lab.descending else (" ▲", "ascending")
    unit = f" <span class='dim'>{escape(column.unit)}</span>" if column.unit else ""
    return (
        f"<th class='{column.kind}' aria-sort='{order}' {send('lab-sort', column.name)} "
        f"title='{escape(_HINTS.get(column.name, column.name))}; click to sort'>{escape(column.name)}{unit}{arrow}</th>"
    )


def _cell(found: Findings, workspace: Workspace, column: Column, row: int, limit: float) -> str:
    text = column.text(row)
    if column.name == "answer" and text:
        tile = found.task.gallery[found.outcomes.first[row]]
        return f"<td class='text pic'><img src='{workspace.thumbnail(tile.path)}' alt=''>{escape(text)}</td>"
    if column.name == "rank":
        return f"<td class='number'>{_signed(bool(found.outcomes.rank[row] == 0))} {text or '–'}</td>"
    if column.name == "margin" and text:
        value = float(column.values[row])
        colour = overlays.css(overlays.verdict_colour(value >= 0))
        left = 50 - max(-value, 0) / limit * 50
        piece = f"<i style='left:{left:.1f}%;width:{abs(value) / limit * 50:.1f}%;background:{colour}'></i>"
        return f"<td class='number margin'>{value:+.3f}<div>{piece}</div></td>"
    if column.name == "part" and text:
        colour = overlays.css(overlays.part_colour(int(found.outcomes.decides[row])))
        return f"<td class='text'><i class='swatch' style='background:{colour}'></i>{escape(text)}</td>"
    if column.name == "distance" and text:
        text = f"{float(column.values[row]):,.0f}"
    if column.name.startswith("margin_") and text:
        text = f"{float(column.values[row]):+.3f}"
    return f"<td class='{column.kind}' title='{escape(text)}'>{escape(text)}</td>"
