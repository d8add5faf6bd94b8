"""HTML of the laboratory's second tab: failures by part, by pair of places, and against each column."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from explorer.failure_lab import state
from explorer.failure_lab.service import Findings
from explorer.failure_lab.state import LabState
from explorer.failure_lab.table import PLAIN_VERDICTS
from explorer.web.render import render
from explorer.workspace import Workspace
from lpn.analysis import breakdown, near_duplicates
from lpn.analysis.answer_context import describe_failures
from lpn.analysis.breakdown import Rate
from lpn.analysis.near_duplicates import NearDuplicate, shows_places
from lpn.core.tables import Column
from lpn.drawing.words import capitalised, column_name, plain, say
from lpn.locate.task import stage_columns
from lpn.tasks.task import Task

_MAX_PAIRS, _MAX_VALUES, _MAX_TILES = 10, 10, 6


class _Line(NamedTuple):
    """A line of a card; a click sends the message `kind` with `value`."""

    kind: str
    value: object
    chosen: bool
    hint: str
    content: object


@dataclass(frozen=True)
class _Card:
    """A chart; `style` is "part", "pair", "hub", "alike", or "rate".

    Attributes:
        about: what the values of a column mean; may be empty.
        room: lines that it takes at least, so that no chart moves under the pointer while a person chooses.
    """

    style: str
    title: str
    lines: Sequence[_Line]
    about: str = ""
    room: int = 1


class _RateBar(NamedTuple):
    """A bar of a failure rate; all numbers are percent of the bar's length."""

    share: float
    overall: float
    low: float
    width: float


def page(findings: Findings, lab: LabState, workspace: Workspace) -> str:
    """Return the charts of the selected queries; a selection made in a chart does not narrow this chart."""
    of_all = cards(findings, state.clear(lab), workspace)
    drawn = [
        replace(card, room=max(len(card.lines), len(whole.lines), 1))
        for card, whole in zip(cards(findings, lab, workspace), of_all, strict=True)
    ]
    return render(
        "failure_lab/breakdown",
        sentence=_sentence(findings, workspace),
        cards=drawn,
        has_columns=any(card.style == "rate" for card in drawn),
    )


def _sentence(findings: Findings, workspace: Workspace) -> str:
    """Say which kind of picture fails most among all queries."""
    flight = workspace.flight
    stages = () if flight is None else [column.name for column in stage_columns(flight)]
    return describe_failures(findings.graded, findings.table, findings.task.query_labels, stages)


