"""The tab "True or wrong": the margin part by part, ranks without each part, and the smallest change of weights."""

from __future__ import annotations

from dataclasses import replace

from explorer import judge
from explorer.stage.pictures import draw_parts, lead_cells, lead_colours, no_place
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.analysis.comparison import Comparison
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.numbers import shown_difference
from lpn.core.texts import ordinal
from lpn.drawing import charts, overlays, theme, verdicts
from lpn.drawing.theme import Colour
from lpn.drawing.words import say
from lpn.explain.counterfactual import Effect

# Side of the pictures of the query and the two tiles, in pixels.
_SIZE = 176
# Height of the painted query, and the largest width of a panorama, in pixels.
_PAINTED = 300, 700


def page(
    analysis: StateAnalysis, workspace: Workspace, comparison: Comparison | None, effect: Effect | None, computing: bool
) -> str:
    """Render the tab.

    Args:
        comparison: None where the gallery has no two tiles to compare.
        effect: of the smallest change of weights on all queries; None before it is requested and computed.
        computing: the effect is being computed.
    """
    if comparison is None:
        return render("explain/comparison", comparison=None)
    ranking, followed, change = analysis.ranking, comparison.followed, comparison.change
    margin = ranking.gains(followed.index, comparison.other.index)
    total = shown_difference(comparison.other.distance2, followed.distance2)
    right = judge.judged_piece(analysis, workspace) or f"the {say('positive')}"
    names, name = workspace.part_names, right if followed.true else f"this {say('tile')}"
    of_parts = lead_cells(analysis, followed.index, comparison.other.index)
    cells = None if of_parts is None else of_parts.sum(axis=0)
    graded = judge.is_sure(analysis, workspace)
    tiles = [match if graded else replace(match, true=None) for match in (followed, comparison.other)]
    sure = graded and followed.true is True
    colours = lead_colours(sure)
    return render(
        "explain/comparison",
        comparison=comparison,
        tiles=tiles,
        query=_picture(analysis.query.picture),
        query_name=analysis.name,
        gallery=analysis.task.gallery,
        tile_picture=lambda index: _picture(workspace.card(analysis.task, index)),
        ordinal=ordinal,
        name=name,
        margin_sentence=verdicts.describe_margin(total, name),
        region=analysis.state.region,
        part_names=names,
        several=workspace.has_parts,
        steps=charts.waterfall(margin, sure, total),
        painted="" if cells is None else _painted(analysis, workspace, cells, colours),
        places=0.0 if cells is None else float(cells.sum()),
        total=total,
        no_place=no_place(analysis),
        swatches=[theme.css(colour) for colour in colours],
        weights=list(zip(ranking.weights, change.weights, strict=True)) if change else [],
        effect_sentence=_sentence(verdicts.describe_effect(effect)) if effect else "",
        computing=computing,
    )


def _painted(analysis: StateAnalysis, workspace: Workspace, cells: Float64Array, colours: tuple[Colour, Colour]) -> str:
    """Return the query with its parts, painted by its cells' shares (h, w) of the margin, as a data URI."""
    view = analysis.task.query_view
    return overlays.data_uri(draw_parts(workspace, analysis.query, view, _PAINTED, cells, colours=colours), 85)


def _picture(picture: UInt8Array) -> str:
    return overlays.data_uri(overlays.square(picture, _SIZE), 85)


def _sentence(clause: str) -> str:
    return f"{clause[0].upper()}{clause[1:]}."
