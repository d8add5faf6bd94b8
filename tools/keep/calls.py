"""The calls of project functions between a turn's message and its sent result."""

from __future__ import annotations

import re
import threading
import time
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import Any, cast

from tools.keep.measures import Figures, Measure, Value, at_most, reported

_WARM, _TURNS = 3, 5
# Seconds for what goes on after an answer to end, before the next turn.
_PAUSE = 1.0
# The thread in which viser receives and sends; it is the only one without a name of its own.
_CONNECTIONS = "connections"
# Functions of Python and viser that wake another thread or take a message.
_HANDOVERS = ("queue_message", "submit", "set", "set_result", "notify", "notify_all")
_COMPREHENSIONS = ("<genexpr>", "<listcomp>", "<dictcomp>", "<setcomp>")

# The functions of a stack by the thread's name, the outermost first.
_Paths = dict[str, list[str]]


def calls() -> Figures:
    """Count the calls of project functions on the longest path of a turn.

    The app serves the demo's workbench to a client over a real connection. The client turns the query by a new angle, as a
    browser does when the slider moves. A turn begins with its message. It ends when the answer's status is handed to viser, and
    in the thread of the connections when the client has it.

    In each thread the deepest stack of the turn counts: the frames of functions of `lpn` and `explorer` on it, without
    comprehensions and templates. "calls" is the sum over all threads. "calls at handovers" counts likewise the deepest stack
    from which a thread wakes another one or hands viser a message. Threads of one pool count as one, and timers do not count.
    After warm turns, the turn of the median count is told.
    """
    from explorer.app import App
    from explorer.opening import open_model
    from lpn.core.demo import DEMO, DEMO_MODEL
    from lpn.retrieval.csls import NEIGHBOURS
    from tools.fixtures.websocket_client import WebSocketClient

    recorder = _Recorder()
    threading.setprofile(recorder.profile)  # for threads that start from here on
    try:
        # The baseline's page ranked by CSLS; by another scoring, other tiles are drawn for the first time.
        with closing(App(open_model(DEMO, DEMO_MODEL, csls=NEIGHBOURS), "127.0.0.1", 0)) as app:
            url = f"http://127.0.0.1:{app.server.get_port()}"
            with WebSocketClient(url, origin=url) as client:
                client.greet()
                turns = [_turn(recorder, client, 10 + 7 * number) for number in range(_WARM + _TURNS)][_WARM:]
    finally:
        threading.setprofile(None)
    deepest, handovers = sorted(turns, key=lambda turn: _count(turn[0]))[_TURNS // 2]
    figures: dict[str, Value] = {"calls": _count(deepest), "calls at handovers": _count(handovers)}
    for kind, paths in (("path", deepest), ("handover", handovers)):
        for thread, names in paths.items():
            figures[f"{kind} of {thread}"] = " > ".join(names)
            print(f"{kind} of {thread}, {len(names)}", *names, sep="\n    ")
    return figures


def _count(paths: _Paths) -> int:
    return sum(map(len, paths.values()))


def _turn(recorder: _Recorder, client: Any, angle: int) -> tuple[_Paths, _Paths]:
    recorder.begin(f'data-angle="{angle}"')
    client.set("Rotate", angle)
    client.wait(lambda: client.status("angle") == str(angle))
    paths = recorder.end()
    time.sleep(_PAUSE)
    return paths


class _Recorder:
    """Keeps the deepest stacks of each thread while a turn goes on."""

    def __init__(self) -> None:
        import explorer
        import lpn

        self._roots = tuple(f"{Path(str(package.__file__)).parent}/" for package in (lpn, explorer))
        self._active = False

    def begin(self, mark: str) -> None:
        """Start recording; the answer is the first message to viser whose text has the mark."""
        self._mark, self._answering = mark, ""
        self._deepest: _Paths = {}
        self._handovers: _Paths = {}
        self._active = True

    def end(self) -> tuple[_Paths, _Paths]:
        """Stop recording, and return each thread's deepest stack of all, and its deepest one at a handover."""
        self._active = False
        return self._deepest, self._handovers

    def profile(self, frame: FrameType, event: str, _: object) -> None:
        """Record a call; a function for `sys.setprofile`."""
        thread = threading.current_thread()
        if not self._active or event != "call" or isinstance(thread, threading.Timer):
            return
        name = _CONNECTIONS if thread.name.startswith("Thread-") else re.sub(r"[-_]\d+", "", thread.name)
        if self._answering and name != _CONNECTIONS:
            return
        if self._is_own(frame):
            self._record(self._deepest, name, frame)
        elif frame.f_code.co_name in _HANDOVERS:
            self._record(self._handovers, name, frame)
            updates = getattr(frame.f_locals.get("message"), "updates", {})
            if self._mark in str(updates.get("content")):
                self._answering = name

    def _is_own(self, frame: FrameType) -> bool:
        code = frame.f_code
        own = code.co_filename.startswith(self._roots) and code.co_filename.endswith(".py")
        return own and code.co_name not in _COMPREHENSIONS

    def _record(self, paths: _Paths, thread: str, frame: FrameType) -> None:
        names, at = list[str](), cast("FrameType | None", frame)
        while at is not None:
            if self._is_own(at):
                names.append(f"{at.f_globals['__name__']}.{at.f_code.co_qualname}")
            at = at.f_back
        if len(names) > len(paths.get(thread, [])):
            paths[thread] = names[::-1]


MEASURES = (Measure("calls", calls, {"calls": at_most(), "calls at *": at_most(), "* of *": reported()}, slow=True),)
