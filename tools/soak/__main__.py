"""`python -m tools.soak --minutes 10 --clients 20 --pages 2 --seed 0`."""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import tyro

from lpn.core.demo import DEMO
from lpn.core.errors import InputError, LPNError
from lpn.core.files import check_writable, write_atomic
from tools.fixtures.processes import Process, free_port
from tools.soak.browser_client import BrowserSoakClient
from tools.soak.client import SoakClient
from tools.soak.record import OWN_ERROR, Fault, Record, sample
from tools.soak.reference import Reference
from tools.soak.websocket_client import WebSocketSoakClient

# Seconds for the server to release the resources of clients that have left.
LEAVING = 30.0
# Seconds for clients to end, each after its current answer, and for the server.
ENDING = 90.0


@dataclass
class Soak:
    """Drive the real explorer with many clients at once, and check every answer against a direct computation.

    The exit status is 1 after a wrong answer, an error, a client that waited much longer than the others, or leaked memory,
    threads, or file handles.
    """

    minutes: float = 10.0
    """Duration with all clients."""
    clients: int = 20
    """Number of clients over websockets."""
    pages: int = 2
    """Number of pages in headless Chromium."""
    seed: int = 0
    """Seed of all clients' acts."""
    alone: float = 60.0
    """Seconds with a single client before, as a reference for times."""
    data: Path | None = None
    """Data set; by default the demo."""
    model: Path | None = None
    """Trained LPN; by default that of the demo."""
    out: Path | None = None
    """JSON file for all figures."""

    def run(self) -> int:
        """Run one client alone, then all, then none; return the exit status."""
        if (self.data is None) != (self.model is None):
            raise InputError("Either --data or --model is given alone; give both, or neither for the demo.")
        if self.minutes <= 0 or self.clients < 1 or self.pages < 0 or self.alone < 0:
            raise InputError("Expected minutes above 0, at least one client, and no negative number.")
        if self.out is not None:
            check_writable(self.out)
        print("Starting the explorer, and a model and descriptors to check its answers by", file=sys.stderr)
        reference, record = Reference(self.data or DEMO, self.model or DEMO / "lpn.onnx"), Record()
        options = [] if self.data is None else [self.data, "--model", self.model]
        command = ["explore", *options, "--port", free_port()]
        with tempfile.TemporaryDirectory() as folder, Process(command, Path(folder) / "cache") as server:
            try:
                server.until(lambda: "ready: http" in server.out)
            except AssertionError as error:
                raise LPNError(f"The explorer did not start. Its output: {str(error).strip() or 'nothing'}") from error
            _settle(server, record, "before")
            with suppress(KeyboardInterrupt):
                self._phase(server, reference, record, self.alone, ["client 0"])
                _settle(server, record, "after one client")
                record.samples.clear()
                record.phase = "together"
                names = [f"client {i + 1}" for i in range(self.clients)] + [f"page {i + 1}" for i in range(self.pages)]
                self._phase(server, reference, record, 60 * self.minutes, names)
            _settle(server, record, "after all left")
            server.terminate()
            try:
                server.ended(ENDING)
            except (AssertionError, subprocess.TimeoutExpired) as error:
                record.faults.append(Fault("the server's end, or its log", "", 0, str(error)))
        figures, failures = record.figures(), record.failures()
        lines = [f"{name:42} {json.dumps(value)}" for name, value in figures.items()]
        lines += [f"✗ {fault.kind}: {fault.client}, step {fault.step}, {fault.text}" for fault in record.faults[:12]]
        lines += [f"✗ {failure}" for failure in failures] or ["✓ No wrong answer, no error, nothing left behind."]
        print(*lines, sep="\n")
        if self.out is not None:
            figures |= {"failures": failures, "faults": record.faults, "samples": record.samples}
            write_atomic(self.out, json.dumps(vars(self) | figures, indent=1, default=str).encode())
        return 1 if failures else 0

    def _phase(self, server: Process, reference: Reference, record: Record, seconds: float, names: list[str]) -> None:
        """Let clients work for some seconds; those named "page" are in Chromium, and client 0 stays on one page."""
        stop = threading.Event()
        url = server.out.partition("ready: ")[2].split()[0]

        def work(name: str) -> None:
            kind: type[SoakClient] = BrowserSoakClient if name.startswith("page") else WebSocketSoakClient
            try:
                kind(name, self.seed, url, reference, record, stop).run()
            except Exception:  # such as a missing browser
                if not stop.is_set():
                    record.faults.append(Fault(OWN_ERROR, name, 0, traceback.format_exc()))

        print(f"{', '.join(names)}: {seconds:g} s", file=sys.stderr)
        threads = [threading.Thread(target=work, args=(name,), daemon=True) for name in names]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + seconds
        try:
            while server.running and time.monotonic() < deadline:
                time.sleep(min(2.0, seconds))
                record.samples += filter(None, [sample(server.pid)])
        finally:
            stop.set()
            until = time.monotonic() + ENDING
            for name, thread in zip(names, threads, strict=True):
                thread.join(max(until - time.monotonic(), 0))
                if thread.is_alive():
                    record.faults.append(Fault(OWN_ERROR, name, 0, f"it has not ended after {ENDING:g} s"))
            if not server.running:
                record.faults.append(Fault("server ended", "", 0, server.out[-2000:] + server.err[-2000:]))


def _settle(server: Process, record: Record, when: str) -> None:
    """Sample the server without clients, once it is within bounds or the time is up."""
    deadline = time.monotonic() + LEAVING
    while found := sample(server.pid):
        if (found.threads <= record.most()[0] and found.handles <= record.most()[1]) or time.monotonic() > deadline:
            record.resources[when] = found
            break
        time.sleep(1)


def main() -> int:
    """Run the command line."""
    try:
        return tyro.cli(Soak, prog="python -m tools.soak").run()
    except LPNError as error:
        print(error, file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("Stopped.", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
