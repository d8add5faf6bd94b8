"""The section of a report about one query."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain

from markupsafe import Markup

from lpn.analysis.task import Task
from lpn.core import images
from lpn.core.arrays import FloatingArray, UInt8Array
from lpn.drawing import charts, overlays, verdicts
from lpn.report._rendering import render, thumbnail
from lpn.report.cases import Case, Pair

# Widths of pictures in pixels; panoramas, which are stacked, are twice as wide.
_LARGE, _MAP = 280, 220
# A picture of at least this ratio of width to height is a panorama.
_PANORAMA = 2.0
_CHART_WIDTH = 940


@dataclass(frozen=True)
class _Tile:
    """One of the two tiles that the query is compared with."""

    verdict: bool | None
    role: str
    name: str
    rank: int
    distance2: float
    picture: str


@dataclass(frozen=True)
class _Match:
    """One line of the nearest tiles; `gap` where ranks are left out above it."""

    verdict: bool | None
    rank: int
    name: str
    thumbnail: str
    shares: Markup
    distance2: float
    gap: bool


@dataclass(frozen=True)
class _PairEvidence:
    """The evidence of one pair: both maps with their labels, and each part's bar and contribution."""

    score: float
    sentence: str
    maps: list[tuple[str, str]]
    bars: list[tuple[Markup, float]]


@dataclass(frozen=True)
class _Evidence:
    """The evidence of all pairs to one scale: `limit` is the largest value of a cell."""

    pairs: list[tuple[_Tile, _PairEvidence]]
    limit: float
    scale: str


@dataclass(frozen=True)
class _Step:
    """One part's line of the margin; `ranks` of the positive without the part and by it alone."""

    cosines: tuple[float, float]
    step: Markup
    ranks: tuple[int | str | None, int | str | None]


@dataclass(frozen=True)
class _Margin:
    """The margin of the positive over the negative; `ranked` where its ranks without parts are known."""

    names: tuple[str, str]
    rows: list[_Step]
    ranked: bool


def section(case: Case, task: Task, number: int) -> Markup:
    """Render everything about one query."""
    tiles = [_tile(case, pair, task) for pair in case.pairs]
    headline, reason = summary(case, task)
    return render(
        "query.html.j2",
        number=number,
        name=case.name,
        verdict=case.verdict,
        headline=headline,
        sentences=[reason, *_sentences(case, task)],
        facts=case.facts,
        views=task.views,
        part_names=task.part_names,
        wide=_is_panorama(task),
        picture=_with_parts(case.picture, task, 0),
        tiles=tiles,
        matches=_matches(case, task),
        metres=case.metres,
        evidence=_evidence(case, tiles, task) if all(pair.evidence for pair in case.pairs) else None,
        margin=_margin(case, task),
        profile=case.profile and charts.profile_charts(case.profile, task.part_names, _CHART_WIDTH),
        followed=case.profile and _followed(case.profile.points[0].tile, case.profile.points[0].true, task),
    )


def summary(case: Case, task: Task) -> tuple[str, str]:
    """Return the headline of a case and the sentence that gives its reason."""
    if not case.known:
        gap = case.matches[0].gap
        apart = "there is no other tile" if gap is None else f"the next tile is {gap:.3f} further away (d²)"
        return "Nearest tile", f"Its true place is not known here; {apart}."
    metres = None if case.metres is None else case.metres[0]
    return verdicts.verdict(case.matches[0], case.positive, case.hardest_negative, task.part_names, metres)[1:]


def _sentences(case: Case, task: Task) -> list[str]:
    sentences = []
    if case.without is not None:
        sentences.append(verdicts.describe_ablation(case.without, task.part_names))
    if case.positive is not None and case.positive.rank > 1:
        sentences.append(verdicts.describe_reweighting(case.change, case.effect))
    if case.profile is not None:
        sentences.append(verdicts.describe_rotation(case.profile, task.views))
    return sentences


def _followed(tile: int, true: bool | None, task: Task) -> str:
    return "the true tile" if true else f"tile {task.gallery[tile].name}"


def _tile(case: Case, pair: Pair, task: Task) -> _Tile:
    match = pair.match
    picture = _with_parts(pair.picture, task, 1)
    name = task.gallery[match.index].name
    return _Tile(match.true, _role(case, pair), name, match.rank, match.distance2, picture)


