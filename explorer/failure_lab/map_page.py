"""The laboratory's third tab: a map of the queries, redrawn only when something on it changes."""

from __future__ import annotations

import numpy as np

from explorer.failure_lab import map_drawing, table
from explorer.failure_lab.map_drawing import DrawnMap
from explorer.failure_lab.messages import OpenPoint, SelectRectangle, ShowTip
from explorer.failure_lab.service import FailureLab, Findings
from explorer.failure_lab.state import LabState, Selection, add_selection
from explorer.web.render import render
from lpn.core.arrays import Int64Array
from lpn.drawing import overlays

NO_EMBEDDING = "The tiles of an index are not in memory, so their descriptors are not drawn as a map."


class MapPage:
    """One browser's map.

    Args:
        client: stands for the browser, which waits for the computation of maps.
    """

    def __init__(self, service: FailureLab, client: object) -> None:
        self._service, self._client = service, client
        self._key: object = None
        self.drawn: DrawnMap | None = None

    def page(
        self, findings: Findings, lab: LabState, query: int | None, rows: Int64Array, window: tuple[int, int]
    ) -> tuple[str, bool]:
        """Return the HTML, and whether it is final; if not, call again at once, because the map is being computed.

        Args:
            query: the query that the explorer shows.
            rows: the selected queries; pass the same array while they are the same.
            window: width and height in pixels.
        """
        embedded, ground = findings.task.depth is None, findings.task.geometry is not None
        if not embedded and (lab.map != "ground" or not ground):
            kinds = {"ground": "On the ground"} if ground else {}
            return render("failure_lab/map", lab=lab, kinds=kinds, picture="", axes="", reason=NO_EMBEDDING), True
        paused = lab.map in lab.paused
        job = None if paused else self._service.points(lab.map, lab.task, self._client)
        if paused:
            self._service.leave(self._client, lab.task, lab.map)
        kinds = {"pca": "Descriptors, PCA"} if embedded else {}
        if embedded and self._service.has_umap:
            kinds["umap"] = "Descriptors, UMAP"
        if ground:
            kinds["ground"] = "On the ground"
        if job is None or not job.wait(0.4) or job.value is None:
            self._key, self.drawn = None, None
            html = render("failure_lab/map", lab=lab, kinds=kinds, picture="", axes="", reason="")
            return html + table.waiting(job, "The map", paused, lab.map), job is None or job.error is not None
        points = job.value
        around = 210 + (30 if window[0] < 700 else 0)
        size = (max(window[0] - 34, 280), max(window[1] - around, 180))
        key = (points, id(rows), lab.zoomed, size, query)
        if self.drawn is None or self._key != key:
            selected = np.zeros(len(findings.table), bool)
            selected[rows] = True
            outcomes = findings.outcomes
            selected &= outcomes.known
            positive = -1 if query is None else int(outcomes.true[query])
            self.drawn = map_drawing.draw(
                points, outcomes.failed, selected, outcomes.answer, size, lab.zoomed, query, positive
            )
            self._key, self._rows = key, rows
        picture = overlays.data_uri(self.drawn.picture, 86)
        return render("failure_lab/map", lab=lab, kinds=kinds, picture=picture, axes=points.axes, reason=""), True

    def queries_at(self, findings: Findings, lab: LabState, message: OpenPoint | ShowTip) -> Int64Array | None:
        """Return the queries at a point of the map that is shown, the lowest margin first; None if there are none."""
        drawn = self.drawn  # the thread that draws may replace it meanwhile
        if drawn is None or message.map != lab.map:
            return None
        rows = drawn.near(*message.point)
        return findings.table.sort(rows, "margin") if len(rows) else None

    def select_rectangle(self, lab: LabState, message: SelectRectangle) -> LabState:
        """Select the queries in a rectangle of the map that is shown."""
        drawn = self.drawn
        if drawn is None or message.map != lab.map:
            return lab
        label = "rectangle on the ground" if lab.map == "ground" else f"rectangle in the {lab.map.upper()}"
        rows = drawn.inside(message.corner, message.opposite)
        return add_selection(lab, Selection(f"in {lab.map}", label, rows))
