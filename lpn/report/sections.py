"""The section of a report about one query."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, groupby
from typing import NamedTuple

import numpy as np
from markupsafe import Markup

from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.numbers import rounded_to_sum, shown_difference
from lpn.drawing import charts, overlays, verdicts
from lpn.drawing.part_areas import PartAreas
from lpn.report._rendering import render
from lpn.report.cases import Case, Seen
from lpn.retrieval import Match
from lpn.tasks.task import Task

# Pixels of a picture's height.
_HIGH = 320
# Largest ratio of a crop's width to its height; a whole strip looks thin.
_MOST_WIDE = 2.5


class _Outline(NamedTuple):
    """A part of a picture 100 units high: its cells as a path, the box of its crop, and its strongest cell."""

    path: str
    left: float
    top: float
    width: float
    height: float
    strongest: tuple[float, float, float, float] | None


@dataclass(frozen=True)
class _Picture:
    """A picture of the section.

    Attributes:
        title, name: its kind, and its name.
        true: whether a tile is right; None for the query, and if that is unknown.
        source: the picture as a data URI.
        width: in hundredths of its height.
        heat: colours of its cells, a data URI; empty without cells.
        straight: whether the boxes are the borders of the parts.
    """

    title: str
    name: str
    true: bool | None
    source: str
    width: float
    heat: str
    parts: list[_Outline]
    straight: bool


@dataclass(frozen=True)
class _PairEvidence:
    """The evidence of a pair: colours of the cells of query and tile as PNG, a sentence, and a bar for each part."""

    cells: tuple[str, str]
    sentence: str
    weighted: list[float]
    bars: list[Markup]
    score: float


class _Row(NamedTuple):
    """The shares of a part in the distances of the compared tiles, and the gain of the first tile over the second."""

    shares: list[float]
    gain: float | None
    prefers: bool | None


def section(case: Case, number: int) -> Markup:
    """Render everything about one query."""
    answer = case.answer
    task, names, noun = answer.task, answer.task.part_names, answer.task.contract.part_noun
    longest = max(match.distance2 for match in case.matches)
    ranks_above = [case.matches[0].rank - 1, *(match.rank for match in case.matches)]
    return render(
        "query.html.j2",
        number=number,
        case=case,
        task=task,
        noun=noun,
        headline=answer.verdict.headline,
        sentences=[reason(case), *_sentences(case)],
        pictures=[
            _picture(case.query, f"Photo, {task.views[0]}", answer.name, None, task),
            *(
                _picture(tile, _role(case, match), task.gallery[match.index].name, match.true, task)
                for tile, match in ((tile, tile.match) for tile in case.tiles)
                if match is not None
            ),
        ],
        rows=_rows(case),
        full=_full(case),
        matches=[
            (match, charts.share_bar(match.contributions, longest, names), match.rank > above + 1)
            for above, match in zip(ranks_above, case.matches, strict=False)
        ],
        evidence=_evidence(case),
        limit=_limit(case),
        lumps=verdicts.describe_lumps(
            [names[part] for part in case.query.areas.lumps] if case.query.areas else [], noun
        ),
        without_cells="" if task.model is None or task.contract.has_cells else verdicts.no_cells(task.contract),
    )


def reason(case: Case) -> str:
    """Return the sentence that gives the headline's reason."""
    said = case.answer.verdict
    if said.sign is not None:
        return said.sentence
    why = "It is not graded, as no tile is right for certain" if case.doubtful else "Its true place is not known here"
    return f"{why}. {said.sentence}"


def _sentences(case: Case) -> list[str]:
    pair = case.comparison
    if len(case.answer.task.part_names) == 1 or pair is None or pair.followed.rank == 1:
        return []
    return [verdicts.describe_reweighting(pair.weights, case.effect, case.answer.task.contract.part_noun)]


def _role(case: Case, match: Match) -> str:
    """Name the role of a tile in the comparison."""
    if match.rank == 1:
        return "Answer"
    if match.true is None:
        return "Next tile" if match.rank == 2 else "Chosen tile"
    positive, negative = case.answer.positive, case.answer.ranking.hardest_negative()
    if match.true:
        return "Truth" if positive and match.index == positive.index else "Another true tile"
    return "Nearest wrong tile" if negative and match.index == negative.index else "Wrong tile"