def _role(case: Case, pair: Pair) -> str:
    """Name the part that a tile plays in the comparison."""
    match = pair.match
    if match.rank == 1:
        return {True: "Top match, the true tile", False: "Top match, wrong", None: "Top match"}[match.true]
    if match.true is None:
        return "Tile looked at"
    if match.true:
        return (
            "The true tile" if case.positive is not None and match.index == case.positive.index else "Another true tile"
        )
    return (
        "Best wrong tile"
        if case.hardest_negative is not None and match.index == case.hardest_negative.index
        else "A wrong tile"
    )


def _matches(case: Case, task: Task) -> list[_Match]:
    """Make a line for each of the nearest tiles, with bars to one scale."""
    full = max(match.distance2 for match in case.matches)
    above = [case.matches[0].rank - 1, *(match.rank for match in case.matches)]
    return [
        _Match(
            match.true,
            match.rank,
            task.gallery[match.index].name,
            thumbnail(images.load_picture(task.gallery[match.index].path)),
            charts.share_bar(match.shares, full, task.part_names),
            match.distance2,
            match.rank > last + 1,
        )
        for last, match in zip(above, case.matches, strict=False)
    ]


def _evidence(case: Case, tiles: Sequence[_Tile], task: Task) -> _Evidence:
    found = [pair.evidence for pair in case.pairs if pair.evidence is not None]
    maps = [one.cell_maps() for one in found]
    limit = overlays.evidence_limit(*chain(*maps))
    span = charts.evidence_span(found)

    pairs = []
    for tile, pair, one, cells in zip(tiles, case.pairs, found, maps, strict=True):
        drawn = [
            (_with_evidence(case.picture, cells[0], limit, task, 0), "query"),
            (_with_evidence(pair.picture, cells[1], limit, task, 1), f"tile {tile.name}"),
        ]
        bars = list(zip(charts.evidence_bars(one, span), one.contributions.tolist(), strict=True))
        sentence = verdicts.describe_evidence(one, task.part_names, *task.views)
        pairs.append((tile, _PairEvidence(one.score, sentence, drawn, bars)))
    return _Evidence(pairs, limit, overlays.data_uri(overlays.evidence_scale(240, 20), 90))


def _margin(case: Case, task: Task) -> _Margin | None:
    """Make a line for each part of the margin, and one for their sum."""
    if case.margin is None:
        return None
    pair = case.margin.positive, case.margin.negative
    cosines, scores = case.ranking.cosines, case.ranking.scores
    steps = charts.waterfall(case.margin.parts)
    rows = []
    for part in range(len(task.part_names)):
        ranks: tuple[int | None, int | None] = (None, None)
        if case.without is not None:
            without, alone = case.without.without[part], case.without.alone[part]
            ranks = without.rank if without else None, alone.rank if alone else None
        rows.append(_Step((cosines[pair[0]][part], cosines[pair[1]][part]), steps[part], ranks))
    now = case.without.now.rank if case.without is not None else None
    rows.append(_Step((scores[pair[0]], scores[pair[1]]), steps[-1], (now, "")))
    names = task.gallery[pair[0]].name, task.gallery[pair[1]].name
    return _Margin(names, rows, case.without is not None)


def _with_parts(picture: UInt8Array, task: Task, side: int) -> str:
    view = task.views[side]
    shown = images.resize(picture, *_size(task, _LARGE))
    return overlays.data_uri(overlays.with_rings(shown, task.spec.partition(view), task.map_sizes[view]), 70)


def _with_evidence(picture: UInt8Array, cells: FloatingArray, limit: float, task: Task, side: int) -> str:
    shown = overlays.with_evidence(images.resize(picture, *_size(task, _MAP)), cells, limit)
    return overlays.data_uri(overlays.with_rings(shown, task.spec.partition(task.views[side]), cells.shape), 66)


def _size(task: Task, width: int) -> tuple[int, int]:
    """Return the height and width at which a picture is shown."""
    height, across = task.spec.input_size
    width = 2 * width if _is_panorama(task) else width
    return max(1, round(width * height / across)), width


def _is_panorama(task: Task) -> bool:
    height, width = task.spec.input_size
    return width >= _PANORAMA * height
