"""The windows of laboratory and flight in an exported step, as tables and pictures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from markupsafe import Markup
from PIL import ImageColor

from explorer.compute.background_jobs import BackgroundJob
from explorer.failure_lab import breakdown_page, map_data, state, table
from explorer.failure_lab.map_page import NO_EMBEDDING
from explorer.failure_lab.service import FailureLab, Findings, MapPoints
from explorer.failure_lab.state import LabState
from explorer.flight_window import page as flight_page
from explorer.flight_window import pictures
from explorer.flight_window.service import FlightService, FlightView
from explorer.stories.map_picture import EMPTY, WHITE, MapPicture, PlaneBounds
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import Int64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.drawing import overlays, theme
from lpn.locate.belief import belief
from lpn.tasks.task import Task

# Rows of an exported table.
ROWS = 12
# Space around a map, as a share, and the smallest width of a flight's, in metres.
_BORDER, _LEAST = 0.06, 120.0
# Width and height of a plot of a flight, and the room for its numbers on the left.
_PLOT, _ROOM = (760, 90), 64
_PLOTS = {"error": "Error", "radius": "Radius", "height": "Height"}


class _Inside:
    """Thumbnails as data URIs, in place of addresses."""

    def __init__(self, workspace: Workspace) -> None:
        self._workspace = workspace

    def thumbnail(self, task: Task, side: Literal["query", "tile"], index: int) -> str:
        return self._workspace.thumbnail((task.queries if side == "query" else task.gallery)[index])


@dataclass(frozen=True)
class WindowSources:
    """The sources of the windows of one workspace."""

    workspace: Workspace
    lab: FailureLab
    flight: FlightService

    def laboratory(self, analysis: StateAnalysis, wait: Callable[[], None]) -> Markup:
        """Draw what the laboratory shows: the first `ROWS` rows of its table, its charts, or its map.

        Args:
            wait: called twice a second while the table or the map is computed; what it raises ends the work.

        Raises:
            InputError: when they cannot be computed.
        """
        task = analysis.task.key
        try:
            _finish(self.lab.build(task, self), wait)
            findings = self.lab.findings(task, analysis.state.beside)
            assert findings is not None
            lab = state.with_choices(findings, LabState(task=task), analysis.state.laboratory)
            rows = state.sorted_rows(findings, lab)
            query = None if analysis.state.upload else analysis.state.query
            match lab.tab:
                case "table":
                    contents = self._table(findings, lab, rows, query)
                case "breakdown":
                    cards = breakdown_page.cards(findings, lab, self.workspace)
                    contents = Markup(render("stories/lab_breakdown", cards=cards))
                case "maps":
                    contents = self._map(findings, lab, rows, query, wait)
            return Markup(
                render(
                    "stories/laboratory",
                    selection=state.describe(findings, lab),
                    selected=len(rows),
                    queries=len(findings.table),
                    failed=int(findings.failed[rows].sum()),
                    ungraded=findings.not_graded(rows),
                    error=lab.filter_error,
                    names=None if findings.second is None else findings.second.names,
                    contents=contents,
                )
            )
        finally:
            self.lab.leave(self)

    def _table(self, findings: Findings, lab: LabState, rows: Int64Array, query: int | None) -> Markup:
        columns = table.visible_columns(findings, lab)
        lines = table.lines(findings, columns, _Inside(self.workspace), rows[:ROWS], loaded=True)
        return Markup(render("stories/lab_table", lab=lab, columns=columns, lines=lines, query=query, total=len(rows)))

    def _map(
        self, findings: Findings, lab: LabState, rows: Int64Array, query: int | None, wait: Callable[[], None]
    ) -> Markup:
        task = findings.task
        lost = ""
        if lab.map != "ground" and task.depth is not None:
            lost = NO_EMBEDDING
        elif lab.map == "ground" and task.geometry is None:
            lost = "No position is known, so there is no map of the ground."
        elif lab.map == "umap" and not self.lab.has_umap:
            lost = "The map of neighbours is left out: it needs the extra train (pip install lpn-explorer[train])."
        if lost:
            return Markup(render("stories/lab_map", lost=lost))
        points = _finish(self.lab.points(lab.map, task.key, self), wait)
        assert points is not None
        colours = map_data.colours(findings, lab.colour if lab.colour in findings.table.columns else map_data.OUTCOME)
        picture = draw_queries(findings, points, colours, rows, query)
        legend = map_data.legend(colours, rows)
        return Markup(
            render(
                "stories/lab_map",
                lost="",
                picture=overlays.data_uri(picture, 88),
                axes=points.axes,
                colour=lab.colour or "outcome",
                palette=colours.palette,
                unknown=legend["counts"][-1],
                **legend,
            )
        )

    def flight_window(self, analysis: StateAnalysis) -> Markup:
        """Draw what the flight window shows of a frame: its map with the tracks, the frame beside the map, and the plots."""
        view = self.flight.view()
        frame = None if analysis.state.upload or analysis.state.query >= len(view.beliefs) else analysis.state.query
        data = flight_page.data(view, "")
        context: dict[str, Any] = {"frame": None}
        if frame is not None:
            located = view.flight.frames[frame]
            photo, ground = pictures.pair(view.flight.basemap, located)
            context = {
                "frame": frame,
                "name": data["names"][frame],
                "verdict": view.beliefs[frame],
                "photo": photo.data_uri,
                "ground": None if pictures.ground_window(located, belief(located).stage) is None else ground.data_uri,
            }
        return Markup(
            render(
                "stories/flight",
                **context,
                total=len(view.beliefs),
                map=overlays.data_uri(draw_flight(view, data, frame), 88),
                tracks=data["tracks"].values(),
                plots=[plot for kind in _PLOTS if (plot := _plot(kind, data, frame)) is not None],
                width=_PLOT[0],
                height=_PLOT[1],
                room=_ROOM,
            )
        )


def _finish(job: BackgroundJob[Any], wait: Callable[[], None]) -> Any:
    while not job.wait(0.5):
        wait()
    if job.error is not None:
        raise InputError(f"“All pictures in a table” cannot be exported: {job.error}")
    return job.value


def draw_queries(
    findings: Findings, points: MapPoints, colours: map_data.Colours, rows: Int64Array, query: int | None
) -> UInt8Array:
    """Draw the laboratory's map, (H, W, 3) uint8: selected queries in colours, the others small and grey."""
    places = np.concatenate([points.queries, points.tiles])
    if not np.isfinite(places).all(axis=1).any():
        places = np.zeros((1, 2))
    drawn = MapPicture(places, _BORDER)
    if points.ground is not None:
        drawn.lay(*points.ground)
        for row, tile in map_data.lines(findings, points, rows):
            if np.isfinite(points.queries[row]).all():
                drawn.line((points.queries[row], points.tiles[tile]), theme.FALSE_COLOUR, 2)
    inks = [ImageColor.getrgb(colour)[:3] for colour in colours.palette]
    others = np.setdiff1d(np.arange(len(points.queries)), rows)
    for queries, radius in ((others, 3.0), (rows, 6.0)):
        for row in queries[np.isfinite(points.queries[queries]).all(axis=1)].tolist():
            code = int(colours.codes[row])
            known = radius > 3 and code < len(inks)
            drawn.dot(points.queries[row], inks[code] if known else theme.UNKNOWN_COLOUR, radius)
    if query is not None and np.isfinite(points.queries[query]).all():
        drawn.dot(points.queries[query], WHITE, 13, hollow=True)
    if points.ground is not None:
        drawn.mark_ground()
    return drawn.picture()


