"""Search by a part of the query that is painted with the mouse, as html."""

from __future__ import annotations

import json

from explorer.web.render import send
from explorer.workspace import StateAnalysis, Workspace
from lpn.core import images
from lpn.drawing import overlays

_HEIGHT = 460


def page(analysis: StateAnalysis, workspace: Workspace) -> str:
    """The whole tab: the query to paint on, and what a search by painted cells means."""
    view = analysis.task.query_view
    rows, columns = workspace.map_sizes[view]
    width = round(_HEIGHT * workspace.layout.picture[0] / workspace.layout.picture[1])
    picture = images.resize(workspace.cut(analysis.query.picture, view), _HEIGHT, min(width, 1200))
    drawn = overlays.with_rings(picture, workspace.spec.partition(view), (rows, columns), 2)
    painted = [cell for cell in analysis.state.region if cell < rows * columns]
    held = set(painted)
    marks = "".join(
        f"<i class='paint' data-cell='{cell}' style='left:{100 * (cell % columns) / columns:.3f}%;"
        f"top:{100 * (cell // columns) / rows:.3f}%;width:{100 / columns:.3f}%;height:{100 / rows:.3f}%;"
        f"opacity:{int(cell in held)}'></i>"
        for cell in range(rows * columns)
    )
    if painted:
        said = (
            f"The ranking is by {len(painted)} of {rows * columns} cells alone: tiles are ordered by what these cells add to "
            "their scores, exactly. Distances are between what the cells describe and each whole tile, so they are larger."
        )
        clear = f"<a {send('region', [])}>Search by the whole query again</a>"
    else:
        said = "Paint what you care about: press and draw over cells; start on a painted cell to erase. The ranking follows."
        clear = ""
    wide = " wide" if workspace.layout.stacked else ""
    return (
        f"<div class='lpn' id='lpn-region' data-painted='{len(painted)}'><div class='said headline'>{said}</div>"
        f"<div class='chips'>{clear}</div>"
        f"<div class='lpn-map canvas{wide}' data-size='{rows},{columns}' data-painted='{json.dumps(painted)}' "
        "onpointerdown='lpn.stroke(this,event)' onpointermove='lpn.stroke(this,event)' onpointerup='lpn.stroke(this,event)' "
        f"onpointercancel='lpn.stroke(this,event)'><img src='{overlays.data_uri(drawn, 88)}' alt='the query' draggable='false'>"
        f"{marks}</div></div>"
    )


STYLE = (
    "<style>.lpn-map.canvas{max-width:520px;margin:auto;touch-action:none}.lpn-map.canvas.wide{max-width:none}</style>"
)
