"""The explorer as a process: its output and its resources."""

from __future__ import annotations

import re
import signal
import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from lpn.core.errors import LPNError

# Longest time to start in seconds; a new data set must be described first.
START = 300.0
# Longest time to end in seconds; on an idle machine it takes two (lpn.core.shutdown).
END = 60.0
_TRACEBACK = re.compile(r"Traceback \(most recent call last\):\n(?:[ \t].*\n|\n)*.*\n?")


@dataclass(frozen=True)
class ResourceSample:
    """The server's resources at a moment.

    Attributes:
        at: seconds since the start of the soak.
        megabytes: resident memory.
        threads, handles: numbers of threads and file handles.
        clients: number of connected clients.
    """

    at: float
    megabytes: float
    threads: int
    handles: int
    clients: int


class ExplorerServer:
    """`lpn explore` on a free port, for a `with` block.

    Attributes:
        url: the page's address.
        killed: True when it did not end on SIGTERM in time.

    Raises:
        LPNError: when it does not start; the message holds its output.
    """

    def __init__(self, options: list[str]) -> None:
        self._options = options
        self.url, self.killed = "", False
        self._output: str | None = None

    def __enter__(self) -> Self:
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        self._log = tempfile.NamedTemporaryFile("w+", suffix=".log", encoding="utf-8", errors="replace")
        command = [sys.executable, "-m", "lpn", "explore", *self._options, "--port", str(port)]
        # In a session of its own, so that Ctrl-C is the soak's alone.
        self._process = subprocess.Popen(
            command, stdout=self._log, stderr=subprocess.STDOUT, stdin=subprocess.DEVNULL, start_new_session=True
        )
        deadline = time.monotonic() + START
        try:
            while not (found := re.search(r"ready: (http://\S+)", self.text())):
                if self._process.poll() is not None or time.monotonic() > deadline:
                    raise LPNError(f"The explorer did not start. Its output: {self.text().strip() or 'nothing'}")
                time.sleep(0.1)
        except BaseException:
            self.__exit__()
            raise
        self.url = found[1]
        return self

    def __exit__(self, *_: object) -> None:
        self._process.send_signal(signal.SIGTERM)
        try:
            self._process.wait(END)
        except subprocess.TimeoutExpired:
            self.killed = True
        finally:  # also after Ctrl-C
            self._process.kill()
            self._process.wait()
            self._output = self.text()
            self._log.close()

    @property
    def alive(self) -> bool:
        """True while the process runs."""
        return self._process.poll() is None

    def text(self) -> str:
        """Everything it printed, also after its end."""
        return Path(self._log.name).read_text("utf-8", errors="replace") if self._output is None else self._output

    def tracebacks(self) -> list[str]:
        """Tracebacks in the output, each with the line that names the error."""
        return [found[0] for found in _TRACEBACK.finditer(self.text())]

    def sample(self, at: float, clients: int) -> ResourceSample | None:
        """Sample the resources; None on a system without /proc."""
        of = Path(f"/proc/{self._process.pid}")
        try:
            lines = dict(line.split(":", 1) for line in (of / "status").read_text().splitlines())
            handles = sum(1 for _ in (of / "fd").iterdir())
        except OSError:
            return None
        if "VmRSS" not in lines:  # it has ended
            return None
        return ResourceSample(at, int(lines["VmRSS"].split()[0]) / 1024, int(lines["Threads"]), handles, clients)
