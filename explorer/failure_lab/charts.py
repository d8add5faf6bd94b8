"""The html of the laboratory's charts: the breakdown of failures, with intervals, and the maps."""

from __future__ import annotations

from html import escape

from explorer.failure_lab import lab_state
from explorer.failure_lab.lab_state import LabState
from explorer.failure_lab.map_drawing import Drawn
from explorer.failure_lab.service import Findings
from explorer.web.render import send
from explorer.web.style import verdict_ink
from explorer.workspace import Workspace
from lpn.analysis import breakdown
from lpn.analysis.breakdown import Rate
from lpn.core.tables import Column
from lpn.drawing import overlays, theme

_PAIRS, _VALUES = 10, 10
_ENOUGH = 10
"""Queries that a rate must be of to stretch the scale."""
_MOUSE = " ".join(
    f"on{event}='lpn.map(this,event)'"
    for event in ("pointerdown", "pointermove", "pointerup", "pointercancel", "pointerleave")
)
_FOUND, _FAILED = (verdict_ink(true) for true in (True, False))
_KEY = f"<span><b style='color:{_FOUND}'>●</b> found</span><span><b style='color:{_FAILED}'>✕</b> failed</span>"
_RINGED = (
    f"<span>ringed query: <b style='color:{_FOUND}'>■</b> its truth, <b style='color:{_FAILED}'>■</b> its answer</span>"
)
NOTE = (
    "Click on a line to choose its queries. Bars are the share of failures, whiskers its 95 % interval (Wilson), which is too "
    "narrow where several queries show one place; the thin line is the share among all queries."
)
NOTHING = (
    "Nothing else is known of these pictures: a metadata.csv in the data set's folder (path, then columns of your own) adds to "
    "this page and to the table."
)


