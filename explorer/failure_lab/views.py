"""Two views of the laboratory that remember something: the map that was drawn last, and the note that is being written."""

from __future__ import annotations

from typing import Any

import numpy as np
import viser

from explorer.failure_lab import charts, map_drawing, messages, table
from explorer.failure_lab.lab_state import LabState
from explorer.failure_lab.map_drawing import Drawn
from explorer.failure_lab.service import Findings, Laboratory
from explorer.web.html import Html
from lpn.analysis.notes import Note
from lpn.core.arrays import Int64Array
from lpn.core.errors import LPNError


class MapView:
    """One browser's map; `who` waits for it."""

    def __init__(self, shared: Laboratory, who: object) -> None:
        self._shared, self._who = shared, who
        self._key: object = None
        self.drawn: Drawn | None = None

    def page(
        self, found: Findings, lab: LabState, query: int | None, rows: Int64Array, window: tuple[int, int]
    ) -> tuple[str, bool]:
        """The html, and whether it is all there: otherwise it is to be asked for again at once.

        Args:
            rows: the chosen queries, the same array as long as they are the same.
            window: its width and height.
        """
        stopped = lab.map in lab.stopped
        job = None if stopped else self._shared.points(lab.map, lab.task, self._who)
        if stopped:
            self._shared.leave(self._who, lab.task, lab.map)
        if job is None or not job.wait(0.4) or job.value is None:
            self._key, self.drawn = None, None
            choice = f"<div class='lpn' id='lpn-lab-nomap'>{charts.map_choice(found, lab, self._shared.umap)}</div>"
            return choice + table.waiting(job, "The map", stopped, lab.map), job is None or job.error is not None
        points = job.value
        around = 210 + (30 if window[0] < 700 else 0)
        size = (max(window[0] - 34, 280), max(window[1] - around, 180))
        key = (points, id(rows), lab.fit, size, query)
        if self.drawn is None or self._key != key:
            chosen = np.zeros(len(found.table), bool)
            chosen[rows] = True
            outcomes = found.outcomes
            truth = -1 if query is None else int(outcomes.true[query])
            self.drawn = map_drawing.draw(points, outcomes.failed, chosen, outcomes.first, size, lab.fit, query, truth)
            self._key, self._rows = key, rows
        return charts.map_page(found, lab, self.drawn, points.axes, self._shared.umap), True

    def at(self, found: Findings, lab: LabState, value: Any) -> Int64Array | None:
        """The queries at a point of the map that is shown, [map, fractions], the lowest margin first; None without any."""
        drawn = self.drawn
        if drawn is None or not isinstance(value, list) or len(value) != 2 or value[0] != lab.map:
            return None
        place = messages.point(value[1])
        rows = None if place is None else drawn.near(*place)
        return None if rows is None or not len(rows) else found.table.sort(rows, "margin")


class NoteView:
    """One browser's boxes for the tags and the note of the current query; what is being typed stays."""

    def __init__(self, gui: viser.GuiApi, shared: Laboratory) -> None:
        self._shared = shared
        self._boxes, self._message = Html(gui), Html(gui)
        self._noted: tuple[str, Note] | None = None
        self._opened = 0

    def show(self, found: Findings | None, query: int | None) -> None:
        """Fill the boxes where another query has been taken, or somebody else has changed its note; None empties them."""
        if found is None or query is None:
            self._noted = None
            self._boxes.show("")
            self._message.show("")
            return
        stored = found.table.paths[query], found.note(query)
        if stored == self._noted:
            return
        if self._noted is None or self._noted[0] != stored[0]:
            self._message.show("")
        self._noted = stored
        self._opened += 1
        self._boxes.show(table.note(found, query, stored[1], self._opened))

    def say(self, value: Any) -> bool:
        """Save what the page sends, [task, row, tags, note], and say whether it was saved."""
        if not isinstance(value, list) or len(value) != 4 or not all(isinstance(value[i], str) for i in (0, 2, 3)):
            return False
        task, row, tags, text = value
        found = self._shared.findings(task)
        if found is None or messages.integer(row, 0, len(found.table) - 1) is None:
            return False
        path = found.table.paths[row]
        try:
            self._shared.say(path, tags, text)
        except LPNError as error:
            self._message.show(table.message(f"Not saved. {error}", False))
            return False
        newest = self._shared.findings(task)
        if newest is not None and self._noted is not None and self._noted[0] == path:
            self._noted = path, newest.note(row)
        self._message.show(table.message(f"Saved in {self._shared.notes.name}, beside the data.", True))
        return True
