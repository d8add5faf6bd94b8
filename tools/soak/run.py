"""The phases of a soak: one client alone, then all clients, then none."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from tools.soak.browser_driver import BrowserDriver, Chromium
from tools.soak.client import SoakClient
from tools.soak.figures import CALLBACKS, Memory, SoakFigures, bounds
from tools.soak.record import OWN_ERROR, Fault, Record
from tools.soak.reference import Reference
from tools.soak.server import ExplorerServer, ResourceSample
from tools.soak.websocket_driver import FaultError, WebSocketDriver

# Seconds between two samples of the server's resources.
EVERY = 2.0
# Seconds for the server to release the clients' resources.
LEAVING = 30.0
# Seconds for clients to end, each after its current answer.
ENDING = 90.0
# Seconds between the starts of two clients.
STAGGER = 0.2
# Changes that each of eight connections sends at once, and the largest number of repetitions, to fill viser's pool of threads.
FLOOD, FLOODS = 200, 6


@dataclass
class Soak:
    """A soak and its settings.

    Attributes:
        data, model: as in `lpn explore`.
        options: options of `lpn explore` that name the same data and model.
        alone, together: seconds with one client, and with all.
        say: called with progress messages.
    """

    data: Path
    model: Path
    options: list[str]
    clients: int
    pages: int
    seed: int
    alone: float
    together: float
    say: Callable[[str], None] = print
    _samples: list[ResourceSample] = field(default_factory=list)
    _began: float = field(default_factory=time.monotonic)

    def run(self) -> SoakFigures:
        """Run all phases; after Ctrl-C return the figures measured so far.

        Raises:
            LPNError: when the data set or the model cannot be used, or the explorer does not start.
        """
        self.say("Starting the explorer, and a model and descriptors to check its answers by")
        reference = Reference(self.data, self.model)
        with ExplorerServer(self.options) as server:
            record = Record(reference)
            empty, before, together = server.sample(0.0, 0), None, 0.0
            try:
                self.say(f"One client alone, {self.alone:g} s")
                self._flood(server, record, reference, empty)
                self._phase(server, record, reference, self.alone, {"client 0": self._alone})
                before = self._settled(server, record, None, None)
                record.phase = "together"
                self.say(
                    f"{self.clients} clients and {self.pages} pages, {self.together / 60:.1f} minutes (Ctrl-C ends it)"
                )
                self._samples.clear()
                began = time.monotonic()
                starts: dict[str, _Start] = {f"client {i + 1}": self._client for i in range(self.clients)}
                starts |= {f"page {i + 1}": self._page for i in range(self.pages)}
                try:
                    self._phase(server, record, reference, self.together, starts)
                finally:
                    together = time.monotonic() - began
            except KeyboardInterrupt:
                self.say("Stopped early.")
            during, left = list(self._samples), None
            with suppress(KeyboardInterrupt):
                left = self._settled(server, record, empty, before)
            self.say(f"Checking the last {record.waiting:,} answers")
            with suppress(KeyboardInterrupt):
                record.close()
        if server.killed:
            record.fault(Fault("server did not end", "", 0, f"it was killed; it said at last: {server.text()[-2000:]}"))
        memory = Memory.of(empty, before, during if before else [], left)
        unchecked = record.waiting
        return SoakFigures(
            self.seed, self.clients, self.pages, together, record.visits, record.checked, record.wrong, unchecked,
            record.faults, server.tracebacks(), record.times, memory,
        )  # fmt: skip

    def _phase(
        self, server: ExplorerServer, record: Record, reference: Reference, seconds: float, starts: Mapping[str, _Start]
    ) -> None:
        stop = threading.Event()

        def begin(client_name: str) -> None:
            try:
                starts[client_name](client_name, server, record, reference, stop)
            except Exception as error:  # such as a missing browser
                if not stop.is_set():
                    record.fault(Fault(OWN_ERROR, client_name, 0, "".join(traceback.format_exception(error))))

        threads = [
            threading.Thread(target=begin, args=(client_name,), name=client_name, daemon=True) for client_name in starts
        ]
        deadline = time.monotonic() + seconds
        try:
            for thread in threads:
                thread.start()
                time.sleep(STAGGER if len(threads) > 1 else 0)
            while time.monotonic() < deadline:
                time.sleep(min(EVERY, max(deadline - time.monotonic(), 0.01)))
                if not server.alive:
                    record.fault(Fault("server ended", "", 0, f"it said at last: {server.text()[-2000:]}"))
                    break
                self._sample(server, record)
        finally:
            stop.set()
            until = time.monotonic() + ENDING
            for thread in threads:
                if thread.ident is not None:
                    thread.join(max(until - time.monotonic(), 0))
                if thread.is_alive():
                    record.fault(Fault(OWN_ERROR, thread.name, 0, f"it has not ended after {ENDING:g} s"))

    def _alone(
        self, client_name: str, server: ExplorerServer, record: Record, reference: Reference, stop: threading.Event
    ) -> None:
        driver = WebSocketDriver(server.url, reference, stop)
        SoakClient(client_name, self.seed, driver, reference, record, stop, stays=True).run()

    def _client(
        self, client_name: str, server: ExplorerServer, record: Record, reference: Reference, stop: threading.Event
    ) -> None:
        driver = WebSocketDriver(server.url, reference, stop)
        SoakClient(client_name, self.seed, driver, reference, record, stop, stays=False).run()

    def _page(
        self, client_name: str, server: ExplorerServer, record: Record, reference: Reference, stop: threading.Event
    ) -> None:
        with Chromium() as browser:
            driver = BrowserDriver(browser, server.url, reference, stop)
            SoakClient(client_name, self.seed, driver, reference, record, stop, stays=False).run()

    def _flood(
        self, server: ExplorerServer, record: Record, reference: Reference, empty: ResourceSample | None
    ) -> None:
        """Send many changes at once, so that viser's pool of threads is full before threads are counted."""
        drivers = [WebSocketDriver(server.url, reference, threading.Event()) for _ in range(8)]

        def send(driver: WebSocketDriver) -> None:
            for value in range(FLOOD):
                driver.set("Rotate", value % 180)

        try:
            for driver in drivers:
                driver.enter("screen=all")
            for _ in range(FLOODS):
                sample = server.sample(0.0, 0)
                if sample is None or empty is None or sample.threads >= empty.threads + CALLBACKS + 4 * len(drivers):
                    break
                with ThreadPoolExecutor(len(drivers)) as pool:
                    list(pool.map(send, drivers))
                time.sleep(1.5)
        except FaultError as fault:
            record.fault(Fault(fault.kind, "many changes at once", 0, fault.text))
        finally:
            for driver in drivers:
                driver.leave("close")

    def _sample(self, server: ExplorerServer, record: Record) -> ResourceSample | None:
        sample = server.sample(time.monotonic() - self._began, record.clients)
        if sample is not None:
            self._samples.append(sample)
        return sample

    def _settled(
        self, server: ExplorerServer, record: Record, empty: ResourceSample | None, before: ResourceSample | None
    ) -> ResourceSample | None:
        """Sample the server without clients, once it is within bounds or the time is up."""
        deadline = time.monotonic() + (5.0 if before is None else LEAVING)
        threads, handles = bounds(empty, before)
        while True:
            time.sleep(1)
            sample = server.sample(time.monotonic() - self._began, record.clients)
            if (
                sample is None
                or time.monotonic() > deadline
                or (sample.threads <= threads and sample.handles <= handles)
            ):
                return sample


_Start = Callable[[str, ExplorerServer, Record, Reference, threading.Event], None]
