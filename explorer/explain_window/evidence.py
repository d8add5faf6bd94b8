"""The evidence of the compared pair as html: both pictures with a cursor that is linked, and each part's sum as bars."""

from __future__ import annotations

import json
from collections.abc import Sequence
from html import escape

import numpy as np

from explorer.web.render import send
from explorer.web.style import part_ink
from explorer.workspace import StateAnalysis, Workspace
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.views import View
from lpn.drawing import overlays, verdicts
from lpn.explain import Correspondences, Evidence
from lpn.retrieval import DescribedPicture

HINT = "Move over a cell to see what it adds and which cell of the other picture it agrees with; click to keep it."
HELD = {"safa": " The weights of the cells, which SAFA chooses for each picture, are held as they are."}
NOTE = (
    "Exact: cells and constants add up to the score. It is an account of the score; what it would be were a region not there "
    "is another question."
)
_HEIGHT = 300


def maps(found: Evidence, part: int | None) -> tuple[tuple[Float64Array, Float64Array], float]:
    """What each cell of the query and of the tile adds to the score, all parts or one, and the end of the colour scale."""
    if part is None:
        shown = (found.query.total(found.weights), found.tile.total(found.weights))
    else:
        weight = float(found.weights[part])
        shown = (weight * found.query.cells[part], weight * found.tile.cells[part])
    return shown, max(float(np.abs(cells).max()) for cells in shown) or 1e-9


def page(analysis: StateAnalysis, workspace: Workspace) -> str:
    """The whole of the window's first tab; says what to do where there is no evidence."""
    if analysis.pair_evidence is None or analysis.pair_evidence.correspondences is None:
        return "<div class='lpn' id='lpn-why'>Evidence needs the network: open the data set with a model.</div>"
    found, task = analysis.pair_evidence.evidence, analysis.task
    part = analysis.state.heat_part
    shown, limit = maps(found, part)
    views = (task.query_view, task.gallery_view)
    said = verdicts.why(found, workspace.part_names, *views)
    blocks = "".join(
        _map(workspace, described, cells, limit, view, correspondences, name)
        for described, cells, view, correspondences, name in zip(
            (analysis.query, analysis.tile),
            shown,
            views,
            analysis.pair_evidence.correspondences,
            ("query", "tile"),
            strict=True,
        )
    )
    stacked = " stacked" if workspace.layout.stacked else ""
    region = (
        "<div>⚠ The search is by painted cells alone; this accounts for the whole query.</div>"
        if analysis.state.region
        else ""
    )
    report = f"<a {send('report')}>Save as a report (HTML)</a>"
    return (
        f"<div class='lpn' id='lpn-why'><div class='said headline'>{escape(said)}</div>{region}"
        f"<div class='lpn-pair{stacked}' data-hint='{escape(HINT)}'>{blocks}</div>"
        f"<div class='lpn-read num dim'>{escape(HINT)}</div>"
        f"{_chips(workspace.part_names, part)}{_bars(found, workspace.part_names)}{_legend(limit)}"
        f"<div class='dim'>{NOTE}{HELD.get(workspace.spec.pooling, '')}</div><div class='chips'>{report}</div></div>"
    )


def _map(
    workspace: Workspace,
    described: DescribedPicture,
    cells: Float64Array,
    limit: float,
    view: View,
    correspondences: Correspondences,
    name: str,
) -> str:
    rows, columns = cells.shape
    width = round(_HEIGHT * workspace.layout.picture[0] / workspace.layout.picture[1])
    picture = images.resize(workspace.cut(described.picture, view), _HEIGHT, min(width, 1000))
    drawn = overlays.with_evidence(picture, cells, limit)
    drawn = overlays.with_rings(drawn, workspace.spec.partition(view), (rows, columns), 2)
    data = {
        "cells": _rounded(cells),
        "correspondences": correspondences.cells.tolist(),
        "shares": _rounded(correspondences.shares),
    }
    held = " ".join(f"data-{key}='{json.dumps(value, separators=(',', ':'))}'" for key, value in data.items())
    return (
        f"<div class='lpn-map' data-side='{name}' data-size='{rows},{columns}' {held} onmousemove='lpn.hover(this,event)' "
        f"onmouseleave='lpn.leave(this)' onclick='lpn.hold(this,event)'>"
        f"<img src='{overlays.data_uri(drawn, 88)}' alt='{name} with its evidence' draggable='false'>"
        f"<span class='name'>{name}</span><i class='here'></i><i class='there'></i></div>"
    )


def _rounded(values: Float64Array | Float32Array) -> list[float]:
    return [round(float(value), 5) for value in np.asarray(values).reshape(-1)]


def _chips(names: Sequence[str], part: int | None) -> str:
    chips = [
        ("All parts", None, "inherit"),
        *((name, i, part_ink(i)) for i, name in enumerate(names)),
    ]
    return (
        "<div class='chips'>Show "
        + "".join(
            f"<a class='{'chosen' if value == part else ''}' style='color:{colour}' {send('part', value)}>{escape(name)}</a>"
            for name, value, colour in chips
        )
        + "</div>"
    )


