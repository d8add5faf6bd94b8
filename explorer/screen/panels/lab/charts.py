"""The laboratory's charts as JSON: margins and ranks, and what fails; a click on a line of a card sets the filter."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from explorer.screen.panels.lab.selection import PICKED, Selection, encode
from explorer.screen.panels.lab.service import Findings
from lpn.analysis import breakdown
from lpn.analysis.answer_context import describe_failures
from lpn.analysis.near_duplicates import MAX_TILES, NearDuplicate, near_duplicates, shows_places
from lpn.core.arrays import Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column
from lpn.locate.task import REASON, stage_columns
from lpn.tasks import query_outcomes
from lpn.tasks.task import Task

_MOST_LINES, _MOST_PAIRS, _BARS = 10, 6, 40
_NO_PROPERTY = ("latitude", "longitude", REASON)
_AND = " and "


def message(selection: Selection, rows: Int64Array) -> dict[str, Any]:
    """Return all charts of the selected queries; a choice made in a card does not narrow this card."""
    findings = selection.findings
    stages = () if findings.flight is None else [column.name for column in stage_columns(findings.flight)]
    sentence = describe_failures(findings.graded, findings.table, findings.task.query_labels, stages)
    return {
        "sentence": sentence,
        "margins": _margins(findings, rows),
        "recall": _recall(findings, rows),
        "cards": [card for card in _cards(selection) if card["lines"]],
    }


def _margins(findings: Findings, rows: Int64Array) -> dict[str, list[float]]:
    """Return the middles of bars of margins, and how many found and missed queries each has."""
    margins, graded = findings.outcomes.margin, findings.graded
    limit = float(np.nanmax(np.abs(margins))) if np.isfinite(margins).any() else 1.0
    edges = np.linspace(-limit, limit, _BARS + 1)
    counts = [np.histogram(margins[rows[mask[rows]]], edges)[0] for mask in (graded.hits, graded.failed)]
    return {
        "at": ((edges[1:] + edges[:-1]) / 2).tolist(),
        "found": counts[0].tolist(),
        "missed": counts[1].tolist(),
    }


def _recall(findings: Findings, rows: Int64Array) -> dict[str, Any]:
    """Return in how many percent of the graded queries the truth is among the first k tiles, also by the second model."""
    known = rows[findings.graded.known[rows]]
    if not len(known):
        return {"k": [], "models": [], "percent": []}
    tiles = max(len(findings.task.gallery), 2)
    k = np.unique(np.geomspace(1, tiles, 60).astype(int))
    columns = findings.table.columns
    names = ("",) if findings.second is None else findings.second.names
    ranks = (
        [columns["rank"]]
        if findings.second is None
        else [columns[query_outcomes.RANK_A], columns[query_outcomes.RANK_B]]
    )
    return {
        "k": k.tolist(),
        "models": list(names),
        "percent": [[100 * float((one.values[known] <= first).mean()) for first in k] for one in ranks],
    }


class _Card:
    """A card while it is made: lines that stand for queries, and what a click on one sets."""

    def __init__(self, selection: Selection, title: str, about: str = "", term: str = "") -> None:
        self._selection, self._lines = selection, list[tuple[dict[str, Any], str, Int64Array]]()
        self._head = {"title": title, "about": about, "term": term}

    def add(self, line: dict[str, Any], condition: str, queries: Int64Array) -> None:
        """Add a line; its condition filters where it selects exactly these queries, else they are picked."""
        table = self._selection.findings.table
        try:
            exact = np.array_equal(table.filter(table.rows(), condition), queries)
        except InputError:
            exact = False
        self._lines.append((line, condition if exact else "", queries))

    @property
    def where(self) -> str:
        """The filter in force without the conditions of this card."""
        text = self._selection.where
        for _, condition, _ in self._lines:
            text = _without(text, condition)
        return text

    def finished(self) -> dict[str, Any]:
        """Return the card as JSON."""
        base, before, lines = self.where, self._selection.where, []
        picked = self._selection.state[PICKED]
        for line, condition, queries in self._lines:
            code = "" if condition else encode(queries, self._selection.findings.task)
            chosen = _without(before, condition) != before if condition else code == picked
            where = before if not condition else base if chosen else _AND.join(filter(None, (base.strip(), condition)))
            click = {"lab_where": where} if condition else {"lab_picked": "" if chosen else code}
            lines.append(line | {"chosen": chosen, "click": click})
        return self._head | {"lines": lines}


def _without(text: str, condition: str) -> str:
    """Return a filter without a condition of its own."""
    if not condition:
        return text
    found = f"{_AND}{text}{_AND}".replace(f"{_AND}{condition}{_AND}", _AND, 1)
    return found.removeprefix(_AND).removesuffix(_AND) if found != _AND else ""


def _quoted(text: str) -> str:
    return f'"{text}"'


def _cards(selection: Selection) -> Iterator[dict[str, Any]]:
    findings = selection.findings
    if len(findings.part_names) > 1:
        yield _parts(selection)
    yield _pairs(selection)
    yield _hubs(selection)
    if shows_places(findings.task) and len(findings.task.gallery) <= MAX_TILES:
        yield _alike(selection)
    # A column says nothing if all queries share its value, or if each query has its own.
    most = max(len(findings.table) // 2, 2)
    for column in query_outcomes.picture_columns(findings.table):
        known = np.flatnonzero(findings.graded.known)
        rates = [] if column.name in _NO_PROPERTY else breakdown.rates(findings.graded.failed, column, rows=known)
        if 1 < len(rates) <= most:
            yield _rates(selection, column, rates)


def _parts(selection: Selection) -> dict[str, Any]:
    findings = selection.findings
    failed, deciding = findings.graded.failed, findings.outcomes.deciding_part
    counts = breakdown.blame(findings.graded, selection.rows(any_outcome=True)).tolist()
    card = _Card(selection, "Part that lowers the margin most, of all misses", term="part")
    for part, name in enumerate(findings.part_names):
        line = {"part": part, "text": name, "count": counts[part], "share": counts[part] / max(*counts, 1)}
        card.add(line, f"rank > 1 and part = {_quoted(name)}", np.flatnonzero(failed & (deciding == part)))
    return card.finished() if sum(counts) else card._head | {"lines": []}


def _pairs(selection: Selection) -> dict[str, Any]:
    findings, task = selection.findings, selection.findings.task
    rows = selection.rows(any_outcome=True)
    found = breakdown.confusions(findings.graded, task.query_labels, task.gallery_labels, rows)
    everything = breakdown.confusions(findings.graded, task.query_labels, task.gallery_labels)
    whole = {(one.place, one.answered): one.queries for one in everything}
    card = _Card(selection, f"Places taken for others{_of(_MOST_LINES, len(found))}")
    for one in found[:_MOST_LINES]:
        first = int(one.queries[0])
        names = [findings.table.columns[name].text(first) for name in ("truth", "answer")]
        line = {"tiles": [int(findings.outcomes.true[first]), one.tile], "text": " → ".join(names), "count": one.count}
        condition = f"rank > 1 and truth = {_quoted(names[0])} and answer = {_quoted(names[1])}"
        card.add(line, condition, whole[one.place, one.answered])
    return card.finished()


def _hubs(selection: Selection) -> dict[str, Any]:
    findings, task = selection.findings, selection.findings.task
    found = breakdown.hubs(findings.graded, task.query_labels, selection.rows(any_outcome=True))
    whole = {one.tile: one.queries for one in breakdown.hubs(findings.graded, task.query_labels)}
    card = _Card(selection, f"Hubs{_of(_MOST_PAIRS, len(found))}", "tiles that answer queries of other places", "hub")
    for one in found[:_MOST_PAIRS]:
        name = task.gallery[one.tile].name
        line = {"tiles": [one.tile], "text": f"{name}, {one.places} places", "count": len(one.queries)}
        card.add(line, f"rank > 1 and answer = {_quoted(name)}", whole[one.tile])
    return card.finished()


def _alike(selection: Selection) -> dict[str, Any]:
    task = selection.findings.task
    card = _Card(selection, "Near-duplicates", "tiles of two places that look alike to the model", "near-duplicate")
    for pair in _near_duplicates(task):
        names = " · ".join(task.gallery[tile].name for tile in pair.tiles)
        line = {"tiles": list(pair.tiles), "text": f"{names}{_apart(task, pair)}", "value": f"{pair.cosine:.3f}"}
        card.add(line, "", np.flatnonzero(np.isin(task.query_labels, task.gallery_labels[list(pair.tiles)])))
    return card.finished()


@lru_cache(maxsize=4)
def _near_duplicates(task: Task) -> list[NearDuplicate]:
    return near_duplicates(task.sides()[1], task.gallery_labels, _MOST_PAIRS, task.weights)


def _apart(task: Task, pair: NearDuplicate) -> str:
    """Return the distance of two tiles on the ground in words; empty if it is not known."""
    metres = np.nan if task.geometry is None else np.hypot(*np.subtract(*task.geometry.ground[list(pair.tiles)]))
    return f", {metres:,.0f} m apart" if np.isfinite(metres) else ""


def _rates(selection: Selection, column: Column, rates: Sequence[breakdown.Rate]) -> dict[str, Any]:
    """Return the shares of missed queries in the bins of a column, among the selected ones that this card leaves.

    The bins are those of all queries. If all or none of the selected ones are missed, all queries are counted.
    """
    findings = selection.findings
    graded, masks = findings.graded, [rate.holds(column) for rate in rates]
    card = _Card(selection, f"Missed by {column.name}", column.about)
    lines: list[dict[str, Any]] = [{"text": rate.name} for rate in rates[:_MOST_LINES]]
    for line, rate, mask in zip(lines, rates, masks, strict=False):
        card.add(line, _condition(column, rate), np.flatnonzero(mask))
    ends = [encode(np.flatnonzero(mask), findings.task) for mask in masks]
    rows = selection.rows(card.where, any_outcome=True, any_picked=selection.state[PICKED] in ends)
    rows = rows[graded.known[rows]]
    if not 0 < int(graded.failed[rows].sum()) < len(rows):
        rows = np.flatnonzero(graded.known)
    overall = int(graded.failed[rows].sum()) / max(len(rows), 1)
    for line, mask in zip(lines, masks, strict=False):
        queries = int(mask[rows].sum())
        missed = int(graded.failed[rows][mask[rows]].sum())
        low, high = breakdown.wilson(missed, queries) if queries else (0.0, 1.0)
        hint = f"{missed} of {queries} missed; 95 % interval {100 * low:.0f} to {100 * high:.0f} %"
        share = missed / max(queries, 1)
        value = f"{100 * share:.0f} %" if queries else "–"
        line |= {"share": share, "low": low, "high": high, "overall": overall, "hint": hint, "value": value}
    return card.finished()


def _condition(column: Column, rate: breakdown.Rate) -> str:
    """Return the filter that a bin is; it may select others, which `_Card.add` finds."""
    if not rate.known:
        return f"{column.name} = none"
    if column.kind == "text":
        return f"{column.name} = {_quoted(rate.name)}"
    if rate.low == rate.high:
        return f"{column.name} = {rate.low:.10g}"
    return f"{column.name} >= {rate.low:.10g} and {column.name} <= {rate.high:.10g}"


def _of(most: int, total: int) -> str:
    return f", first {most} of {total:,}" if total > most else ""
