"""Pictures of the compared pair with parts and evidence, for HTML."""

from __future__ import annotations

import numpy as np

from explorer.workspace import StateAnalysis, Workspace
from lpn import explain
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.core.views import View
from lpn.drawing import overlays, theme
from lpn.drawing.theme import Colour
from lpn.retrieval import DescribedPicture

# Opacity of a heatmap of activation where it is strongest.
_OPACITY = 0.85


def draw_parts(
    workspace: Workspace,
    described: DescribedPicture,
    view: View,
    size: tuple[int, int],
    cells: Float64Array | None = None,
    limit: float = 1.0,
    colours: tuple[Colour, Colour] | None = None,
    heat: Float32Array | None = None,
) -> UInt8Array:
    """Draw a picture's parts, and its evidence where `cells` (h, w) are given: (H, W, 3) uint8.

    Args:
        size: height, and the largest width of a panorama.
        limit: absolute value of a cell at which the colour of evidence is opaque.
        colours: `cells` are a lead, whose strong ones are painted in these, see `overlays.with_lead`.
        heat: activation (h, w) from 0 to 1 to draw in place of evidence.
    """
    across, down = workspace.layout.picture
    height, max_width = size
    drawn = images.resize(
        workspace.as_partitioned(described.picture, view), height, min(round(height * across / down), max_width)
    )
    if cells is not None and colours is not None:
        drawn = overlays.with_lead(drawn, cells, colours)
    elif cells is not None:
        drawn = overlays.with_evidence(drawn, cells, limit)
    elif heat is not None:
        drawn = overlays.with_heat(drawn, heat, None, _OPACITY)
    return overlays.with_parts(drawn, workspace.areas(view, described))


def lead_cells(analysis: StateAnalysis, leader: int, follower: int) -> Float64Array | None:
    """Return each cell's share, on the query's side, of the lead of one tile over another in d², part by part: (n, h, w).

    The constants of both tiles are spread over the cells of their parts, see `explain.spread_constants`, so that the cells of a
    part add up to its term of the lead. Parts without cells, and what CSLS subtracts for both tiles, have no place. None without
    a network, and while only some cells of the query are searched by.

    Args:
        leader, follower: positions in the gallery; positive cells speak for the leader.
    """
    if analysis.state.region or analysis.query.trace is None:
        return None
    trace = analysis.query.trace
    ahead, behind = (
        explain.spread_constants(explain.side_evidence(trace, analysis.task.gallery_descriptors[index]), trace)
        for index in (leader, follower)
    )
    return 2 * analysis.ranking.weights.astype(np.float64)[:, None, None] * (ahead - behind)


def no_place(analysis: StateAnalysis) -> str:
    """Return what of a lead comes from no cell, in words, see `lead_cells`; "" where all of it comes from cells."""
    trace, reasons = analysis.query.trace, []
    if trace is not None and not trace.cells.any(axis=(0, 2, 3)).all():
        reasons.append("what belongs to the picture as a whole")
    if analysis.task.neighbours:
        reasons.append("what re-ranking takes from pictures that look like many others")
    return " and ".join(reasons)


def lead_colours(sure: bool) -> tuple[Colour, Colour]:
    """Return the colours of what speaks for the leader, and for the follower.

    Args:
        sure: the leader is known to be true; the colours are then those of the frames of true and false tiles.
    """
    return (theme.TRUE_COLOUR, theme.FALSE_COLOUR) if sure else (theme.FOR, theme.AGAINST)