def _picture(seen: Seen, title: str, name: str, true: bool | None, task: Task) -> _Picture:
    """Encode a picture once; the page crops its parts from it."""
    height, width = task.contract.input_size
    across, areas = 100 * width / height, seen.areas
    picture = images.resize(seen.picture, _HIGH, round(_HIGH * width / height))
    straight = areas is None or areas.straight
    source = overlays.data_uri(picture if straight else overlays.with_parts(picture, areas), 70)
    heat = "" if seen.heat is None else overlays.png_data_uri(overlays.heat_colours(seen.heat))
    parts = [] if areas is None else [_outline(areas, part, across, seen.heat) for part in range(len(areas.inside))]
    return _Picture(title, name, true, source, across, heat, parts, straight)


def _outline(areas: PartAreas, part: int, across: float, heat: Float32Array | None) -> _Outline:
    inside = areas.labels == part
    rows, columns = inside.shape
    x, y, strongest = across / columns, 100 / rows, None
    if heat is not None and inside.any():
        row, column = divmod(int(np.argmax(np.where(inside, images.enlarge(heat, rows, columns), -1))), columns)
        strongest = column * x, row * y, x, y
    left, top, right, bottom = areas.boxes[part]
    width, height = (right - left) * across, 100 * (bottom - top)
    cut = max(width - _MOST_WIDE * height, 0)
    path = _path(inside.tobytes(), rows, columns, across)
    return _Outline(path, left * across + cut / 2, 100 * top, width - cut, height, strongest)


@lru_cache(maxsize=256)
def _path(inside: bytes, rows: int, columns: int, across: float) -> str:
    """Return cells as an SVG path: the runs of each row, joined with equal rows below."""
    path, x, y, top = "", across / columns, 100 / rows, 0
    for alike, cells in groupby(inside[row * columns : (row + 1) * columns] for row in range(rows)):
        height = len(list(cells))
        edges = np.flatnonzero(np.diff(np.frombuffer(alike, np.int8), prepend=0, append=0)).tolist()
        for begin, end in zip(edges[::2], edges[1::2], strict=True):
            wide = (end - begin) * x
            path += f"M{begin * x:.4g} {top * y:.4g}h{wide:.4g}v{height * y:.4g}h{-wide:.4g}z"
        top += height
    return path


def _rows(case: Case) -> list[_Row]:
    """Return a row for each part, and one for the sum; the gains add up to the difference of the displayed distances."""
    matches = [tile.match for tile in case.tiles if tile.match is not None]
    shares = [rounded_to_sum(match.contributions.tolist(), total=round(match.distance2, 3)) for match in matches]
    sums = [match.distance2 for match in matches]
    if len(matches) == 1:
        return [_Row([share], None, None) for share in (*shares[0], *sums)]
    first, rival = matches
    lead = shown_difference(rival.distance2, first.distance2)
    gains = rounded_to_sum((rival.contributions - first.contributions).tolist(), total=lead)
    rows = zip([*map(list, zip(*shares, strict=True)), sums], [*gains, lead], strict=True)
    return [_Row(each, gain, None if first.true is None else (gain > 0) == first.true) for each, gain in rows]


def _full(case: Case) -> float:
    """Return the value at the end of the bars of shares: the largest share, rounded up to tenths."""
    shares = [tile.match.contributions.max() for tile in case.tiles if tile.match is not None]
    return max(math.ceil(round(10 * float(max(shares)), 6)), 1) / 10


def _limit(case: Case) -> float:
    """Return the common end of the colour scale of all pairs' maps; 0 without cells."""
    maps = list(chain(*(tile.evidence.cell_maps() for tile in case.tiles if tile.evidence)))
    return overlays.evidence_limit(*maps) if maps else 0.0


def _evidence(case: Case) -> list[_PairEvidence]:
    """Draw the evidence of each pair; none without cells."""
    limit, task = _limit(case), case.answer.task
    pairs = [tile.evidence for tile in case.tiles if tile.evidence]
    span, drawn = charts.evidence_span(pairs), []
    for values in pairs:
        query, tile = (
            overlays.png_data_uri(overlays.heat_colours(cells / limit, signed=True)) for cells in values.cell_maps()
        )
        sentence = verdicts.describe_evidence(values, task.part_names, *task.views, task.contract.part_noun)
        weighted = rounded_to_sum(values.weighted_cosines.tolist())
        bars = charts.evidence_bars(values, span)
        drawn.append(_PairEvidence((query, tile), sentence, weighted, bars, values.score))
    return drawn
