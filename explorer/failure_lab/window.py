"""The window of the failure laboratory: one browser's view of all queries, over the lower half of the stage."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import viser

from explorer import reports, session_state
from explorer.compute.worker import Worker
from explorer.failure_lab import charts, lab_state, messages, table
from explorer.failure_lab.lab_state import LabState
from explorer.failure_lab.service import Findings, Laboratory
from explorer.failure_lab.views import MapView, NoteView
from explorer.panels.viewport import EDGE, Viewport
from explorer.reports import Reporter
from explorer.session_state import SessionState, StateChange
from explorer.web.html import Html
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import Int64Array
from lpn.core.errors import LPNError

_UPPER = 0.49
"""Share of the stage, from its top, that the compared pair takes."""
_ROW = 27
"""Height of a row of the table, in pixels."""


@dataclass(frozen=True)
class View:
    """What the rest of the page shows."""

    task: str
    query: int | None
    open: bool


class Lab:
    """One browser's laboratory; it works on a thread of its own, so that neither the stage nor the server waits for it."""

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        shared: Laboratory,
        change: Callable[[StateChange], None],
        room: Viewport,
        reporter: Reporter,
    ) -> None:
        self._client, self._workspace, self._shared, self._change = client, workspace, shared, change
        self._room, self._reporter = room, reporter
        self._lock = threading.RLock()
        task = next(iter(workspace.tasks))
        self._lab, self._view = LabState(task), View(task, None, False)
        self._seen: int | None = None
        self._selection: tuple[object, Int64Array] = ((), np.zeros(0, np.int64))
        self._placed: bool | None = None
        self._size = (760, 400)
        self._tips = 0
        self._left = False
        self._texts: int | None = None
        self._map = MapView(shared, self)
        self._panel = client.gui.add_panel(visible=False)
        with self._panel.add_tab("Failure laboratory", viser.Icon.FLASK):
            self._bar, self._boxes, self._said = Html(client.gui), Html(client.gui), Html(client.gui)
            self._columns, self._body = Html(client.gui), Html(client.gui)
            self._notes = NoteView(client.gui, shared)
            self._tip = Html(client.gui)
        self._worker = Worker(self._work, self._failed)
        room.watch(self._moved)

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """What the window's html may ask for."""

        def changing(change: Callable[..., LabState | None]) -> Callable[[Any], None]:
            return lambda value: self._update(lambda lab, found: None if found is None else change(lab, found, value))

        parts = self._workspace.part_names
        return {
            **{kind: changing(change) for kind, change in messages.WITH_TABLE.items()},
            "lab-part": changing(lambda lab, found, value: messages.part(lab, found, value, parts)),
            "lab-rect": changing(lambda lab, _, value: messages.rectangle(lab, value, self._map.drawn)),
            "lab-page": self._turn,
            "lab-tall": lambda _: self._update(lambda lab, _: replace(lab, tall=not lab.tall)),
            "lab-stop": lambda value: self._update(lambda lab, found: messages.stop(lab, found, value)),
            "lab-go": self._go,
            "lab-open": self._open,
            "lab-point": self._open_at,
            "lab-tip": self._show_tip,
            "lab-note": self._say,
            "lab-csv": self._download,
            "lab-report": self._report,
            "lab-close": lambda _: self._change(lambda state: replace(state, lab=False)),
        }

    def show(self, analysis: StateAnalysis) -> None:
        """Open or close the window, and follow the query that the page shows."""
        state = analysis.state
        query = None if state.upload else state.query
        with self._lock:
            self._lab = lab_state.of_task(self._lab, state.task)
            self._view = View(state.task, query, state.lab)
        self._worker.wake()

    def order(self, state: SessionState) -> Int64Array | None:
        """The queries that next and previous go through while the window is open: the chosen ones in the table's order."""
        with self._lock:
            found = self._shared.findings(state.task)
            if not state.lab or found is None or self._lab.task != state.task:
                return None
            return self._rows(found, self._lab)

    def orders(self) -> list[tuple[str, Callable[[], None]]]:
        """What the command palette offers of the window, once its table is there."""
        return [
            ("Save the laboratory's queries as CSV", lambda: self._download(None)),
            ("Save a report of the laboratory's queries", lambda: self._report(None)),
        ]

    def leave(self) -> None:
        """The browser is gone."""
        self._left = True
        self._worker.stop()
        self._shared.leave(self)

    def _update(self, change: Callable[[LabState, Findings | None], LabState | None]) -> None:
        with self._lock:
            changed = change(self._lab, self._shared.findings(self._lab.task))
            if changed is None or changed == self._lab:
                return
            self._lab = changed
        self._worker.wake()

    def _rows(self, found: Findings, lab: LabState) -> Int64Array:
        """The chosen queries in the table's order; kept for turning pages."""
        key = (found, lab.outcome, lab.where, lab.find, lab.picks, lab.sort, lab.descending)
        with self._lock:
            if self._selection[0] != key:
                self._selection = key, lab_state.order(found, lab, lab_state.select(found, lab))
            return self._selection[1]

    def _work(self) -> None:
        self._show()
        if self._left:  # what was asked for meanwhile
            self._shared.leave(self)

    def _show(self) -> None:
        with self._lock:
            lab, view = self._lab, self._view
        if not view.open:
            self._shared.leave(self)
            self._place(None)
            return
        self._place(lab.tall)
        found = self._shared.findings(lab.task)
        if found is None:
            self._wait_for_table(lab)
            return
        rows = self._rows(found, lab)
        if lab.tab == "table":
            lab = self._paged(lab, view, rows)
        first = lab.page * self._count
        shown = rows[first : first + self._count]
        self._bar.show(table.bar(found, lab))
        if lab.texts != self._texts:  # else what is being typed would be taken away
            self._texts = lab.texts
            self._boxes.show(table.boxes(found, lab))
        self._said.show(table.said(found, lab, rows, (first, self._count)))
        self._columns.show(table.columns(found, lab) if lab.choosing and lab.tab == "table" else "")
        if lab.tab == "table":
            self._body.show(table.table(found, lab, self._workspace, shown, view.query))
        elif lab.tab == "breakdown":
            self._body.show(charts.page(found, lab, self._workspace))
        else:
            shown_map, ready = self._map.page(found, lab, view.query, rows, self._size)
            self._body.show(shown_map)
            if not ready:
                self._worker.wake()
        self._tip.show("")
        self._notes.show(found, view.query if lab.tab == "table" else None)

    def _wait_for_table(self, lab: LabState) -> None:
        stopped = "table" in lab.stopped
        job = None
        if stopped:
            self._shared.leave(self, lab.task)
        else:
            job = self._shared.build(lab.task, self)
            if job.wait(0.4) and job.error is None:
                self._worker.wake()
                return
        for part in (self._bar, self._boxes, self._said, self._columns):
            part.show("")
        self._texts = None
        self._notes.show(None, None)
        queries = len(self._workspace.tasks[lab.task].queries)
        self._body.show(table.waiting(job, f"Ranking {queries:,} queries", stopped, "table"))
        if job is not None and job.error is None:
            self._worker.wake()

    def _paged(self, lab: LabState, view: View, rows: Int64Array) -> LabState:
        """The table's page: that of the query when another one has been taken, and none beyond the last."""
        page = min(max(lab.page, 0), max(-(-len(rows) // self._count) - 1, 0))
        if view.query != self._seen:
            places = np.flatnonzero(rows == view.query)
            if self._seen is not None and len(places):
                page = int(places[0]) // self._count
            self._seen = view.query
        with self._lock:
            if self._lab is lab:
                self._lab = replace(lab, page=page)
        return replace(lab, page=page)

    @property
    def _count(self) -> int:
        """Rows on a page."""
        return min(max((self._size[1] - 185) // _ROW, 5), 25)

    def _place(self, tall: bool | None) -> None:
        """Over the lower half of the stage, or all of it; None hides the window."""
        if tall == self._placed:
            return
        if tall is not None:
            width, height = self._size = self._room.window(share=1.0 if tall else 1 - _UPPER)
            self._panel.float(x=EDGE, y=-EDGE, width=width, height=height)
            self._panel.expand()
        self._panel.visible = tall is not None
        self._placed = tall

    def _moved(self) -> None:
        """There is more or less room: take the place anew."""
        self._placed = None if self._placed is None else not self._placed
        self._worker.wake()

    def _turn(self, value: Any) -> None:
        by = messages.integer(value, -1, 1)
        if by is not None:
            self._update(lambda lab, _: replace(lab, page=max(lab.page + by, 0)))

    def _go(self, value: Any) -> None:
        if value == "table":
            self._shared.again(self._lab.task)
        elif value in lab_state.MAPS:
            self._shared.again(self._lab.task, value)
        self._update(lambda lab, found: messages.go(lab, found, value))
        self._worker.wake()

    def _open(self, value: Any) -> None:
        task = self._lab.task
        queries = len(self._workspace.tasks[task].queries)
        row = messages.integer(value, 0, queries - 1)
        if row is not None:
            self._change(lambda state: session_state.choose(state, row, queries) if state.task == task else state)

    def _open_at(self, value: Any) -> None:
        found = self._shared.findings(self._lab.task)
        rows = None if found is None else self._map.at(found, self._lab, value)
        if rows is not None:
            self._open(int(rows[0]))

    def _show_tip(self, value: Any) -> None:
        found = self._shared.findings(self._lab.task)
        if found is not None:
            rows = self._map.at(found, self._lab, value)
            self._tips += 1
            self._tip.show("" if rows is None else table.tip(found, self._workspace, rows, self._tips))

    def _say(self, value: Any) -> None:
        if self._notes.say(value):
            self._worker.wake()

    def _download(self, _: Any) -> None:
        found = self._shared.findings(self._lab.task)
        if found is None:
            return
        rows = self._rows(found, self._lab)
        name = re.sub(r"[^\w-]+", "-", f"{self._workspace.data_name}-{found.task.name}-{len(rows)}-queries")
        self._client.send_file_download(f"{name}.csv", found.table.to_csv(rows), save_immediately=True)

    def _report(self, _: Any) -> None:
        lab, found = self._lab, self._shared.findings(self._lab.task)
        if found is None:
            return
        rows, task = [int(row) for row in self._rows(found, lab)], found.task
        chosen = f"{lab_state.words(found, lab)} (failure laboratory)"
        self._reporter.make(
            lambda progress, model: reports.of_selection(self._workspace, task, rows, chosen, progress, model)
        )

    def _failed(self, error: Exception) -> None:
        text = (
            str(error)
            if isinstance(error, LPNError)
            else f"{type(error).__name__}: the details are in the server's log."
        )
        self._body.show(f"<div class='lpn'>{table.message(text, False)}</div>")
