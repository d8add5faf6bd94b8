"""The explorer as a process: it stops on Ctrl-C and SIGTERM, whatever it is doing; no write is lost, and no token is logged."""

from __future__ import annotations

import contextlib
import re
import shutil
import socket
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from explorer.server.page_server import CLOSE_TIMEOUT
from lpn.tasks.notes import read_notes
from tools.fixtures import small_worlds
from tools.fixtures.processes import SOON, Process
from tools.fixtures.screen_tab import ScreenTab

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX's")

SLOW_ANSWERS = """
import time
from explorer.screen.session import ScreenSession
answer = ScreenSession._answer
def slow(self, state):
    if state.angle:
        print("answering", flush=True)
        time.sleep(600)
    return answer(self, state)
ScreenSession._answer = slow
"""
SLOW_NOTES = """
import time, lpn.core.own_files
write = lpn.core.own_files.write_atomic
def slow(*given):
    print("writing", flush=True)
    time.sleep(SECONDS)
    write(*given)
lpn.core.own_files.write_atomic = slow
from pathlib import Path
from explorer.screen.session import ScreenSession
from lpn.tasks import notes
ScreenSession._random = lambda *_: notes.set_note(Path(PLACE), "a.png", "night", "It must not be lost.")
"""
SLOW_OPENING = """
import time, lpn.descriptors.writer as d
prepare_row = d.prepare_row
d.prepare_row = lambda *given: (print("describing", flush=True), time.sleep(0.5), prepare_row(*given))[2]
"""


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("stopping") / "places", train=1, test=4)


class Explorer(Process):
    """`lpn explore`, and browsers that are connected to it."""

    def __init__(self, data: Path, model: Path, cache: Path, before: str = "", **environment: str) -> None:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            self.port = probe.getsockname()[1]
        given: list[object] = ["explore", data, "--model", model, "--port", self.port]
        super().__init__(given, cache, before, **environment)

    @contextlib.contextmanager
    def browsers(self, count: int) -> Iterator[list[ScreenTab]]:
        self.until(lambda: re.search(r"ready: http://", self.out))
        with contextlib.ExitStack() as all_of_them:
            tabs = [all_of_them.enter_context(ScreenTab(f"http://127.0.0.1:{self.port}")) for _ in range(count)]
            for tab in tabs:
                tab.open("?query=0003")
            yield tabs

    def stopped(self) -> float:
        """Assert that it ended well; return the seconds that this took."""
        status, seconds = self.ended(SOON)
        assert status == 0, self.err
        assert self.out.endswith("Stopped.\n")
        assert self.err == ""
        return seconds


def test_with_browsers_connected_it_is_quiet(places: Path, model_file: Path, tmp_path: Path) -> None:
    with Explorer(places, model_file, tmp_path / "cache") as explorer, explorer.browsers(4) as tabs:
        tabs[0].turn(30)
        tabs[0].socket.send("no JSON")
        socket.create_connection(("127.0.0.1", explorer.port)).close()  # as browsers do ahead, and port scans
        explorer.interrupt()
        explorer.stopped()
        assert all(tab.closed() for tab in tabs)


def test_in_the_middle_of_an_answer(places: Path, model_file: Path, tmp_path: Path) -> None:
    with Explorer(places, model_file, tmp_path / "cache", SLOW_ANSWERS) as explorer, explorer.browsers(2) as tabs:
        tabs[0].set(angle=30)
        explorer.until(lambda: "answering" in explorer.out)
        explorer.terminate()
        explorer.stopped()


@pytest.mark.parametrize("seconds", [0.8, CLOSE_TIMEOUT + 1.5])
def test_a_note_that_is_being_saved_is_saved(seconds: float, places: Path, model_file: Path, tmp_path: Path) -> None:
    data = shutil.copytree(places, tmp_path / "places")
    slow = SLOW_NOTES.replace("SECONDS", str(seconds)).replace("PLACE", repr(str(data / "notes.csv")))
    with Explorer(data, model_file, tmp_path / "cache", slow) as explorer, explorer.browsers(1) as tabs:
        tabs[0].act("random")
        explorer.until(lambda: "writing" in explorer.out)
        explorer.interrupt()
        if seconds < CLOSE_TIMEOUT:
            explorer.stopped()
        else:
            assert explorer.ended()[0] == 0
            assert "Stopped.\n" in explorer.out  # viser may say so later, as nothing waits for it any more
            assert explorer.err.endswith("A file is still being written\n")
    assert [note.text for note in read_notes(data / "notes.csv").values()] == ["It must not be lost."]


def test_while_pictures_are_described_before_it_is_ready(places: Path, model_file: Path, tmp_path: Path) -> None:
    with Explorer(places, model_file, tmp_path / "cache", SLOW_OPENING) as explorer:
        explorer.until(lambda: explorer.out.count("describing") > 1)
        explorer.interrupt()
        status, _ = explorer.ended()
        assert status == 0
        assert explorer.out.endswith("Stopped.\n")
        assert "ready" not in explorer.out
