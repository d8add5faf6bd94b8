"""The window of the failure laboratory: one browser's view of all queries, over the lower half of the stage."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import viser

from explorer import reports, session_state
from explorer.compute.worker import Worker
from explorer.failure_lab import breakdown_page, messages, state, table
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.messages import LabMessage
from explorer.failure_lab.note_form import NoteForm
from explorer.failure_lab.service import FailureLab, Findings
from explorer.failure_lab.state import LabState
from explorer.reports import Reporter
from explorer.session_state import SessionState, StateChange
from explorer.stage.viewport import EDGE, Viewport
from explorer.web.html import Html
from explorer.workspace import StateAnalysis, Workspace
from lpn.core.arrays import Int64Array
from lpn.core.errors import LPNError

# Share of the stage, from its top, that the compared pair takes.
_PAIR_SHARE = 0.49
_ROW_HEIGHT = 27  # pixels
# Height of the window without the rows of the table, in pixels.
_FRAME_HEIGHT = 185


@dataclass(frozen=True)
class _View:
    """The task and the query that the rest of the page shows, and whether the window is open."""

    task: str
    query: int | None
    open: bool


class FailureLabWindow:
    """One browser's laboratory. It works on its own thread, so that neither the stage nor the server waits for it."""

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        service: FailureLab,
        change: Callable[[StateChange], None],
        viewport: Viewport,
        reporter: Reporter,
    ) -> None:
        self._client, self._workspace, self._service, self._change = client, workspace, service, change
        self._viewport, self._reporter = viewport, reporter
        self._lock = threading.RLock()
        task = next(iter(workspace.tasks))
        self._lab, self._view = LabState(task), _View(task, None, False)
        self._last_query: int | None = None
        self._sorted: tuple[object, Int64Array] = ((), np.zeros(0, np.int64))
        self._full_height_shown: bool | None = None
        self._size = (760, 400)
        self._tips = 0
        self._left = False
        self._text_revision: int | None = None
        self._map = MapPage(service, self)
        gui = client.gui
        self._panel = gui.add_panel(visible=False)
        with self._panel.add_tab("Failure laboratory", viser.Icon.FLASK):
            self._bar, self._boxes, self._summary, self._columns, self._body = (Html(gui) for _ in range(5))
            self._notes = NoteForm(gui, service)
            self._tip = Html(gui)
        self._worker = Worker(self._work, self._show_error)
        viewport.watch(self._resize)

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """Return a handler for each kind of message of the window's HTML."""
        return {kind: partial(self._receive, kind) for kind in messages.MESSAGES}

    def show(self, analysis: StateAnalysis) -> None:
        """Open or close the window, and follow the query that the page shows."""
        shown = analysis.state
        query = None if shown.upload else shown.query
        with self._lock:
            self._lab = state.for_task(self._lab, shown.task)
            self._view = _View(shown.task, query, shown.lab)
        self._worker.wake()

    def order(self, session: SessionState) -> Int64Array | None:
        """Return the selected queries in the table's order, None while the window is closed; next and previous follow it."""
        with self._lock:
            findings = self._service.findings(session.task)
            if not session.lab or findings is None or self._lab.task != session.task:
                return None
            return self._rows(findings, self._lab)

    def commands(self) -> list[tuple[str, Callable[[], None]]]:
        """Return the window's commands for the palette."""
        return [
            ("Save the laboratory's queries as CSV", self._download),
            ("Save a report of the laboratory's queries", self._report),
        ]

    def leave(self) -> None:
        """Stop working for a browser that left."""
        self._left = True
        self._worker.stop()
        self._service.leave(self)

    def _receive(self, kind: str, value: Any) -> None:
        message = messages.decode(kind, value)
        findings = self._service.findings(self._lab.task)
        match message:
            case None:
                return
            case messages.OpenQuery(row):
                self._open(row)
            case messages.OpenPoint() | messages.ShowTip() if findings is not None:
                rows = self._map.queries_at(findings, self._lab, message)
                if isinstance(message, messages.OpenPoint):
                    if rows is not None:
                        self._open(int(rows[0]))
                else:
                    self._tips += 1
                    self._tip.show("" if rows is None else table.tip(findings, self._workspace, rows, self._tips))
            case messages.SaveNote():
                if self._notes.save(message):
                    self._worker.wake()
            case messages.SaveCsv():
                self._download()
            case messages.SaveReport():
                self._report()
            case messages.CloseLab():
                self._change(lambda session: replace(session, lab=False))
            case messages.ResumeWork(work):
                self._service.retry(self._lab.task, work)
                self._update(message)
                self._worker.wake()
            case _:
                self._update(message)

    def _update(self, message: LabMessage) -> None:
        with self._lock:
            if isinstance(message, messages.SelectRectangle):
                changed = self._map.select_rectangle(self._lab, message)
            else:
                changed = messages.apply(message, self._lab, self._service.findings(self._lab.task))
            if changed == self._lab:
                return
            self._lab = changed
        self._worker.wake()

    def _rows(self, findings: Findings, lab: LabState) -> Int64Array:
        """Return the selected queries in the table's order, the same array until the selection or the order changes."""
        key = (
            *(findings, lab.outcome, lab.filter, lab.name_search, lab.selections),
            *(lab.sort_column, lab.descending),
        )
        with self._lock:
            if self._sorted[0] != key:
                self._sorted = key, state.sorted_rows(findings, lab)
            return self._sorted[1]

    def _work(self) -> None:
        self._draw()
        if self._left:  # drawing may have started a computation
            self._service.leave(self)

    def _draw(self) -> None:
        with self._lock:
            lab, view = self._lab, self._view
        if not view.open:
            self._service.leave(self)
            self._place(None)
            return
        self._place(lab.full_height)
        findings = self._service.findings(lab.task)
        if findings is None:
            self._wait_for_table(lab)
            return
        rows = self._rows(findings, lab)
        if lab.tab == "table":
            lab = self._turn_to_query(lab, view, rows)
        self._bar.show(table.bar(findings, lab))
        if lab.text_revision != self._text_revision:  # sending the boxes discards what the user is typing
            self._text_revision = lab.text_revision
            self._boxes.show(table.search_boxes(findings, lab))
        first = lab.page * self._page_length
        self._summary.show(table.summary(findings, lab, rows, (first, self._page_length)))
        choosing = lab.choosing_columns and lab.tab == "table"
        self._columns.show(table.column_choice(findings, lab) if choosing else "")
        if lab.tab == "table":
            page = rows[first : first + self._page_length]
            self._body.show(table.table(findings, lab, self._workspace, page, view.query))
        elif lab.tab == "breakdown":
            self._body.show(breakdown_page.page(findings, lab, self._workspace))
        else:
            html, final = self._map.page(findings, lab, view.query, rows, self._size)
            self._body.show(html)
            if not final:
                self._worker.wake()
        self._tip.show("")
        self._notes.show(findings, view.query if lab.tab == "table" else None)

    def _wait_for_table(self, lab: LabState) -> None:
        paused = "table" in lab.paused
        job = None
        if paused:
            self._service.leave(self, lab.task)
        else:
            job = self._service.build(lab.task, self)
            if job.wait(0.4) and job.error is None:
                self._worker.wake()
                return
        for part in (self._bar, self._boxes, self._summary, self._columns):
            part.show("")
        self._text_revision = None
        self._notes.show(None, None)
        queries = len(self._workspace.tasks[lab.task].queries)
        self._body.show(table.waiting(job, f"Ranking {queries:,} queries", paused, "table"))
        if job is not None and job.error is None:
            self._worker.wake()

    def _turn_to_query(self, lab: LabState, view: _View, rows: Int64Array) -> LabState:
        """Turn to the page of the current query if that changed, and limit the page to those that exist."""
        page = min(max(lab.page, 0), max(-(-len(rows) // self._page_length) - 1, 0))
        if view.query != self._last_query:
            positions = np.flatnonzero(rows == view.query)
            if self._last_query is not None and len(positions):
                page = int(positions[0]) // self._page_length
            self._last_query = view.query
        turned = replace(lab, page=page)
        with self._lock:
            if self._lab is lab:
                self._lab = turned
        return turned

    @property
    def _page_length(self) -> int:
        return min(max((self._size[1] - _FRAME_HEIGHT) // _ROW_HEIGHT, 5), 25)

    def _place(self, full_height: bool | None) -> None:
        """Cover the whole stage or its lower half; None hides the window."""
        if full_height == self._full_height_shown:
            return
        if full_height is not None:
            width, height = self._size = self._viewport.window(share=1.0 if full_height else 1 - _PAIR_SHARE)
            self._panel.float(x=EDGE, y=-EDGE, width=width, height=height)
            self._panel.expand()
        self._panel.visible = full_height is not None
        self._full_height_shown = full_height

    def _resize(self) -> None:
        """Place the window again, because the viewport changed."""
        self._full_height_shown = None if self._full_height_shown is None else not self._full_height_shown
        self._worker.wake()

    def _open(self, row: int) -> None:
        task = self._lab.task
        queries = len(self._workspace.tasks[task].queries)
        if row < queries:
            self._change(
                lambda session: session_state.choose_query(session, row, queries) if session.task == task else session
            )

    def _download(self) -> None:
        findings = self._service.findings(self._lab.task)
        if findings is None:
            return
        rows = self._rows(findings, self._lab)
        name = re.sub(r"[^\w-]+", "-", f"{self._workspace.data_name}-{findings.task.name}-{len(rows)}-queries")
        self._client.send_file_download(f"{name}.csv", findings.table.to_csv(rows), save_immediately=True)

    def _report(self) -> None:
        lab, findings = self._lab, self._service.findings(self._lab.task)
        if findings is None:
            return
        rows, task = [int(row) for row in self._rows(findings, lab)], findings.task
        description = f"{state.describe(findings, lab)} (failure laboratory)"
        self._reporter.make(
            lambda progress, model: reports.of_selection(self._workspace, task, rows, description, progress, model)
        )

    def _show_error(self, error: Exception) -> None:
        known = isinstance(error, LPNError)
        text = str(error) if known else f"{type(error).__name__}: the details are in the server's log."
        self._body.show(table.message(text, False))
