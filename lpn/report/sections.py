"""The section of a report about one query."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import chain

from markupsafe import Markup

from lpn.core import images
from lpn.core.arrays import FloatingArray, UInt8Array
from lpn.drawing import charts, heatmaps, overlays, verdicts
from lpn.drawing.heatmaps import PictureActivation
from lpn.drawing.part_areas import PartAreas
from lpn.explain import Evidence
from lpn.report._rendering import render, thumbnail
from lpn.report.cases import Case
from lpn.retrieval import Match
from lpn.tasks.task import Task

# Widths of pictures in pixels; panoramas, which are stacked, are twice as wide.
_LARGE, _MAP = 280, 220
# A picture of at least this ratio of width to height is a panorama.
_PANORAMA = 2.0
_CHART_WIDTH = 940


@dataclass(frozen=True)
class _PairEvidence:
    """The evidence of a pair: a sentence, the maps of query and tile, and a bar for each part."""

    values: Evidence
    sentence: str
    maps: tuple[str, str]
    bars: list[Markup]


def section(case: Case, number: int) -> Markup:
    """Render everything about one query."""
    task, ranking, pair = case.answer.task, case.answer.ranking, case.comparison
    headline, reason = summary(case)
    return render(
        "query.html.j2",
        number=number,
        case=case,
        task=task,
        headline=headline,
        sentences=[reason, *_sentences(case, task)],
        wide=_is_panorama(task),
        picture=_with_parts(case.picture, case.areas, task),
        tiles=[
            (pair.match, _role(case, pair.match), _with_parts(pair.picture, pair.areas, task)) for pair in case.pairs
        ],
        matches=_matches(case, task),
        evidence=_evidence(case, task),
        limit=_limit(case),
        claim=task.contract.claim,
        lumps=verdicts.describe_lumps([task.part_names[part] for part in case.areas.lumps] if case.areas else []),
        without_cells="" if task.model is None or task.contract.has_cells else verdicts.no_cells(task.contract),
        scale=overlays.data_uri(overlays.evidence_scale(240, 20), 90),
        heatmaps=_heatmaps(case, task),
        heatmaps_note=heatmaps.note(len(task.part_names)),
        steps=[]
        if pair is None
        else charts.waterfall(ranking.gains(pair.followed.index, pair.other.index), sum_shown=case.margin),
    )


def summary(case: Case) -> tuple[str, str]:
    """Return the headline of a case and the sentence that gives its reason."""
    said = case.answer.verdict
    if said.sign is not None:
        return said.headline, said.sentence
    why = "It is not graded, as no tile is right for certain" if case.doubtful else "Its true place is not known here"
    return said.headline, f"{why}. {said.sentence}"


def _sentences(case: Case, task: Task) -> list[str]:
    pair = case.comparison
    if len(task.part_names) == 1 or pair is None or pair.followed.rank == 1:
        return []
    return [verdicts.describe_reweighting(pair.change, case.effect)]


def _role(case: Case, match: Match) -> str:
    """Name the role of a tile in the comparison."""
    if match.rank == 1:
        return {True: "Top match, the true tile", False: "Top match, wrong", None: "Top match"}[match.true]
    if match.true is None:
        return "Tile looked at"
    if match.true:
        positive = case.answer.positive
        return "The true tile" if positive and match.index == positive.index else "Another true tile"
    negative = case.answer.ranking.hardest_negative()
    return "Best wrong tile" if negative and match.index == negative.index else "A wrong tile"


def _matches(case: Case, task: Task) -> list[tuple[Match, str, Markup, bool]]:
    """List the nearest tiles: match, thumbnail, bar to a common scale, and whether ranks are left out above it."""
    full = max(match.distance2 for match in case.matches)
    ranks_above = [case.matches[0].rank - 1, *(match.rank for match in case.matches)]
    return [
        (
            match,
            thumbnail(task.gallery[match.index].load()),
            charts.share_bar(match.contributions, full, task.part_names),
            match.rank > above + 1,
        )
        for above, match in zip(ranks_above, case.matches, strict=False)
    ]


def _limit(case: Case) -> float:
    """Return the end of the colour scale that the maps of all pairs share; 0 without a network."""
    maps = list(chain(*(pair.evidence.cell_maps() for pair in case.pairs if pair.evidence)))
    return overlays.evidence_limit(*maps) if maps else 0.0


def _evidence(case: Case, task: Task) -> list[_PairEvidence]:
    """Draw the evidence of each pair; the list is empty without a network."""
    limit, span = _limit(case), charts.evidence_span([pair.evidence for pair in case.pairs if pair.evidence])
    drawn = []
    for pair in case.pairs:
        if pair.evidence is not None:
            query_cells, tile_cells = pair.evidence.cell_maps()
            maps = (
                _with_evidence(case.picture, case.areas, query_cells, limit, task),
                _with_evidence(pair.picture, pair.areas, tile_cells, limit, task),
            )
            sentence = verdicts.describe_evidence(pair.evidence, task.part_names, *task.views)
            drawn.append(_PairEvidence(pair.evidence, sentence, maps, charts.evidence_bars(pair.evidence, span)))
    return drawn


def _heatmaps(case: Case, task: Task) -> Markup | None:
    """Draw the activation of each part of the query and of the first compared tile; None without a network."""
    pair = case.pairs[0]
    if pair.activation is None:
        return None
    drawn = _draw_parts(case.picture, case.areas, task), _draw_parts(pair.picture, pair.areas, task)
    pictures = [
        PictureActivation(name, maps, pixels)
        for name, maps, pixels in zip(("query", "tile"), pair.activation, drawn, strict=True)
    ]
    return heatmaps.draw(pictures, task.part_names)


def _with_parts(picture: UInt8Array, areas: PartAreas | None, task: Task) -> str:
    return overlays.data_uri(_draw_parts(picture, areas, task), 70)


def _draw_parts(picture: UInt8Array, areas: PartAreas | None, task: Task) -> UInt8Array:
    return overlays.with_parts(images.resize(picture, *_size(task, _LARGE)), areas)


def _with_evidence(picture: UInt8Array, areas: PartAreas | None, cells: FloatingArray, limit: float, task: Task) -> str:
    drawn = overlays.with_evidence(images.resize(picture, *_size(task, _MAP)), cells, limit)
    return overlays.data_uri(overlays.with_parts(drawn, areas), 66)


def _size(task: Task, width: int) -> tuple[int, int]:
    """Return the height and width at which a picture is shown."""
    height, across = task.contract.input_size
    width = 2 * width if _is_panorama(task) else width
    return max(1, round(width * height / across)), width


def _is_panorama(task: Task) -> bool:
    height, width = task.contract.input_size
    return width >= _PANORAMA * height
