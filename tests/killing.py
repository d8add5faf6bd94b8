"""Commands in processes of their own that are killed: at a moment of time, or at their n-th step on the disk."""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from lpn.cli import main
from tests import painting

_CHANGES = {"os.rename", "os.remove", "os.mkdir", "os.rmdir", "os.truncate", "os.link", "os.symlink", "shutil.rmtree"}


def _run(arguments: Sequence[str], folder: str, cache: str, step: int | None, count: Any, out: str) -> None:
    os.environ["LPN_CACHE"] = cache
    # What a killed process said is of no interest, and where it says it must not be closed under it.
    log = os.open(out, os.O_WRONLY | os.O_CREAT | os.O_APPEND)
    os.dup2(log, 1)
    os.dup2(log, 2)

    def watch(event: str, given: tuple[Any, ...]) -> None:
        opened = event == "open" and isinstance(given[2], int) and given[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT)
        if (opened or event in _CHANGES) and folder in str(given[0]):
            count.value += 1
            if count.value == step:
                os.kill(os.getpid(), signal.SIGKILL)

    if arguments[0] == "world":
        sys.modules["lpn.world.render"] = painting  # the real one needs Blender
    sys.addaudithook(watch)
    code = main.main(arguments)
    # Without what an interpreter clears away at its end, which takes most of the time of a short command.
    os._exit(code)


class Killer:
    """Starts commands; a server with everything imported forks each, so that none spends its time on imports.

    Args:
        folder: what they write lies below it.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._context = multiprocessing.get_context("forkserver")
        self._context.set_forkserver_preload(
            [
                "tests.killing",
                "lpn.training.trainer",
                "lpn.models.export",
                "lpn.models.quantize",
                "lpn.descriptors",
                "lpn.world.build",
            ]
        )
        self.log = folder / "said.txt"

    def run(
        self, arguments: Sequence[str], after: float | None = None, step: int | None = None
    ) -> tuple[int, float, int]:
        """Run a command, and kill it so many seconds after its start, or right before its step of that number on the disk.

        Returns:
            Its exit status, negative where it was killed, the seconds it ran, and its steps on the disk.
        """
        count = self._context.Value("q", 0, lock=False)
        given = (
            list(arguments),
            str(self._folder / "out"),
            str(self._folder / "out" / "cache"),
            step,
            count,
            str(self.log),
        )
        self.log.write_text("")
        process = self._context.Process(target=_run, args=given)
        started = time.monotonic()
        process.start()
        process.join(after)
        if process.is_alive() and after is not None:
            process.kill()
        process.join()
        assert process.exitcode is not None
        return process.exitcode, time.monotonic() - started, int(count.value)
