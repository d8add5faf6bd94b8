"""The tab "Why": the evidence of the compared pair as two pictures with a linked cursor, and bars for each part."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from explorer.stage.pictures import draw_parts
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import Float64Array, FloatingArray
from lpn.core.views import View
from lpn.drawing import charts, overlays, verdicts
from lpn.explain import Correspondences
from lpn.models.partition import PartBox
from lpn.retrieval import DescribedPicture

_SIZE = 300, 1000


@dataclass(frozen=True)
class _Map:
    """One picture with its cells, and the values that the page's script shows for each."""

    name: str
    rows: int
    columns: int
    cells: list[float]
    correspondences: list[int]
    terms: list[float]
    picture: str
    boxes: list[PartBox]


def page(analysis: StateAnalysis, workspace: Workspace) -> str:
    """Render the tab; without cells it says why there is no evidence."""
    pair = analysis.pair_evidence
    if pair is None or pair.correspondences is None:
        reason = analysis.task.gallery[analysis.chosen.index].missing
        return render(
            "explain/evidence",
            evidence=None,
            without_cells=workspace.without_cells,
            network=workspace.model is not None,
            reason=reason,
            part_names=workspace.part_names,
        )
    evidence, part = pair.evidence, analysis.state.heat_part
    views = (analysis.task.query_view, analysis.task.gallery_view)
    cells = evidence.cell_maps(part)
    limit = overlays.evidence_limit(*cells)
    cosines, taken = verdicts.rounded_cosines(evidence.weighted_cosines.tolist(), evidence.csls_shares)
    sides = zip(("query", "tile"), (analysis.query, analysis.tile), views, cells, pair.correspondences, strict=True)
    return render(
        "explain/evidence",
        evidence=evidence,
        sentence=verdicts.describe_evidence(evidence, workspace.part_names, *views),
        weighted_cosines=[*cosines, *taken],
        region=analysis.state.region,
        stacked=workspace.layout.stacked,
        maps=[_map(workspace, limit, *side) for side in sides],
        part=part,
        part_names=workspace.part_names,
        bars=charts.evidence_bars(evidence, charts.evidence_span([evidence])),
        limit=limit,
        scale=overlays.data_uri(overlays.evidence_scale(200, 12), 95),
        evidence_colours=charts.EVIDENCE_COLOURS,
        claim=analysis.task.contract.claim,
        lumps=verdicts.describe_lumps(_lumps(analysis, workspace)),
    )


def _lumps(analysis: StateAnalysis, workspace: Workspace) -> list[str]:
    areas = workspace.areas(analysis.task.query_view, analysis.query)
    return [] if areas is None else [workspace.part_names[part] for part in areas.lumps]


def _map(
    workspace: Workspace,
    limit: float,
    name: str,
    described: DescribedPicture,
    view: View,
    cells: Float64Array,
    correspondences: Correspondences,
) -> _Map:
    rows, columns = cells.shape
    return _Map(
        name,
        rows,
        columns,
        _rounded(cells),
        correspondences.cells.tolist(),
        _rounded(correspondences.terms),
        overlays.data_uri(draw_parts(workspace, described, view, _SIZE, cells, limit), 88),
        [] if (areas := workspace.areas(view, described)) is None else areas.outlines,
    )


def _rounded(values: FloatingArray) -> list[float]:
    return [round(value, 5) for value in np.ravel(values).tolist()]
