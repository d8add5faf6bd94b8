"""The calls of project functions between a turn's message and its sent result."""

from __future__ import annotations

import re
import threading
from contextlib import closing
from pathlib import Path
from types import FrameType
from typing import TYPE_CHECKING, cast

from tools.keep.measures import Figures, Measure, Value, at_most, reported

if TYPE_CHECKING:
    from tools.fixtures.screen_tab import ScreenTab

_WARM, _TURNS = 3, 5
# Seconds without a message, after which nothing goes on behind a result.
_PAUSE = 1.0
# The thread of the event loop, which receives and sends; it is the only one without a name of its own.
_CONNECTIONS = "connections"
# Functions of Python that wake another thread.
_HANDOVERS = ("submit", "set", "set_result", "notify", "notify_all", "call_soon_threadsafe", "run_in_executor")
# Threads of what goes on behind a result.
_BEHIND = ("explorer-job", "explorer-ranking")
_COMPREHENSIONS = ("<genexpr>", "<listcomp>", "<dictcomp>", "<setcomp>")

# The functions of a stack by the thread's name, the outermost first.
_Paths = dict[str, list[str]]


def calls() -> Figures:
    """Count the calls of project functions on the longest path of a turn.

    The app serves the demo to one tab of the channel over a real connection. The tab sets another angle, as the page does when
    the photo is turned. A turn begins with its message, and ends when the result is handed to the connection.

    In each thread the deepest stack of the turn counts: the frames of functions of `lpn` and `explorer` on it, without
    comprehensions and templates. "calls" is the sum over all threads. "calls at handovers" counts likewise the deepest stack
    from which a thread wakes another one or hands the result over. Threads of one pool count as one, and timers do not count.
    After warm turns, the turn of the median count is told.
    """
    from explorer.app import App
    from explorer.opening import open_model
    from lpn.core.demo import DEMO, DEMO_MODEL
    from lpn.retrieval.csls import NEIGHBOURS
    from tools.fixtures.screen_tab import ScreenTab

    recorder = _Recorder()
    threading.setprofile(recorder.profile)  # for threads that start from here on
    try:
        with closing(App(open_model(DEMO, DEMO_MODEL, csls=NEIGHBOURS), "127.0.0.1", 0)) as app:
            url = f"http://127.0.0.1:{app.server.get_port()}"
            with ScreenTab(url, origin=url) as tab:
                tab.open()
                turns = [_turn(recorder, tab, 10 + 7 * number) for number in range(_WARM + _TURNS)][_WARM:]
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


def _turn(recorder: _Recorder, tab: ScreenTab, angle: float) -> tuple[_Paths, _Paths]:
    while tab.receive(_PAUSE):  # what goes on behind the last result, such as its curve
        pass
    recorder.begin(f'"angle":{angle:g}')
    tab.turn(angle)
    return recorder.end()


class _Recorder:
    """Keeps the deepest stacks of each thread while a turn goes on."""

    def __init__(self) -> None:
        import explorer
        import lpn

        self._roots = tuple(f"{Path(str(package.__file__)).parent}/" for package in (lpn, explorer))
        self._active = False

    def begin(self, mark: str) -> None:
        """Start recording; the result is the first message with the mark that a connection sends."""
        self._mark, self._ended = mark, False
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
        if not self._active or self._ended or event != "call" or isinstance(thread, threading.Timer):
            return
        name = _CONNECTIONS if thread.name.startswith("Thread-") else re.sub(r"[-_]\d+", "", thread.name)
        if name in _BEHIND:
            return
        if self._is_own(frame):
            self._record(self._deepest, name, frame)
        elif frame.f_code.co_name in _HANDOVERS:
            self._record(self._handovers, name, frame)
        elif frame.f_code.co_name == "send" and self._is_result(frame.f_locals.get("message")):
            self._record(self._handovers, name, frame)
            self._ended = True

    def _is_result(self, message: object) -> bool:
        return isinstance(message, str) and message.startswith('{"result"') and self._mark in message

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