def _bars(found: Evidence, names: Sequence[str]) -> str:
    """For each part what its cells add, what they take, and the constant, to one scale with zero in it; and their sum."""
    gains, losses, constants = found.sums
    high = float(np.max(gains + np.maximum(constants, 0)))
    low = float(np.min(losses + np.minimum(constants, 0)))
    scale = 100 / max(high - low, 1e-9)
    rows = []
    for part, name in enumerate(names):
        pieces, ends = [], [-low * scale, -low * scale]
        for value, colour, said in (
            (gains[part], overlays.FOR, "cells for"),
            (losses[part], overlays.AGAINST, "cells against"),
            (constants[part], overlays.UNKNOWN_COLOUR, "constant"),
        ):
            side, length = (1, float(value) * scale) if value >= 0 else (0, -float(value) * scale)
            left = ends[1] if side else ends[0] - length
            ends[side] += length if side else -length
            pieces.append(
                f"<i style='left:{left:.2f}%;width:{length:.2f}%;background:{overlays.css(colour)}' "
                f"title='{said} {value:+.4f}'></i>"
            )
        added = float(found.contributions[part])
        pieces.append(f"<b style='left:{(added - low) * scale:.2f}%' title='together {added:+.4f}'></b>")
        rows.append(
            f"<tr><td style='color:{part_ink(part)}'>{escape(name)}</td>"
            f"<td>{found.cosines[part]:+.3f}</td><td>{100 * found.weights[part]:.0f} %</td>"
            f"<td class='wide'><div class='sum'>{''.join(pieces)}<u style='left:{-low * scale:.2f}%'></u></div></td>"
            f"<td>{added:+.3f}</td></tr>"
        )
    return (
        "<table class='num sums'><tr class='dim'><th>part</th><th>cosine</th><th>weight</th><th>cells for, against, constant</th>"
        f"<th>adds</th></tr>{''.join(rows)}<tr><td>score</td><td></td><td></td><td></td><td><b>{found.score:+.3f}</b></td></tr></table>"
    )


def _legend(limit: float) -> str:
    scale = overlays.data_uri(overlays.evidence_scale(200, 12), 95)
    keys = "".join(
        f"<span><i style='background:{overlays.css(colour)}'></i>{said}</span>"
        for colour, said in (
            (overlays.FOR, "cells for"),
            (overlays.AGAINST, "cells against"),
            (overlays.UNKNOWN_COLOUR, "constant"),
        )
    )
    return (
        f"<div class='legend num'><span>−{limit:.4f}</span><img src='{scale}' alt=''><span>+{limit:.4f} of the score, "
        f"a cell</span>{keys}<span><i style='background:currentColor;width:3px'></i>together</span></div>"
    )


STYLE = """<style>
.lpn .said{font-size:14px;margin:.2em 0 .5em}
.lpn .close{position:absolute;right:14px;z-index:2;cursor:pointer;padding:0 .5em;font-size:15px;border-radius:4px}
.lpn .close:hover{background:rgba(128,128,128,.3)}
.lpn .headline{padding-right:2em}
.lpn-pair{display:flex;gap:10px;justify-content:center}
.lpn-pair.stacked{flex-direction:column}
.lpn-map{position:relative;flex:1;cursor:crosshair;user-select:none;line-height:0;max-width:520px}
.lpn-pair.stacked .lpn-map{max-width:none}
.lpn-map img{width:100%;display:block;border-radius:3px}
.lpn-map .name{position:absolute;left:6px;top:6px;line-height:1.3;padding:0 .45em;background:rgba(0,0,0,.65);
color:#eee;border-radius:3px}
.lpn-map .here,.lpn-map .there{position:absolute;display:none;box-sizing:border-box;border:2px solid #fff;outline:1px solid #000;
pointer-events:none}
.lpn-map .there{border-style:dashed}
.lpn-map .paint{position:absolute;background:rgba(0,220,200,.55);pointer-events:none;opacity:0}
.lpn-read{min-height:2.8em;padding:.3em 0}
.lpn .chips{display:flex;flex-wrap:wrap;gap:.3em;align-items:center;margin-bottom:.4em}
.lpn .chips a{cursor:pointer;padding:0 .6em;border:1px solid rgba(128,128,128,.5);border-radius:9px}
.lpn .chips a:hover{background:rgba(128,128,128,.18)}
.lpn .chips a.chosen{background:rgba(128,128,128,.32);border-color:currentColor}
.lpn .sums .wide{width:48%}
.lpn .sum{position:relative;height:14px}
.lpn .sum i,.lpn .sum b,.lpn .sum u{position:absolute;top:1px;height:12px}
.lpn .sum b{width:2px;margin-left:-1px;top:-2px;height:18px;background:currentColor}
.lpn .sum u{width:1px;top:-2px;height:18px;background:rgba(128,128,128,.8)}
.lpn .legend{display:flex;flex-wrap:wrap;gap:.2em .8em;align-items:center;margin:.5em 0}
.lpn .legend i{display:inline-block;width:11px;height:11px;margin-right:.35em;vertical-align:-1px}
</style>"""
