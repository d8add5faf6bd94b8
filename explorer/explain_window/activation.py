"""The tab "Heatmaps": the activation of each part as a heatmap of its own, for query and tile."""

from __future__ import annotations

import json

import numpy as np
from markupsafe import Markup

from explorer import judge
from explorer.stage.pictures import draw_parts
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.drawing import heatmaps
from lpn.drawing.heatmaps import PictureActivation
from lpn.drawing.words import say
from lpn.explain.part_activation import part_activation
from lpn.retrieval import DescribedPicture

_SIZE = 360, 900


def page(analysis: StateAnalysis, workspace: Workspace, true_tile: DescribedPicture | None = None) -> str:
    """Render the tab; without cells it says why there is no activation.

    Args:
        true_tile: shown as a third row.
    """
    task, state = analysis.task, analysis.state
    rows = [(say("query"), analysis.query, task.query_view), (say("tile"), analysis.tile, task.gallery_view)]
    if true_tile is not None:
        rows.append((judge.judged_piece(analysis, workspace) or say("positive"), true_tile, task.gallery_view))
    pictures = []
    for name, described, view in rows:
        if described.trace is not None:
            maps = part_activation(described.trace)
            pictures.append(PictureActivation(name, maps, draw_parts(workspace, described, view, _SIZE)))
    return render(
        "explain/activation",
        heatmaps=heatmaps.draw(pictures, workspace.part_names, state.same_scale, _attributes, state.heat_over)
        if pictures
        else None,
        same_scale=state.same_scale,
        over=state.heat_over,
        note=heatmaps.note(len(workspace.part_names)),
        without_cells=workspace.without_cells,
    )


def _attributes(picture: PictureActivation, part: int) -> Markup:
    """Make a heatmap show the value of the cell under the mouse."""
    maps = picture.maps[part]
    cells = [None if np.isnan(value) else float(f"{value:.6g}") for value in maps.ravel().tolist()]
    return Markup(
        'data-size="{},{}" data-cells="{}" onpointermove="lpn.value(this,event)" onpointerdown="lpn.value(this,event)" '
        'onmouseleave="lpn.value(this,event)"'
    ).format(*maps.shape, json.dumps(cells, separators=(",", ":")))