def cards(findings: Findings, lab: LabState, workspace: Workspace) -> list[_Card]:
    """Return what the charts show."""
    # A column says nothing if all queries share its value, or if each query has its own; a choice of queries does not count.
    everything, most = state.clear(lab), max(len(findings.table) // 2, 2)
    columns = [
        column
        for column in state.charted_columns(findings)
        if 1 < len(state.failure_rates(findings, everything, column)) <= most
    ]
    drawn = [_pair_card(findings, lab, workspace), _hub_card(findings, lab, workspace)]
    if len(findings.part_names) > 1:
        drawn.insert(0, _part_card(findings, lab))
    if shows_places(findings.task) and len(findings.task.gallery) <= near_duplicates.MAX_TILES:
        drawn.append(_alike_card(findings, lab, workspace))
    return drawn + [_rate_card(findings, lab, column, state.failure_rates(findings, lab, column)) for column in columns]


def _part_card(findings: Findings, lab: LabState) -> _Card:
    rows = state.selected_rows(findings, lab, "part", any_outcome=True)
    counts = breakdown.blame(findings.graded, rows).tolist()
    failed = int(findings.failed[rows].sum())
    title = f"{capitalised(say('part'))} that lowers the {say('margin')} most"
    if not failed:
        return _Card("part", title, [])
    most = max(max(counts), 1)
    chosen = _label(lab, "part")
    lines = [
        _Line(
            "lab-part",
            part,
            f"part {name} lowers the margin most" == chosen,
            f"{capitalised(say('part'))} {name} lowers the {say('margin')} most in {count} of {failed} {say('failure', failed)}",
            (part, name, 100 * count / most, count),
        )
        for part, (name, count) in enumerate(zip(findings.part_names, counts, strict=True))
    ]
    return _Card("part", f"{title}, in {failed:,} {say('failure', failed)}", lines)


def _pair_card(findings: Findings, lab: LabState, workspace: Workspace) -> _Card:
    confusions, chosen = state.confusions(findings, lab), _label(lab, "pair")
    lines = []
    for confusion in confusions[:_MAX_PAIRS]:
        names = state.place_names(findings, confusion)
        tiles = int(findings.outcomes.true[confusion.queries[0]]), confusion.tile
        shown = [
            findings.task.gallery[tile].title if tile >= 0 else name for tile, name in zip(tiles, names, strict=True)
        ]
        pictures = [workspace.thumbnail(findings.task.gallery[tile]) if tile >= 0 else "" for tile in tiles]
        lines.append(
            _Line(
                "lab-pair",
                [confusion.place, confusion.answered],
                " taken for ".join(names) == chosen,
                f"{shown[1]} was the answer to {confusion.count} {say('query', confusion.count)} of {shown[0]}",
                (shown, pictures, confusion.count),
            )
        )
    listed = f"; the first {_MAX_PAIRS} of {len(confusions):,}" if len(confusions) > _MAX_PAIRS else ""
    return _Card("pair", f"Places taken for others{listed}", lines)


def _hub_card(findings: Findings, lab: LabState, workspace: Workspace) -> _Card:
    hubs, chosen, task = state.hubs(findings, lab), _label(lab, "hub"), findings.task
    lines = [
        _Line(
            "lab-hub",
            hub.tile,
            state.hub_label(findings, hub.tile) == chosen,
            f"The answer to {len(hub.queries)} {say('query', len(hub.queries))} of {hub.places} other places",
            (task.gallery[hub.tile].name, _tile_picture(findings, workspace, hub.tile), hub.places, len(hub.queries)),
        )
        for hub in hubs[:_MAX_TILES]
    ]
    listed = f"; the first {_MAX_TILES} of {len(hubs):,}" if len(hubs) > _MAX_TILES else ""
    what = "Hubs: tiles that answer queries" if not plain() else "Favourites: answers to pictures"
    return _Card("hub", f"{what} of several other places{listed}", lines)


def _alike_card(findings: Findings, lab: LabState, workspace: Workspace) -> _Card:
    task, chosen, lines = findings.task, _label(lab, "alike"), []
    for pair in _near_duplicates(task):
        apart = _apart(task, pair)
        names = [task.gallery[tile].name for tile in pair.tiles]
        pictures = [_tile_picture(findings, workspace, tile) for tile in pair.tiles]
        lines.append(
            _Line(
                "lab-alike",
                list(pair.tiles),
                state.alike_label(findings, pair.tiles) == chosen,
                f"The cosine of the descriptors of these tiles is {pair.cosine:.3f}{apart and f'; they are {apart} apart'}",
                (names, pictures, pair.cosine, apart),
            )
        )
    return _Card("alike", "Near-duplicates: pictures of two places that look alike to the model", lines)


@lru_cache(maxsize=4)
def _near_duplicates(task: Task) -> list[NearDuplicate]:
    return near_duplicates.near_duplicates(task.sides()[1], task.gallery_labels, _MAX_TILES, task.weights)


def _apart(task: Task, pair: NearDuplicate) -> str:
    """Return the distance of two tiles on the ground in words; empty if it is not known."""
    if task.geometry is None:
        return ""
    one, other = task.geometry.ground[list(pair.tiles)]
    metres = float(np.hypot(*(one - other)))
    return f"{metres:,.0f} m" if np.isfinite(metres) else ""


def _tile_picture(findings: Findings, workspace: Workspace, tile: int) -> str:
    gallery = findings.task.gallery
    return workspace.thumbnail(gallery[tile]) if tile < len(gallery) else ""


def _rate_card(findings: Findings, lab: LabState, column: Column, rates: list[Rate]) -> _Card:
    outcomes = findings.graded
    overall = int(outcomes.failed.sum()) / max(int(outcomes.known.sum()), 1)
    chosen = _label(lab, state.selection_kind(column))
    lines = []
    for index, rate in enumerate(rates[:_MAX_VALUES]):
        low, high = (f"{100 * end:.0f}" for end in rate.interval)
        failed = f"{rate.failures} of {rate.queries} {say('query', rate.queries)} failed"
        hint = f"{rate.name}: {failed}; 95 % interval {low} to {high} %"
        value = [column.name, index, rate.name]
        word = PLAIN_VERDICTS.get(rate.name, rate.name) if column.name == "verdict" and plain() else rate.name
        content = (word, _rate_bar(rate, overall), rate.share)
        lines.append(_Line("lab-bin", value, f"{column.name} {rate.name}" == chosen, hint, content))
    name = column_name(column.name)
    listed = f"; {_MAX_VALUES} of {len(rates)} values" if len(rates) > _MAX_VALUES else ""
    count = sum(rate.queries for rate in rates)
    queries = f"{'all ' if count == len(findings.table) else ''}{count:,} {say('query', count)}"
    return _Card("rate", f"{capitalised(say('failure', 2))} by {name}, of {queries}{listed}", lines, column.about)


def _rate_bar(rate: Rate, overall: float) -> _RateBar:
    low, high = rate.interval
    return _RateBar(100 * rate.share, 100 * overall, 100 * low, max(100 * (high - low), 0.5))


def _label(lab: LabState, kind: str) -> str | None:
    """Return the label of the selection of a kind, None if there is none."""
    return next((selection.label for selection in lab.selections if selection.kind == kind), None)
