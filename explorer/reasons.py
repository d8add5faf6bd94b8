"""The window of reasons: evidence, true against wrong, profiles, and search by a region, in tabs of one movable panel."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import viser

from explorer import against, profiles, region, reporting, session, why
from explorer.against import Contest
from explorer.beside import Beside
from explorer.bridge import send
from explorer.exhibit import Answer, Exhibit
from explorer.html import Html
from explorer.reporting import Reporter
from explorer.room import EDGE, Room
from explorer.session import State
from explorer.worker import Worker
from lpn import sweeps, versus
from lpn.sweeps import Over, Point, Profile
from lpn.versus import Effect

Change = Callable[[State], State | None]
_WIDTH, _HEIGHT = 1000, 900
CLOSE = f"<div class='lpn'><a class='close' {send('close')} title='Close (Y)'>✕</a></div>"
_OFTEN = 0.15
"""Seconds between two drawings of a profile that is being computed."""


class Reasons:
    """One browser's window; it shows answers while the state says that it is open.

    Args:
        change: replaces the browser's state by a function's result.
        failed: is told of what went wrong in long work.
        room: that the stage has for the window.
        reporter: makes reports of what is shown.
    """

    def __init__(
        self,
        client: viser.ClientHandle,
        exhibit: Exhibit,
        change: Callable[[Change], None],
        failed: Callable[[Exception], None],
        room: Room,
        reporter: Reporter,
    ) -> None:
        self._client, self._exhibit, self._change, self._room = client, exhibit, change, room
        self._reporter = reporter
        self._answer: Answer | None = None
        self._contest: Contest | None = None
        self._effect: Effect | None = None
        self._over: Over | None = None
        self._points: list[Point] = []
        self._of = 0
        self._asked: str | None = None
        self._cancelled = threading.Event()
        self._open = False
        gui = client.gui
        self._panel = gui.add_panel(visible=False)
        pages: list[Html] = []
        tabs = [
            ("Why", viser.Icon.ZOOM_QUESTION),
            ("True or wrong", viser.Icon.SCALE),
            ("Turn, shift, zoom", viser.Icon.CHART_LINE),
            ("Search by a region", viser.Icon.BRUSH),
        ]
        self._other = None if exhibit.beside is None else Beside(exhibit.beside)
        if self._other is not None:
            tabs.append(("Two models", viser.Icon.COLUMNS_2))
        for name, icon in tabs:
            with self._panel.add_tab(name, icon):
                gui.add_html(CLOSE)
                pages.append(Html(gui))
        self._why, self._versus, self._profile, self._region = pages[:4]
        self._beside = pages[-1]
        self._worker = Worker(self._work, failed)

    def handlers(self) -> dict[str, Callable[[Any], None]]:
        """What the window's html may ask for, whatever the values."""
        return {
            "close": lambda _: self._change(lambda state: replace(state, why=False)),
            "part": self._part,
            "compare": self._compare,
            "query": self._query,
            "weigh": self._weigh,
            "effect": lambda _: self._ask("effect"),
            "report": self._report,
            "sweep": self._sweep,
            "cancel": lambda _: self._cancelled.set(),
            "take": self._take,
            "region": self._paint,
        }

    def leave(self) -> None:
        """The browser is gone: stop what is being computed."""
        self._cancelled.set()
        self._worker.stop()

    def show(self, answer: Answer) -> None:
        """Open or close the window, and fill it."""
        before, self._answer = self._answer, answer
        if before is None or _asks(before) != _asks(answer):
            self._cancelled.set()
            self._over, self._points = None, []
        if answer.state.why:
            if before is None or before.ranking is not answer.ranking or before.chosen.index != answer.chosen.index:
                self._contest, self._effect = Contest.of(answer), None
            self._draw()
        if answer.state.why != self._open:
            self._open = answer.state.why
            if self._open:
                self._place()
            self._panel.visible = self._open

    def _draw(self) -> None:
        answer = self._answer
        assert answer is not None
        self._why.show(why.page(answer, self._exhibit))
        self._draw_versus(answer)
        self._draw_profile(answer)
        self._region.show(region.page(answer, self._exhibit))
        if self._other is not None:
            self._beside.show(self._other.page(answer, self._exhibit))

    def _draw_versus(self, answer: Answer) -> None:
        busy = self._asked == "effect"
        self._versus.show(against.page(answer, self._exhibit, self._contest, self._effect, busy))

    def _draw_profile(self, answer: Answer) -> None:
        points = tuple(self._points)
        profile = Profile(self._over, points) if self._over and points else None
        self._profile.show(profiles.page(answer, self._over, profile, self._of, self._exhibit.part_names))

    def _place(self) -> None:
        """Over the stage, as large as it has room for."""
        width, height = self._room.window((_WIDTH, _HEIGHT))
        self._panel.float(x=EDGE, y=EDGE, width=width, height=height)
        self._panel.expand()

    def _ask(self, what: str) -> None:
        """Have something long computed; what was being computed is given up."""
        self._cancelled.set()
        self._asked = what
        self._worker.wake()

    def _work(self) -> None:
        asked, answer = self._asked, self._answer
        self._cancelled.clear()
        try:
            if answer is not None and asked == "effect":
                self._measure(answer)
            elif answer is not None and asked in profiles.CHOICES:
                self._profiled(answer, asked)
        finally:
            if self._asked == asked:
                self._asked = None

    def _measure(self, answer: Answer) -> None:
        contest, task = self._contest, answer.task
        if contest is None or contest.change is None:
            return
        self._draw_versus(answer)
        found = versus.effect(
            task.asked, task.descriptors, answer.ranking.weights, contest.change.weights, task.query_labels, task.labels,
            task.truth,
        )  # fmt: skip
        if self._contest is contest and self._answer is not None:
            self._effect, self._asked = found, None
            self._draw_versus(self._answer)

    def _report(self, _: Any) -> None:
        answer = self._answer
        if answer is not None:
            self._reporter.make(lambda progress: reporting.of_answer(self._exhibit, answer, progress))

    def _profiled(self, answer: Answer, over: Over) -> None:
        exhibit, task, state = self._exhibit, answer.task, answer.state
        assert exhibit.model is not None
        height, width = exhibit.spec.input_size
        entry, side = task.queries[state.query], height if over == "shift-down" else width
        changes = [change.of(entry) for change in sweeps.changes_over(over, side=side)]
        self._over, self._points, self._of = over, [], len(changes)
        known = None if state.upload else state.query
        steps = sweeps.profile(
            exhibit.model, answer.source, task.query_view, task.descriptors, answer.ranking.weights, changes, task.labels,
            None if known is None else int(task.query_labels[known]),
            None if known is None or task.truth is None else task.truth[known],
            None if answer.truth else answer.chosen.index,
        )  # fmt: skip
        drawn = 0.0
        self._draw_profile(answer)
        for point in steps:
            if self._cancelled.is_set():
                break
            self._points.append(point)
            if time.monotonic() - drawn > _OFTEN:
                self._draw_profile(self._answer or answer)
                drawn = time.monotonic()
        if not self._cancelled.is_set() or self._over == over:
            self._of = len(self._points)
            self._draw_profile(self._answer or answer)

    def _part(self, value: Any) -> None:
        part = session.whole(value, 0, self._exhibit.spec.n_parts - 1)
        if part is not None or value is None:
            self._change(lambda state: replace(state, heat_part=part))

    def _compare(self, value: Any) -> None:
        answer = self._answer
        index = session.whole(value, 0, len(answer.task.gallery) - 1) if answer else None
        if answer is not None and index is not None:
            self._change(lambda state: session.compare(state, answer.state, index))

    def _query(self, value: Any) -> None:
        def chosen(state: State) -> State:
            queries = len(self._exhibit.tasks[state.task].queries)
            query = session.whole(value, 0, queries - 1)
            return state if query is None else session.choose(state, query, queries)

        self._change(chosen)

    def _weigh(self, _: Any) -> None:
        contest = self._contest
        if contest is not None and contest.change is not None:
            # As the sliders count: equal weights are 1 each, and none is more than the slider's end.
            scaled = contest.change.weights * min(
                len(contest.change.weights), session.MAX_WEIGHT / contest.change.weights.max()
            )
            weights = tuple(float(weight) for weight in scaled)
            self._change(lambda state: replace(state, weights=weights, enabled=()))

    def _sweep(self, value: Any) -> None:
        if value in list(profiles.CHOICES):
            self._ask(value)

    def _take(self, value: Any) -> None:
        self._change(lambda state: session.taken(state, value, self._exhibit.spec.input_size))

    def _paint(self, value: Any) -> None:
        answer = self._answer
        if answer is not None:
            rows, columns = self._exhibit.map_sizes[answer.task.query_view]
            cells = session.painted(value, rows * columns)
            if cells is not None:
                self._change(lambda state: replace(state, region=cells))


def _asks(answer: Answer) -> object:
    """What a profile is of."""
    state = answer.state
    return state.task, state.query, state.upload, tuple(answer.ranking.weights.tolist())
