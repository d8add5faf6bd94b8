"""The laboratory's third tab: a map of the queries, which the page's script draws from arrays that it fetches."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

from explorer.browse.feeds import Feeds
from explorer.failure_lab import map_data, table
from explorer.failure_lab.messages import OpenPoint, SelectLasso, ShowTip
from explorer.failure_lab.service import FailureLab, Findings, MapPoints
from explorer.failure_lab.state import LabState, add_selection, chosen_rows
from explorer.lab_choices import Selection
from explorer.web.render import call, render, run
from lpn.analysis import embedding_map
from lpn.core import images
from lpn.core.arrays import Int64Array

NO_EMBEDDING = "The tiles of an index are not in memory, so their descriptors are not drawn as a map."
_LABELS = {"pca": "the PCA", "umap": "the UMAP", "ground": "the ground"}


class MapPage:
    """One browser's map.

    Args:
        client: stands for the browser, which waits for the computation of maps.
    """

    def __init__(self, service: FailureLab, feeds: Feeds, client: object) -> None:
        self._service, self._feeds, self._client = service, feeds, client
        self._points: MapPoints | None = None
        self._rows = self._chosen = np.zeros(0, np.int64)
        # Published feeds by name, each with the object that it was made of.
        self._published: dict[str, tuple[object, str]] = {}

    def page(
        self, findings: Findings, lab: LabState, query: int | None, rows: Int64Array, window: tuple[int, int]
    ) -> tuple[str, str, bool]:
        """Return the HTML, what runs the script, and whether both are final; if not, call again at once: the map is computed.

        Args:
            query: the query that the explorer shows.
            rows: the selected queries; pass the same array while they are the same.
            window: width and height in pixels.
        """
        embedded, ground = findings.task.depth is None, findings.task.geometry is not None
        kinds = {"ground": "On the ground"} if ground else {}
        if embedded:
            kinds["pca"] = "Descriptors, PCA"
        if embedded and self._service.has_umap:
            kinds["umap"] = "Descriptors, UMAP"
        context = {"lab": lab, "kinds": kinds, "columns": list(findings.table.columns)}
        if not embedded and (lab.map != "ground" or not ground):
            return render("failure_lab/map", **context, height=0, reason=NO_EMBEDDING), "", True
        paused = lab.map in lab.paused
        job = None if paused else self._service.points(lab.map, lab.task, self._client)
        if paused:
            self._service.leave(self._client, lab.task, lab.map)
        if job is None or not job.wait(0.4) or job.value is None:
            self._points = None
            html = render("failure_lab/map", **context, height=0, reason="")
            return html + table.waiting(job, "The map", paused, lab.map), "", job is None or job.error is not None
        self._points = job.value
        height = max(window[1] - (276 if window[0] < 700 else 232), 180)
        html = render("failure_lab/map", **context, height=height, reason="")
        # A canvas of another height is another element, which the script must fill.
        data = {**self._data(findings, lab, query, rows, job.value), "height": height}
        return html, run(call("labMap", data)), True

    def queries_at(self, findings: Findings, lab: LabState, message: OpenPoint | ShowTip) -> Int64Array | None:
        """Return the queries at the place of one on the map that is shown, the lowest margin first; None if there are none."""
        points = self._points  # the thread that draws may replace it meanwhile
        if points is None or message.map != lab.map or message.row >= len(points.queries):
            return None
        rows = np.flatnonzero((points.queries == points.queries[message.row]).all(axis=1))
        return findings.table.sort(rows, "margin") if len(rows) else None

    def select_lasso(self, lab: LabState, message: SelectLasso) -> LabState:
        """Select the queries within a lasso on the map that is shown."""
        points = self._points
        if points is None or message.map != lab.map:
            return lab
        origin, unit = map_data.scale(points)
        rows = embedding_map.inside(points.queries, np.array(message.corners) * unit + origin)
        return add_selection(lab, Selection.of(f"in {lab.map}", f"lasso on {_LABELS[lab.map]}", rows))

    def _data(
        self, findings: Findings, lab: LabState, query: int | None, rows: Int64Array, points: MapPoints
    ) -> dict[str, Any]:
        chosen = chosen_rows(lab, rows)
        if rows is not self._rows or not np.array_equal(chosen, self._chosen):
            self._rows, self._chosen = rows, chosen
            self._published.pop("flags", None)
        colour = lab.colour if lab.colour in findings.table.columns else map_data.OUTCOME
        colours = map_data.colours(findings, colour)
        origin, unit = map_data.scale(points)
        data: dict[str, Any] = {
            "map": lab.map,
            "view": f"{lab.task} {lab.map}",
            "address": self._feeds.address,
            "queries": len(points.queries),
            "tiles": len(points.tiles),
            "plane": self._publish("plane", points, lambda: map_data.plane(points)),
            "flags": self._publish("flags", findings.outcomes, lambda: map_data.flags(findings, rows, chosen)),
            "codes": self._publish("codes", (findings, colour), colours.codes.tobytes),
            "colour": colour,
            "palette": colours.palette,
            "legend": map_data.legend(colours, rows),
            "lines": map_data.lines(findings, points, rows),
            "pictures": [self._feeds.thumbnails(findings.task, side) for side in ("query", "tile")],
            "axes": points.axes,
            "selected": len(rows),
            "chosen": len(chosen),
            "lasso": any(one.kind == f"in {lab.map}" for one in lab.selections),
            "ground": None,
        }
        if points.ground is not None and points.origin is not None:
            west, south, east, north = points.ground[1]
            corners = (np.array([[west, north], [east, south]]) - origin) / unit
            data["ground"] = {
                "picture": self._publish("ground", points, partial(images.jpeg, points.ground[0], 85), "image/jpeg"),
                "corners": corners.tolist(),
                "metres": unit,
                "degrees": map_data.degrees(points, points.origin),
            }
        if query is not None:
            outcomes = findings.outcomes
            data["query"] = [query, int(outcomes.answer[query]), int(outcomes.true[query])]
        return data

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
