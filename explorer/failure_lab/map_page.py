"""The laboratory's third tab: maps of the queries, which the page's script draws from arrays that it fetches."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from explorer.browse.feeds import Feeds
from explorer.compute.background_jobs import BackgroundJob
from explorer.failure_lab import map_data, table
from explorer.failure_lab.map_layout import map_room
from explorer.failure_lab.messages import OpenPoint, SelectLasso, ShowTip
from explorer.failure_lab.service import FailureLab, Findings, MapPoints
from explorer.failure_lab.state import LabState, add_selection, chosen_rows
from explorer.lab_choices import Selection
from explorer.web.render import call, render, run
from lpn.analysis import embedding_map
from lpn.core import images
from lpn.core.arrays import Int64Array
from lpn.drawing import words

_LABELS = {"pca": "the PCA", "umap": "the UMAP", "ground": "the ground"}
_NOTHING = np.zeros((0, 2))


class MapView(NamedTuple):
    """The tab as the page shows it.

    Attributes:
        controls: the choice of the map and its key, as HTML.
        maps: the maps, or why there are none, as HTML.
        script: HTML that draws them; may be empty.
        final: nothing is being computed; otherwise ask again at once.
    """

    controls: str
    maps: str
    script: str = ""
    final: bool = True


class MapPage:
    """One browser's maps.

    Args:
        client: stands for the browser, which waits for the computation of maps.
    """

    def __init__(self, service: FailureLab, feeds: Feeds, client: object) -> None:
        self._service, self._feeds, self._client = service, feeds, client
        self._points: MapPoints | None = None
        self._second: MapPoints | None = None
        self._rows = self._chosen = np.zeros(0, np.int64)
        # Published feeds by name, each with the object that it was made of.
        self._published: dict[str, tuple[object, str]] = {}

    def page(
        self,
        findings: Findings,
        lab: LabState,
        query: int | None,
        rows: Int64Array,
        window: tuple[int, int],
        beside: int = 0,
        offered: bool = False,
    ) -> MapView:
        """Return the tab.

        Args:
            query: the query that the explorer shows.
            rows: the selected queries; pass the same array while they are the same.
            window: width and height in pixels.
            beside: which of the models beside the workspace's own is the second one.
            offered: there is a second model.
        """
        kinds = {} if findings.task.geometry is None else {"ground": "On the ground"}
        kinds["pca"] = "By likeness" if words.plain() else "Descriptors, PCA"
        if self._service.has_umap:
            kinds["umap"] = "By likeness (UMAP)" if words.plain() else "Descriptors, UMAP"
        controls = partial(
            render,
            "failure_lab/map_controls",
            lab=lab,
            kinds=kinds,
            columns=list(findings.table.columns),
            both=offered and lab.map != "ground",
        )
        paused = lab.map in lab.paused
        job = None if paused else self._service.points(lab.map, lab.task, self._client)
        if paused:
            self._service.leave(self._client, lab.task, lab.map)
        if job is None or (points := _value(job)) is None:
            self._points = self._second = None
            waiting = table.waiting(job, "The map", paused, lab.map)
            final = job is None or job.error is not None
            return MapView(
                controls(drawn=False), render("failure_lab/map", room=None, names=(), maps=0) + waiting, final=final
            )
        second, pending = self._second_points(lab, beside)
        self._points, self._second = points, second
        both = [points] if second is None else [points, second]
        room = map_room(window, max(map(map_data.proportion, both)), len(both))
        names = () if second is None or findings.second is None else findings.second.names
        html = render("failure_lab/map", lab=lab, room=room, names=names, maps=len(both))
        above = controls(drawn=True)
        data = self._data(findings, lab, query, rows, both)
        # Elements that were drawn anew are to be filled by the script.
        data["element"] = zlib.crc32(f"{above}{html}".encode())
        return MapView(above, html, run(call("labMap", data)), not pending)

    def _second_points(self, lab: LabState, beside: int) -> tuple[MapPoints | None, bool]:
        """Return the second model's points if they are wanted and known, and whether they are being computed."""
        if not lab.both_maps or lab.map == "ground":
            return None, False
        job = self._service.second_points(lab.map, lab.task, self._client, beside)
        points = None if job is None else _value(job)
        return points, job is not None and points is None and job.error is None

    def queries_at(self, findings: Findings, lab: LabState, message: OpenPoint | ShowTip) -> Int64Array | None:
        """Return the queries at the place of one on the map that is shown, the lowest margin first; None if there are none."""
        points = self._points  # the thread that draws may replace it meanwhile
        if points is None or message.map != lab.map or message.row >= len(points.queries):
            return None
        rows = np.flatnonzero((points.queries == points.queries[message.row]).all(axis=1))
        return findings.table.sort(rows, "margin") if len(rows) else None

    def select_lasso(self, lab: LabState, message: SelectLasso) -> LabState:
        """Select the queries within a lasso on a map that is shown; one replaces that on the other model's map."""
        points = self._second if message.second else self._points
        if points is None or message.map != lab.map:
            return lab
        origin, unit = map_data.scale(points)
        rows = embedding_map.inside(points.queries, np.array(message.corners) * unit + origin)
        of_second = " of the second model" if message.second else ""
        return add_selection(lab, Selection.of(f"in {lab.map}", f"lasso on {_LABELS[lab.map]}{of_second}", rows))

    def _data(
        self, findings: Findings, lab: LabState, query: int | None, rows: Int64Array, maps: list[MapPoints]
    ) -> dict[str, Any]:
        chosen = chosen_rows(lab, rows)
        if rows is not self._rows or not np.array_equal(chosen, self._chosen):
            self._rows, self._chosen = rows, chosen
            self._published.pop("flags", None)
        colour = lab.colour if lab.colour in findings.table.columns else map_data.OUTCOME
        colours = map_data.colours(findings, colour)
        points = maps[0]
        data: dict[str, Any] = {
            "map": lab.map,
            "address": self._feeds.address,
            "queries": len(points.queries),
            "flags": self._publish("flags", findings, lambda: map_data.flags(findings, rows, chosen)),
            "codes": self._publish("codes", (findings, colour), colours.codes.tobytes),
            "colour": colour,
            "palette": colours.palette,
            "legend": map_data.legend(colours, rows),
            "lines": map_data.lines(findings, points, rows),
            "pictures": [self._feeds.thumbnails(findings.task, side) for side in ("query", "tile")],
            "selected": len(rows),
            "chosen": len(chosen),
            "lasso": any(one.kind == f"in {lab.map}" for one in lab.selections),
            "ground": None,
            "words": [words.say("query"), words.say("query", 2)],
            "maps": [self._of_map(lab, number, one) for number, one in enumerate(maps)],
        }
        if points.ground is not None:
            origin, unit = map_data.scale(points)
            west, south, east, north = points.ground[1]
            corners = (np.array([[west, north], [east, south]]) - origin) / unit
            data["ground"] = {
                "picture": self._publish("ground", points, partial(images.jpeg, points.ground[0], 85), "image/jpeg"),
                "corners": corners.tolist(),
                "metres": unit,
                "middle": origin.tolist(),
                "degrees": None if points.origin is None else map_data.degrees(points, points.origin),
            }
        if query is not None:
            outcomes = findings.outcomes
            marked = () if findings.is_doubtful(query) else (outcomes.answer, outcomes.true)
            data["query"] = [query, *(int(tiles[query]) for tiles in marked)]
        return data

    def _of_map(self, lab: LabState, number: int, points: MapPoints) -> dict[str, Any]:
        """Return what one of the maps alone has."""
        return {
            "view": f"{lab.task} {lab.map} {number}",
            "plane": self._publish(f"plane {number}", points, lambda: map_data.plane(points)),
            "tiles": len(points.tiles),
            "axes": points.axes,
        }

    def _publish(
        self, name: str, key: object, make: Callable[[], bytes], media_type: str = "application/octet-stream"
    ) -> str:
        known = self._published.get(name)
        if known is None or known[0] != key:
            known = self._published[name] = key, self._feeds.publish_bytes(self, name, make, media_type)
        return known[1]

    def leave(self) -> None:
        """Serve nothing more to a browser that left."""
        self._feeds.leave(self)


def _value(job: BackgroundJob[MapPoints]) -> MapPoints | None:
    """Wait a little for a map; return None if it takes longer, or failed."""
    return job.value if job.wait(0.4) else None