def draw_flight(view: FlightView, data: dict[str, Any], frame: int | None) -> UInt8Array:
    """Draw a flight over its map, (H, W, 3) uint8: tracks, and the ground that the chosen frame shows.

    Args:
        data: as `flight_window.page.data` returns it.
    """
    west, south, east, north = data["bounds"]
    tracks = {
        name: np.array([[np.nan if value is None else value for value in (x, y)] for x, y in zip(*axes, strict=True)])
        for name, track in data["tracks"].items()
        if (axes := (track["x"], track["y"]))
    }
    sound = [
        points[np.array(data["tracks"][name]["state"]) < 2] for name, points in tracks.items() if name != "retrieval"
    ]
    near = np.concatenate([*sound, np.zeros((0, 2))])
    inside = (near > (west - 500, south - 500)).all(axis=1) & (near < (east + 500, north + 500)).all(axis=1)
    near = near[inside] if inside.sum() > 1 else np.array([(west, south), (east, north)])
    drawn = MapPicture(near, 3 * _BORDER, _LEAST)
    drawn.lay(*_ground(view, drawn))
    if frame is not None and (outline := view.outlines[frame]) is not None:
        drawn.line([*outline.corners, outline.corners[0]], WHITE, 3)
    for name, points in tracks.items():
        colour, states = flight_page.COLOURS[name], data["tracks"][name]["state"]
        known = np.isfinite(points).all(axis=1)
        joined: list[Any] = []
        for at, there, one in [*zip(points, known, states, strict=True), (None, False, 0)]:
            if one == 2:
                continue
            if there and name != "retrieval":  # nothing has verified the retrieval, so it has no line
                joined.append(at)
                continue
            if len(joined) > 1:
                drawn.line(joined, colour, 2 if name == "tag" else 3)
            joined = []
        for i in np.flatnonzero(known).tolist():
            drawn.dot(points[i], colour, 4 if name == "tag" else 5, hollow=states[i] == 2)
        if frame is not None and known[frame]:
            drawn.dot(points[frame], WHITE, 11, hollow=True)
    drawn.mark_ground()
    return drawn.picture()


