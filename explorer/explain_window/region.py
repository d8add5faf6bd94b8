"""The tab "Search by a region": the query to paint cells on, and what a search by painted cells means."""

from __future__ import annotations

from explorer.stage.pictures import draw_parts
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.drawing import overlays

_SIZE = 460, 1200


def page(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Render the tab."""
    view = analysis.task.query_view
    rows, columns = workspace.map_sizes[view]
    return render(
        "explain/region",
        rows=rows,
        columns=columns,
        painted=[cell for cell in analysis.state.region if cell < rows * columns],
        picture=overlays.data_uri(draw_parts(workspace, analysis.query, view, _SIZE), 88),
        without_cells=workspace.without_cells,
        claim=analysis.task.contract.claim,
        stacked=workspace.layout.stacked,
    )