def page(found: Findings, lab: LabState, workspace: Workspace) -> str:
    """All of it, among the chosen queries; a choice made here does not narrow the chart that it was made in."""
    columns = [(column, lab_state.rates(found, lab, column)) for column in lab_state.described(found)]
    # Neither a column of one value says anything, nor one in which each query has its own.
    columns = [(c, r) for c, r in columns if 1 < len(r) <= max(len(found.table) // 2, 2)]
    full = max((rate.interval[1] for _, rates in columns for rate in rates if rate.queries >= _ENOUGH), default=1.0)
    overall = float(found.outcomes.failed.mean())
    chosen = {pick.kind: pick.words for pick in lab.picks}
    cards = [_blame(found, lab, workspace, chosen), _pairs(found, lab, workspace, chosen)]
    cards += [_rates(column, rates, full, overall, chosen, len(found.table)) for column, rates in columns]
    note = NOTE if columns else NOTHING
    shown = "".join(cards)
    return f"<div class='lpn num' id='lpn-lab-breakdown'><div class='lab-cards'>{shown}</div><div class='dim'>{note}</div></div>"


def map_page(found: Findings, lab: LabState, drawn: Drawn, axes: str, umap: bool) -> str:
    """The shown map as a picture that takes clicks and rectangles; see `page.js`."""
    if lab.map == "ground":
        said = "<span>◔ several queries of one place: the share that failed in blue</span>"
    else:
        said = "<span><b>■</b> tiles</span>"
        said += f"<span>{escape(axes)}</span>"
    picture = overlays.data_uri(drawn.picture, 86)
    return (
        f"<div class='lpn' id='lpn-lab-map'>{map_choice(found, lab, umap)}"
        f"<div class='lab-map' data-map='{lab.map}' {_MOUSE}>"
        f"<img src='{picture}' alt='map of the queries' draggable='false'><i class='drawn'></i></div>"
        f"<div class='lab-key dim'>{_KEY}{said}{_RINGED}</div></div>"
    )


def map_choice(found: Findings, lab: LabState, umap: bool) -> str:
    """Which map, and how much of it."""
    kinds = [("pca", "Descriptors, PCA")]
    if umap:
        kinds.append(("umap", "Descriptors, UMAP"))
    if found.task.geometry is not None:
        kinds.append(("ground", "On the ground"))
    chips = "".join(
        f"<a class='{'chosen' if kind == lab.map else ''}' {send('lab-map', kind)}>{words}</a>" for kind, words in kinds
    )
    fit = f"<a class='{'chosen' if lab.fit else ''}' {send('lab-fit')}>Zoom to the chosen</a>"
    missing = "" if umap else "<span class='dim' title='pip install lpn-explorer[umap]'>UMAP: not installed</span>"
    hint = "<span class='dim'>drag to choose, click to open</span>"
    return f"<div class='lab-chips' id='lpn-lab-maps'>{chips}{missing}{fit}{hint}</div>"


def _blame(found: Findings, lab: LabState, workspace: Workspace, chosen: dict[str, str]) -> str:
    rows = lab_state.select(found, lab, "part", whatever=True)
    counts = breakdown.blame(found.outcomes, rows).tolist()
    failed = int(found.outcomes.failed[rows].sum())
    if not failed:
        return _card("Part that costs most", "<div class='dim'>No failure among the chosen queries.</div>")
    most = max(max(counts), 1)
    colours = [f"background:{theme.css(theme.part_colour(part))}" for part in range(len(counts))]
    lines = "".join(
        _line(
            ("lab-part", part),
            f"part {name} costs most" == chosen.get("part"),
            f"<span class='name'><i class='swatch' style='{colours[part]}'></i>{escape(name)}</span><span class='track'>"
            f"<i style='width:{100 * count / most:.1f}%;{colours[part]}'></i></span><span class='many'>{count:,}</span>",
            f"Part {name} costs the truth most in {count} of {failed} failures",
        )
        for part, (name, count) in enumerate(zip(workspace.part_names, counts, strict=True))
    )
    return _card(f"Part that costs most, in {failed:,} failures", lines)


def _pairs(found: Findings, lab: LabState, workspace: Workspace, chosen: dict[str, str]) -> str:
    rows = lab_state.select(found, lab, "pair", whatever=True)
    pairs = breakdown.confusions(found.outcomes, found.task.query_labels, found.task.gallery_labels, rows)
    lines = []
    for one in pairs[:_PAIRS]:
        place, answered = lab_state.names_of(found, one)
        truth = int(found.outcomes.true[one.queries[0]])
        pictures = [
            workspace.thumbnail(found.task.gallery[tile].path) if tile >= 0 else "" for tile in (truth, one.tile)
        ]
        shown = [f"<img src='{picture}' alt=''>" if picture else "<i class='none'></i>" for picture in pictures]
        lines.append(
            _line(
                ("lab-pair", [one.place, one.answered]),
                f"{place} taken for {answered}" == chosen.get("pair"),
                f"<span class='pair'>{shown[0]}{escape(place)} <span class='dim'>taken for</span> {shown[1]}{escape(answered)}"
                f"</span><span class='many'>{one.count:,}</span>",
                f"{one.count} queries of {place} were answered with {answered}",
            )
        )
    listed = f"; the first {_PAIRS} of {len(pairs):,}" if len(pairs) > _PAIRS else ""
    return _card(f"Places taken for others{listed}", "".join(lines) or "<div class='dim'>None.</div>")


def _rates(column: Column, rates: list[Rate], full: float, overall: float, chosen: dict[str, str], queries: int) -> str:
    lines = "".join(
        _line(
            ("lab-bin", [column.name, index, rate.name]),
            f"{column.name} {rate.name}" == chosen.get(lab_state.kind_of(column)),
            f"<span class='name'>{escape(rate.name)}</span><span class='track'>{_share(rate, full, overall)}</span>"
            f"<span class='many'>{100 * rate.share:.0f} %</span>",
            f"{rate.name}: {rate.failures} of {rate.queries} queries failed; 95 % interval {100 * rate.interval[0]:.0f} to "
            f"{100 * rate.interval[1]:.0f} %",
        )
        for index, rate in enumerate(rates[:_VALUES])
    )
    listed = f"; {_VALUES} of {len(rates)} values" if len(rates) > _VALUES else ""
    looked = sum(rate.queries for rate in rates)
    of = f"{'all ' if looked == queries else ''}{looked:,} queries"
    return _card(f"Failures by {column.name}, of {of}{listed}", lines)


def _share(rate: Rate, full: float, overall: float) -> str:
    low, share, high = (100 * min(value / full, 1.0) for value in (rate.interval[0], rate.share, rate.interval[1]))
    return (
        f"<i style='width:{share:.1f}%'></i><u style='left:{100 * min(overall / full, 1.0):.1f}%'></u>"
        f"<b style='left:{low:.1f}%;width:{max(high - low, 0.5):.1f}%'></b>"
    )


def _line(message: tuple[str, object], chosen: bool, inside: str, hint: str) -> str:
    return f"<div class='line{' chosen' if chosen else ''}' {send(*message)} title='{escape(hint)}'>{inside}</div>"


def _card(title: str, inside: str) -> str:
    return f"<div class='card'><div class='title'>{escape(title)}</div>{inside}</div>"
