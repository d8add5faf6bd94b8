"""One picture of the compared pair with what a state lays over it: heatmap or evidence, and the borders of the parts."""

from __future__ import annotations

from explorer.session_state import HeatKind
from explorer.workspace import StateAnalysis, Workspace
from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.drawing import overlays
from lpn.drawing.part_areas import PartAreas
from lpn.retrieval import scoring


def heat_kind(analysis: StateAnalysis) -> HeatKind | None:
    """Return which heatmap lies over the pair; None without one."""
    state = analysis.state
    if not state.heat or state.map:
        return None
    if state.heat_kind == "evidence" and analysis.pair_evidence is not None:
        return "evidence"
    return None if analysis.query.activation is None else "activation"


def draw(workspace: Workspace, analysis: StateAnalysis, side: int, areas: PartAreas | None) -> UInt8Array:
    """Draw the query (side 0) or the compared tile (side 1) at the size of the stage, (H, W, 3) uint8.

    Args:
        areas: of the picture's parts.
    """
    state, view = analysis.state, analysis.task.views[side]
    described = (analysis.query, analysis.tile)[side]
    picture = images.resize(workspace.as_partitioned(described.picture, view), *workspace.layout.pixels)
    kind = heat_kind(analysis)
    if kind == "evidence" and analysis.pair_evidence is not None:
        maps = analysis.pair_evidence.evidence.cell_maps(state.heat_part)
        picture = overlays.with_evidence(picture, maps[side], overlays.evidence_limit(*maps), state.opacity)
    elif kind is not None and described.activation is not None:
        part, activation, inside = state.heat_part, described.activation, None
        if part is not None and areas is not None:
            inside = areas.mask(part, picture.shape[:2])
            trace = described.trace
            activation = activation if trace is None else scoring.activation(trace.activation_of(part))
        # A part without a cell has no place to show.
        if inside is None or inside.any():
            picture = overlays.with_heat(picture, activation, inside, state.opacity)
    return overlays.with_parts(picture, areas, 3, state.parts_off) if state.rings else picture
