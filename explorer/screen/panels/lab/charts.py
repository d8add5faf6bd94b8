"""The laboratory's charts as JSON: margins, ranks, and causes of misses; a click on a line of a card sets the filter."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any

import numpy as np

from explorer.screen.panels.lab.selection import PICKED, LabSelection, encode
from explorer.screen.panels.lab.service import LabFindings
from lpn.analysis import breakdown
from lpn.analysis.answer_context import describe_failures
from lpn.analysis.near_duplicates import MAX_TILES, NearDuplicate, near_duplicates, shows_places
from lpn.core.arrays import Int64Array
from lpn.core.errors import InputError
from lpn.core.tables import Column
from lpn.flight.locate.task import REASON, stage_columns
from lpn.tasks import query_outcomes
from lpn.tasks.task import Task

_MOST_LINES, _MOST_PAIRS, _BARS = 10, 6, 40
_NO_PROPERTY = ("latitude", "longitude", REASON)
_AND = " and "


def message(selection: LabSelection, rows: Int64Array) -> dict[str, Any]:
    """Return all charts of the selected queries; a choice in a card does not narrow this card."""
    findings = selection.findings
    stages = () if findings.flight is None else [column.name for column in stage_columns(findings.flight)]
    sentence = describe_failures(findings.graded, findings.table, findings.task.query_labels, stages)
    return {
        "sentence": sentence,
        "margins": _margins(findings, rows),
        "recall": _recall(findings, rows),
        "cards": [card for card in _cards(selection) if card["lines"]],
    }


def _margins(findings: LabFindings, rows: Int64Array) -> dict[str, list[float]]:
    """Return the middles of the bars of margins, and the numbers of found and missed queries in each."""
    margins, graded = findings.outcomes.margin, findings.graded
    limit = float(np.nanmax(np.abs(margins))) if np.isfinite(margins).any() else 1.0
    edges = np.linspace(-limit, limit, _BARS + 1)
    counts = [np.histogram(margins[rows[mask[rows]]], edges)[0] for mask in (graded.hits, graded.failed)]
    return {
        "at": ((edges[1:] + edges[:-1]) / 2).tolist(),
        "found": counts[0].tolist(),
        "missed": counts[1].tolist(),
    }


def _recall(findings: LabFindings, rows: Int64Array) -> dict[str, Any]:
    """Return the percentage of graded queries with a truth among the first k tiles, also by the second model."""
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
    """An unfinished card. Each of its lines stands for queries, and has the filter that a click on it sets.

    Args:
        conditions: filters of all possible lines; the card removes them from the current filter.
        codes: picked queries of all possible lines, see `encode`; the card ignores such a choice, too.

    Attributes:
        rows: the selected queries of any outcome, without the choices made in this card.
    """

    def __init__(
        self,
        selection: LabSelection,
        title: str,
        conditions: Iterable[str] = (),
        codes: Sequence[str] = (),
        about: str = "",
        term: str = "",
    ) -> None:
        self._selection, self._lines = selection, list[dict[str, Any]]()
        self.head: dict[str, Any] = {"title": title, "about": about, "term": term}
        self._where = selection.where
        for condition in conditions:
            self._where = _without(self._where, condition)
        self.rows = selection.rows(self._where, any_outcome=True, any_picked=selection.state[PICKED] in codes)

    def add(self, line: dict[str, Any], condition: str, queries: Int64Array) -> None:
        """Add a line; a click sets its condition if this selects exactly these queries, else the click picks them."""
        selection = self._selection
        table, before, picked = selection.findings.table, selection.where, selection.state[PICKED]
        try:
            exact = bool(condition) and np.array_equal(table.filter(table.rows(), condition), queries)
        except InputError:
            exact = False
        if exact:
            chosen = _without(before, condition) != before
            both = filter(None, (self._where.strip(), condition))
            click = {"lab_where": self._where if chosen else _AND.join(both)}
        else:
            code = encode(queries, selection.findings.task)
            chosen = code == picked
            click = {"lab_picked": "" if chosen else code}
        self._lines.append(line | {"chosen": chosen, "click": click})

    def finished(self) -> dict[str, Any]:
        """Return the card as JSON."""
        return self.head | {"lines": self._lines}


def _without(text: str, condition: str) -> str:
    if not condition:
        return text
    found = f"{_AND}{text}{_AND}".replace(f"{_AND}{condition}{_AND}", _AND, 1)
    return found.removeprefix(_AND).removesuffix(_AND) if found != _AND else ""


def _quoted(text: str) -> str:
    return f'"{text}"'


def _cards(selection: LabSelection) -> Iterator[dict[str, Any]]:
    findings = selection.findings
    if len(findings.part_names) > 1:
        yield _parts(selection)
    yield _pairs(selection)
    yield _hubs(selection)
    if shows_places(findings.task) and len(findings.task.gallery) <= MAX_TILES:
        yield _alike(selection)
    # A column says nothing if all queries share its value, or if each query has a different one.
    most = max(len(findings.table) // 2, 2)
    for column in query_outcomes.picture_columns(findings.table):
        known = np.flatnonzero(findings.graded.known)
        rates = [] if column.name in _NO_PROPERTY else breakdown.rates(findings.graded.failed, column, rows=known)
        if 1 < len(rates) <= most:
            yield _rates(selection, column, rates)


def _parts(selection: LabSelection) -> dict[str, Any]:
    findings = selection.findings
    failed, deciding = findings.graded.failed, findings.outcomes.deciding_part
    conditions = [f"rank > 1 and part = {_quoted(name)}" for name in findings.part_names]
    card = _Card(selection, "Part that lowers the margin most, of all misses", conditions, term="part")
    counts = breakdown.blame(findings.graded, card.rows).tolist()
    for part, (name, count) in enumerate(zip(findings.part_names, counts, strict=True) if sum(counts) else ()):
        line = {"part": part, "text": name, "count": count, "share": count / max(counts)}
        card.add(line, conditions[part], np.flatnonzero(failed & (deciding == part)))
    return card.finished()


def _pairs(selection: LabSelection) -> dict[str, Any]:
    findings, task = selection.findings, selection.findings.task
    whole, names, conditions = {}, {}, {}
    for one in breakdown.confusions(findings.graded, task.query_labels, task.gallery_labels):
        key, first = (one.place, one.answered), int(one.queries[0])
        whole[key] = one.queries
        names[key] = [findings.table.columns[name].text(first) for name in ("truth", "answer")]
        conditions[key] = f"truth = {_quoted(names[key][0])} and answer = {_quoted(names[key][1])}"
    card = _Card(selection, "Places taken for others", conditions.values())
    found = breakdown.confusions(findings.graded, task.query_labels, task.gallery_labels, card.rows)
    card.head["title"] += _of(_MOST_LINES, len(found))
    for one in found[:_MOST_LINES]:
        key, tiles = (one.place, one.answered), [int(findings.outcomes.true[one.queries[0]]), one.tile]
        line = {"tiles": tiles, "text": " → ".join(names[key]), "count": len(one.queries)}
        card.add(line, conditions[key], whole[key])
    return card.finished()


def _hubs(selection: LabSelection) -> dict[str, Any]:
    findings, task = selection.findings, selection.findings.task
    whole = {one.tile: one.queries for one in breakdown.hubs(findings.graded, task.query_labels)}
    conditions = {tile: f"rank > 1 and answer = {_quoted(task.gallery[tile].name)}" for tile in whole}
    about = "tiles that answer queries of other places"
    card = _Card(selection, "Hubs", conditions.values(), about=about)
    found = breakdown.hubs(findings.graded, task.query_labels, card.rows)
    card.head["title"] += _of(_MOST_PAIRS, len(found))
    for one in found[:_MOST_PAIRS]:
        text = f"{task.gallery[one.tile].name}, {one.places} places"
        line = {"tiles": [one.tile], "text": text, "count": len(one.queries)}
        card.add(line, conditions[one.tile], whole[one.tile])
    return card.finished()


def _alike(selection: LabSelection) -> dict[str, Any]:
    task, about = selection.findings.task, "tiles of two places that look alike to the model"
    card = _Card(selection, "Near-duplicates", about=about)
    for pair in _near_duplicates(task):
        names = " · ".join(task.gallery[tile].name for tile in pair.tiles)
        line = {"tiles": list(pair.tiles), "text": f"{names}{_apart(task, pair)}", "value": f"{pair.cosine:.3f}"}
        card.add(line, "", np.flatnonzero(np.isin(task.query_labels, task.gallery_labels[list(pair.tiles)])))
    return card.finished()


@lru_cache(maxsize=4)
def _near_duplicates(task: Task) -> list[NearDuplicate]:
    return near_duplicates(task.sides()[1], task.gallery_labels, _MOST_PAIRS, task.weights)


def _apart(task: Task, pair: NearDuplicate) -> str:
    """Return the distance of two tiles on the ground in words; empty if it is unknown."""
    metres = np.nan if task.geometry is None else np.hypot(*np.subtract(*task.geometry.ground[list(pair.tiles)]))
    return f", {metres:,.0f} m apart" if np.isfinite(metres) else ""


def _rates(selection: LabSelection, column: Column, rates: Sequence[breakdown.Rate]) -> dict[str, Any]:
    """Return the shares of missed queries in the bins of a column; all queries determine the borders.

    If all or none of the selected queries are missed, all queries are counted.
    """
    findings, rates = selection.findings, rates[:_MOST_LINES]
    failed, masks = findings.graded.failed, [rate.holds(column) for rate in rates]
    conditions = [_condition(column, rate) for rate in rates]
    codes = [encode(np.flatnonzero(mask), findings.task) for mask in masks]
    card = _Card(selection, f"Missed by {column.name}", conditions, codes, column.about)
    rows = card.rows[findings.graded.known[card.rows]]
    if not 0 < int(failed[rows].sum()) < len(rows):
        rows = np.flatnonzero(findings.graded.known)
    overall = float(failed[rows].mean())
    for rate, mask, condition in zip(rates, masks, conditions, strict=True):
        queries, missed = int(mask[rows].sum()), int(failed[rows][mask[rows]].sum())
        low, high = breakdown.wilson(missed, queries) if queries else (0.0, 1.0)
        share = missed / max(queries, 1)
        line = {
            "text": rate.name,
            "share": share,
            "low": low,
            "high": high,
            "overall": overall,
            "hint": f"{missed} of {queries} missed; 95 % interval {100 * low:.0f} to {100 * high:.0f} %",
            "value": f"{100 * share:.0f} %" if queries else "–",
        }
        card.add(line, condition, np.flatnonzero(mask))
    return card.finished()


def _condition(column: Column, rate: breakdown.Rate) -> str:
    """Return the filter for a bin; `_Card.add` tests whether it selects other queries, too."""
    if not rate.known:
        return f"{column.name} = none"
    if column.kind == "text":
        return f"{column.name} = {_quoted(rate.name)}"
    if rate.low == rate.high:
        return f"{column.name} = {rate.low:.10g}"
    return f"{column.name} >= {rate.low:.10g} and {column.name} <= {rate.high:.10g}"


def _of(most: int, total: int) -> str:
    return f", first {most} of {total:,}" if total > most else ""
