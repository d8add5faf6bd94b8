"""The window of the failure laboratory: one browser's view of all queries, over the lower half of the stage."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import viser

from explorer import reports, session_state
from explorer.browse.feeds import Feeds
from explorer.compute.worker import Worker
from explorer.failure_lab import breakdown_page, map_layout, messages, state, table
from explorer.failure_lab.map_page import MapPage
from explorer.failure_lab.messages import LabMessage
from explorer.failure_lab.note_form import NoteForm
from explorer.failure_lab.service import FailureLab, Findings, SecondProgress
from explorer.failure_lab.state import LabState
from explorer.lab_choices import CHOICES, LabChoices
from explorer.reports import Reporter
from explorer.session_state import SessionState, StateChange
from explorer.stage.viewport import EDGE, Viewport
from explorer.web.html import Html
from explorer.web.render import call, run, run_once
from explorer.workspace import StateAnalysis, Workspace
from lpn.analysis.named_views import NamedView
from lpn.core.arrays import Int64Array
from lpn.core.errors import LPNError
from lpn.drawing.words import say, speaking, spoken

# Share of the stage, from its top, that the compared pair takes, unless that leaves less than so many pixels to the window.
_PAIR_SHARE, _LEAST_HEIGHT = 0.49, 380
_ROW_HEIGHT = 27  # pixels
# Height in pixels of the window without the table, of the line that offers the second model's ranks, and of the lines that say
# that the models are ranked differently.
_FRAME_HEIGHT, _OFFER_HEIGHT, _UNLIKE_HEIGHT = 180, 22, 44
# The page's buttons give the window this name.
_NAME = "All pictures in a table"
# Seconds between two looks at the second model's ranks.
_SECOND_INTERVAL = 0.5


@dataclass(frozen=True)
class _View:
    """The task and the query that the rest of the page shows, and whether the window is open.

    Attributes:
        reasons: the explain window is open.
        order: a script that raises the explain window, where both windows were opened at once, as a link does; else empty.
        beside: which of the models beside the workspace's own is compared.
        plain: plain words are spoken.
    """

    task: str
    query: int | None
    open: bool
    reasons: bool = False
    order: str = ""
    beside: int = 0
    plain: bool = False


class FailureLabWindow:
    """One browser's laboratory. It works on its own thread, so that neither the stage nor the server waits for it."""

    def __init__(
        self,
        client: viser.ClientHandle,
        workspace: Workspace,
        service: FailureLab,
        feeds: Feeds,
        change: Callable[[StateChange], None],
        viewport: Viewport,
        reporter: Reporter,
    ) -> None:
        self._client, self._workspace, self._service, self._change = client, workspace, service, change
        self._feeds, self._viewport, self._reporter = feeds, viewport, reporter
        self._lock = threading.RLock()
        task = next(iter(workspace.tasks))
        self._lab, self._view = LabState(task=task), _View(task, None, False)
        # The index of the second model among those beside the workspace's own.
        self._beside = 0
        self._table_rows = np.zeros(0, np.int64)
        # The task and the choices of an address, until there is a table that they can be applied to.
        self._wanted: tuple[str, LabChoices] | None = None
        self._feed: tuple[object, str] = None, ""
        self._shell: tuple[object, int] = None, 0
        # The result of the last change in the drawer, and whether it succeeded.
        self._drawer_message: tuple[str, bool] | None = None
        # The text of that change, if it failed.
        self._drawer_refused = ""
        self._sorted: tuple[object, Int64Array] = ((), np.zeros(0, np.int64))
        self._full_height_shown: bool | None = None
        self._resized = False
        self._size = (760, 400)
        self._tips = 0
        self._left = False
        self._text_revision: int | None = None
        self._map = MapPage(service, feeds, self)
        gui = client.gui
        self._panel = gui.add_panel(visible=False)
        self._tab = self._panel.add_tab(_NAME, viser.Icon.FLASK)
        with self._tab:
            self._bar, self._boxes, self._summary, self._drawer, self._second, self._controls = (
                Html(gui) for _ in range(6)
            )
            # The script of `_data` runs again when the page shows the window again.
            self._body, self._data = Html(gui), Html(gui)
            self._notes = NoteForm(gui, service)
            self._tip, self._order = Html(gui), Html(gui)
        self._worker = Worker(self._work, self._show_error)
        # The second model's ranks take their own thread, so that the table need not be drawn anew to tell how far they are.
        self._second_worker = Worker(self._follow_second, self._show_error)
        viewport.watch(self._resize)

    def show(self, analysis: StateAnalysis) -> None:
        """Open or close the window, and follow the query that the page shows."""
        session = analysis.state
        query = None if session.upload else session.query
        with self._lock:
            self._lab = state.for_task(self._lab, session.ranking_key)
            before, reasons = self._view, session.shows_reasons
            order = before.order if session.lab else ""
            if session.lab and not before.open and reasons and not before.reasons:
                order = run_once(call("raiseReasons"))
            self._view = _View(session.ranking_key, query, session.lab, reasons, order, session.beside, session.plain)
        self._worker.wake()

    def restore(self, session: SessionState, whole: bool = False) -> None:
        """Show what a state says of the laboratory, as soon as there is a table.

        Args:
            whole: the state has the choices of a closed laboratory, too; an address has them only of an open one.
        """
        with self._lock:
            self._lab = state.for_task(self._lab, session.ranking_key)
            if session.lab or whole:
                self._wanted = session.ranking_key, session.laboratory
        self._worker.wake()

    def order(self, session: SessionState) -> Int64Array | None:
        """Return the selected queries in the table's order, None while the window is closed; next and previous follow it."""
        with self._lock:
            findings = self._findings(session.ranking_key)
            if not session.lab or findings is None or self._lab.task != session.ranking_key:
                return None
            return self._rows(findings, self._lab)

    def _findings(self, task: str) -> Findings | None:
        return self._service.findings(task, self._beside)

    def commands(self) -> list[tuple[str, Callable[[], None]]]:
        """Return the window's commands for the palette."""
        return [
            ("Save the table's pictures as CSV", self._download),
            ("Save a report of the table's pictures", self._report),
        ]

    def leave(self) -> None:
        """Stop working for a browser that left."""
        self._left = True
        self._worker.stop()
        self._second_worker.stop()
        self._service.leave(self)
        self._service.leave_second(self)
        self._feeds.leave(self)
        self._map.leave()

    def receive(self, message: LabMessage) -> None:
        """Do what a message of the window's HTML asks for."""
        findings = self._findings(self._lab.task)
        match message:
            case messages.OpenQuery(row):
                self._open(row)
            case messages.OpenPoint() | messages.ShowTip() if findings is not None:
                rows = self._map.queries_at(findings, self._lab, message)
                if isinstance(message, messages.OpenPoint):
                    if rows is not None:
                        self._open(int(rows[0]))
                else:
                    self._tips += 1
                    with speaking(self._workspace.vocabulary(self._view.plain)):
                        self._tip.show("" if rows is None else table.tip(findings, self._workspace, rows, self._tips))
            case messages.SaveNote():
                if self._notes.save(message):
                    self._worker.wake()
            case messages.TagChosen() | messages.SaveView() | messages.RemoveView() | messages.OpenView():
                if findings is not None:
                    self._change_drawer(message, findings)
            case messages.SaveCsv():
                self._download()
            case messages.SaveReport():
                self._report()
            case messages.OpenSecond() | messages.ShowBothMaps(True):
                self._update(message)
                self._service.open_second(self._beside)
                self._second_worker.wake()
            case messages.ScoreSecond():
                self._service.score_second(self, self._beside)
                self._second_worker.wake()
                self._worker.wake()
            case messages.CloseLab():
                self._change(lambda session: replace(session, lab=False))
            case messages.ResumeWork(work):
                self._service.retry(self._lab.task, work)
                self._update(message)
                self._worker.wake()
            case _:
                self._update(message)

    def _drawn_drawer(self, findings: Findings, lab: LabState, selected: int, chosen: int) -> str:
        views: tuple[NamedView, ...] = ()
        if lab.drawer == "views":
            try:
                views = self._service.views(lab.task)
            except LPNError as error:
                self._drawer_message = str(error), False
        return table.drawer(findings, lab, selected, views, self._drawer_message, chosen, self._drawer_refused)

    def _change_drawer(self, message: LabMessage, findings: Findings) -> None:
        """Tag the selected queries, or save, open, or remove a view; tell the result in the drawer."""
        with self._lock:
            lab = self._lab
        try:
            match message:
                case messages.TagChosen(tags):
                    rows = state.chosen_or_all(lab, self._rows(findings, lab))
                    self._service.add_tags([findings.table.paths[row] for row in rows.tolist()], tags)
                    what = say("query", len(rows))
                    result = f"{len(rows):,} {what} {'is' if len(rows) == 1 else 'are'} tagged in {self._service.notes_place}."
                case messages.SaveView(name):
                    view = state.to_view(findings, lab, name)
                    names = [other.name for other in self._service.views(view.task)]
                    self._service.save_view(view)
                    replaced = ", in place of the view of this name" if view.name in names else ""
                    result = f"Saved in {self._service.views_place}{replaced}."
                case messages.RemoveView(name):
                    self._service.remove_view(lab.task, name)
                    result = ""
                case messages.OpenView(name):
                    result = ""
                    for view in self._service.views(lab.task):
                        if view.name == name:
                            with self._lock:
                                self._lab = opened = state.from_view(findings, self._lab, view)
                            self._tell(opened)
            self._drawer_message, self._drawer_refused = (result, True) if result else None, ""
        except LPNError as error:
            self._drawer_message, self._drawer_refused = (str(error), False), ""
            match message:
                case messages.TagChosen(text) | messages.SaveView(text):
                    self._drawer_refused = text
        self._worker.wake()

    def _update(self, message: LabMessage) -> None:
        with self._lock:
            if isinstance(message, messages.ToggleDrawer):
                self._drawer_message, self._drawer_refused = None, ""
            if isinstance(message, messages.SelectLasso):
                changed = self._map.select_lasso(self._lab, message)
            else:
                changed = messages.apply(message, self._lab, self._findings(self._lab.task))
            if changed == self._lab:
                return
            self._lab = changed
            if self._wanted is not None and isinstance(message, messages.SetFullHeight):
                self._wanted = self._wanted[0], replace(self._wanted[1], full_height=changed.full_height)
        self._tell(changed)
        if isinstance(message, messages.OF_CHARTS):
            self._show_one(changed)
        self._worker.wake()

    def _show_one(self, lab: LabState) -> None:
        """Show the first of the selected queries, unless the page shows one of them."""
        findings = self._findings(lab.task)
        if findings is None or not lab.selections:
            return
        rows = self._rows(findings, lab)
        if len(rows) and self._view.query not in rows:
            self._open(int(rows[0]))

    def _tell(self, lab: LabState) -> None:
        """Let the address follow, unless the laboratory has yet to show what the address says."""
        with self._lock:
            if self._wanted is not None and self._wanted[0] == lab.task:
                return
        choices = state.choices(lab)
        self._change(
            lambda session: replace(session, laboratory=choices) if session.ranking_key == lab.task else session
        )

    def _rows(self, findings: Findings, lab: LabState) -> Int64Array:
        """Return the selected queries in the table's order, the same array until the selection or the order changes."""
        key = findings, *(getattr(lab, choice.field) for choice in CHOICES if choice.selects or choice.orders)
        with self._lock:
            if self._sorted[0] != key:
                rows, before = state.sorted_rows(findings, lab), self._sorted[1]
                self._sorted = key, before if np.array_equal(rows, before) else rows
            return self._sorted[1]

    def _work(self) -> None:
        with speaking(self._workspace.vocabulary(self._view.plain)):
            self._draw()
        if self._left:  # drawing may have started a computation
            self._service.leave(self)

    def _draw(self) -> None:
        with self._lock:
            switched, self._beside = self._beside != self._view.beside, self._view.beside
            findings = self._findings(self._lab.task)
            wanted, restored = self._wanted, False
            if findings is not None and switched:  # a filter may name ranks that are not known yet
                self._lab, restored = state.with_choices(findings, self._lab, state.choices(self._lab)), True
            if findings is not None and wanted is not None and wanted[0] == self._lab.task:
                self._lab, self._wanted, restored = state.with_choices(findings, self._lab, wanted[1]), None, True
            lab, view = self._lab, self._view
        if restored:
            self._tell(lab)
        if not view.open:
            self._service.leave(self)
            self._service.leave_second(self)
            self._place(None)
            return
        tall = lab.covers_stage(self._viewport.width >= map_layout.WIDE)
        self._place(tall)
        self._order.show(view.order)
        if findings is None:
            self._wait_for_table(lab)
            return
        preparing = self._service.scores_second(self._beside)
        if findings.second is not None and not preparing:
            self._second.show(table.second_progress(SecondProgress(self._service.second_failure(self._beside))))
        elif self._workspace.beside:
            self._second_worker.wake()
        rows = self._rows(findings, lab)
        chosen = state.chosen_rows(lab, rows)
        self._bar.show(table.bar(findings, lab, len(rows), len(chosen), tall))
        if lab.text_revision != self._text_revision:  # sending the boxes discards what the user is typing
            self._text_revision = lab.text_revision
            self._boxes.show(table.search_boxes(findings, lab))
        self._summary.show(table.summary(findings, lab, rows, len(chosen), preparing))
        self._drawer.show(self._drawn_drawer(findings, lab, len(rows), len(chosen)))
        if lab.tab != "maps":
            self._controls.show("")
        if lab.tab == "table":
            self._show_table(findings, lab, view.query, rows)
        elif lab.tab == "breakdown":
            self._body.show(breakdown_page.page(findings, lab, self._workspace))
        else:
            offered = bool(self._workspace.beside)
            if lab.both_maps and lab.map != "ground":
                self._service.open_second(self._beside, again=False)
            drawn = self._map.page(findings, lab, view.query, rows, self._size, self._beside, offered)
            self._controls.show(drawn.controls)  # before the script that fills them
            self._body.show(drawn.maps)
            self._data.show(drawn.script)
            if not drawn.final:
                self._worker.wake()
        self._tip.show("")
        self._notes.show(findings, None if lab.tab == "breakdown" else view.query)

    def _follow_second(self) -> float | None:
        """Wait for the second model's ranks while the window is open, and say how far they are."""
        with self._lock:
            task, is_open = self._lab.task, self._view.open
        if not is_open:
            return None
        progress = self._service.join_second(task, self, self._beside)
        self._second.show(table.second_progress(progress))
        findings = self._findings(task)
        if findings is not None and findings.second is not None and not progress.pending:
            self._worker.wake()
        if self._left:
            self._service.leave_second(self)
        return _SECOND_INTERVAL if progress.pending else None

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
        for part in (self._bar, self._boxes, self._summary, self._second, self._drawer, self._controls):
            part.show("")
        self._text_revision = None
        self._notes.show(None, None)
        queries = len(self._workspace.rankings[lab.task].task.queries)
        self._body.show(table.waiting(job, f"Ranking {queries:,} queries", paused, "table"))
        if job is not None and job.error is None:
            self._worker.wake()

    def _show_table(self, findings: Findings, lab: LabState, query: int | None, rows: Int64Array) -> None:
        """Show the table of the selected queries; its rows are published again only when something in them changed."""
        if rows is not self._table_rows:
            self._table_rows, self._feed, self._shell = rows, (None, ""), (None, self._shell[1])
        key = findings, lab.columns, spoken()
        if self._feed[0] != key:
            self._feed = key, table.publish(self._feeds, self, findings, lab, rows)
        feed = self._feed[1]
        # A table of other columns or rows is another element, which begins at its top.
        shell = lab.columns, lab.sort_column, lab.descending
        if self._shell[0] != shell:
            self._shell = shell, self._shell[1] + 1
        offered = bool(self._workspace.beside) and findings.second is None
        unlike = findings.second is not None and not findings.second.alike
        frame = _FRAME_HEIGHT + _OFFER_HEIGHT * offered + _UNLIKE_HEIGHT * unlike
        height = max(self._size[1] - frame, 6 * _ROW_HEIGHT)
        self._body.show(table.table(findings, lab, len(rows), self._shell[1], height))
        if not len(rows):
            self._data.show("")
            return
        places = np.flatnonzero(rows == query)
        chosen = int(places[0]) if len(places) else -1
        data = {
            "kind": "table",
            "shell": self._shell[1],
            "address": self._feeds.address,
            "feed": feed,
            "total": len(rows),
            "marked": table.runs(np.isin(rows, list(lab.rows))),
        }
        self._data.show(run(call("list", "lpn-lab-rows", {**data, "chosen": chosen, "height": height})))

    def _place(self, full_height: bool | None) -> None:
        """Cover the whole stage or its lower half; None hides the window."""
        with self._lock:
            resized, self._resized = self._resized, False
        if full_height == self._full_height_shown and not resized:
            return
        if full_height is not None:
            width, height = self._size = self._viewport.window(share=1.0 if full_height else self._share)
            self._panel.float(x=EDGE, y=-EDGE, width=width, height=height)
            self._panel.expand()
        self._panel.visible = full_height is not None
        self._full_height_shown = full_height

    @property
    def _share(self) -> float:
        """Share of the stage's height that the window takes below the compared pair."""
        return min(max(1 - _PAIR_SHARE, _LEAST_HEIGHT / self._viewport.height), 1.0)

    def _resize(self) -> None:
        """Place the window again, because the viewport changed."""
        with self._lock:
            self._resized = True
        self._worker.wake()

    def _open(self, row: int) -> None:
        task = self._lab.task
        queries = len(self._workspace.rankings[task].task.queries)
        if row < queries:
            self._change(
                lambda session: (
                    session_state.choose_query(session, row, queries) if session.ranking_key == task else session
                )
            )

    def _download(self) -> None:
        findings = self._findings(self._lab.task)
        if findings is None:
            self._say_no_table()
            return
        rows = state.chosen_or_all(self._lab, self._rows(findings, self._lab))
        name = re.sub(r"[^\w-]+", "-", f"{self._workspace.data_name}-{findings.task.name}-{len(rows)}-queries")
        self._client.send_file_download(f"{name}.csv", findings.table.to_csv(rows), save_immediately=True)

    def _say_no_table(self) -> None:
        self._client.add_notification(
            "No table yet", f"Its rows are computed while “{_NAME}” is open; open it with B first."
        )

    def _report(self) -> None:
        lab, findings = self._lab, self._findings(self._lab.task)
        if findings is None:
            self._say_no_table()
            return
        listed = self._rows(findings, lab)
        rows, task = state.chosen_or_all(lab, listed).tolist(), findings.task
        chosen = f"{state.count_rows(len(rows))} of: " if len(rows) < len(listed) else ""
        description = f"{chosen}{state.describe(findings, lab)} ({_NAME})"
        self._reporter.make(
            lambda progress, model: reports.of_selection(self._workspace, task, rows, description, progress, model)
        )

    def _show_error(self, error: Exception) -> None:
        known = isinstance(error, LPNError)
        text = str(error) if known else f"{type(error).__name__}: the details are in the server's log."
        self._body.show(table.message(text, False))