def _ground(view: FlightView, drawn: MapPicture) -> tuple[UInt8Array, PlaneBounds]:
    """Join the tiles of the map's pyramid that a picture needs, and return them with their borders."""
    basemap = view.flight.basemap
    pyramid = pictures.Pyramid.of(basemap)
    level = min(max(math.ceil(math.log2(pyramid.side / (pictures.TILE * drawn.unit))), 0), pyramid.levels)
    size = pyramid.side / (1 << level)
    west, south, east, north = drawn.bounds
    columns = range(math.floor((west - pyramid.west) / size), math.floor((east - pyramid.west) / size) + 1)
    rows = range(math.floor((pyramid.north - north) / size), math.floor((pyramid.north - south) / size) + 1)
    joined = np.full((len(rows), pictures.TILE, len(columns), pictures.TILE, 3), EMPTY, np.uint8)
    for down, row in enumerate(rows):
        for right, column in enumerate(columns):
            if pyramid.window(level, column, row) is not None:
                picture, valid = pictures.tile(basemap, level, column, row)
                joined[down, :, right] = np.where(valid[..., None], picture, EMPTY)
    left, top = pyramid.west + columns.start * size, pyramid.north - rows.start * size
    bounds = left, top - len(rows) * size, left + len(columns) * size, top
    return joined.reshape(len(rows) * pictures.TILE, len(columns) * pictures.TILE, 3), bounds


@dataclass(frozen=True)
class _Plot:
    """A value of each frame over time.

    Attributes:
        label, top, low: the value in words, and the ends of its scale.
        marks: left, height, colour, and whether it is refused, of each known value.
        chosen: where the chosen frame lies from left to right; None without one.
    """

    label: str
    top: str
    low: str
    marks: list[tuple[float, float, str, bool]]
    chosen: float | None


def _plot(kind: str, data: dict[str, Any], frame: int | None) -> _Plot | None:
    """Draw one plot of the timeline; None if no value is known."""
    times = data["times"] or list(range(len(data["names"])))
    first, span = min(times, default=0), max(times, default=0) - min(times, default=0) or 1
    left = [_ROOM + 6 + (_PLOT[0] - _ROOM - 12) * (time - first) / span for time in times]
    if kind == "height":
        series = [("currentColor", data["heights"], [0] * len(times))]
    else:
        hidden = {"tag"} if kind == "error" else {"tag", "retrieval", "corrected"}
        series = [(t["colour"], t[kind], t["state"]) for name, t in data["tracks"].items() if name not in hidden]
    values = sorted(value for _, column, _ in series for value in column if value is not None)
    if not values:
        return None
    # One wrong guess far away must not flatten the others: the scale ends at three times the 90th percentile.
    usual = values[int(0.9 * (len(values) - 1))]
    top = values[-1] if kind == "height" else min(values[-1], 3 * usual) or 1
    low = max(values[0] - 0.3 * (values[-1] - values[0]) - 1, 0) if kind == "height" else 0.0
    marks = [
        (left[i], _PLOT[1] - 6 - (_PLOT[1] - 12) * (min(value, top) - low) / ((top - low) or 1), colour, states[i] == 2)
        for colour, column, states in series
        for i, value in enumerate(column)
        if value is not None
    ]
    words = f"{top:.1f} m" if top < 10 else f"{top:,.0f} m"
    return _Plot(_PLOTS[kind], words, f"{low:,.0f}", marks, None if frame is None else left[frame])
