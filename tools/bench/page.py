"""Times from command to page, and from a key to the new numbers: `python -m tools.bench page`.

Starts the real app on the demo as a process, opens it in headless Chromium, and turns and picks as a person does. The limit is
measured in the same run: the forward passes of an answer.
"""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from playwright.sync_api import Browser, Page, sync_playwright

from lpn import datasets, load
from lpn.core import images
from lpn.core.demo import DEMO, DEMO_MODEL
from tools.bench.figures import Figure, medians
from tools.fixtures.chromium import launch
from tools.fixtures.processes import free_port

ROUNDS, OPENINGS = 20, 7


class ServerProcess:
    """A server process as a context manager, with the seconds until it printed its address."""

    def __init__(self, arguments: list[str], environment: dict[str, str]) -> None:
        self._arguments, self._environment = arguments, environment
        self.url, self.seconds = "", 0.0

    def __enter__(self) -> Self:
        started = time.perf_counter()
        self._process = subprocess.Popen(self._arguments, stdout=subprocess.PIPE, text=True, env=self._environment)
        assert self._process.stdout is not None
        try:
            for line in self._process.stdout:
                if found := re.search(r"ready: (http://\S+)", line):
                    self.url, self.seconds = found[1], time.perf_counter() - started
                    return self
            raise SystemExit(f"{' '.join(self._arguments)} ended without an address.")
        except BaseException:
            self.__exit__()
            raise

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


# Presses a key; the milliseconds until the result of what it asks for is drawn, not a number after 5 s.
PRESSED = """(key) => new Promise((done) => {
  const shown = () => {
    const frame = document.querySelector("#photo .frame");
    return frame.getAttribute("aria-valuenow") + frame.querySelector(".picture").ariaLabel;
  };
  const before = shown(), begun = performance.now();
  dispatchEvent(new KeyboardEvent("keydown", { key }));
  const look = () => {
    const drawn = shown() !== before && !document.body.classList.contains("turning");
    if (drawn || performance.now() - begun > 5000) done(drawn ? performance.now() - begun : NaN);
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})"""


def page_seconds(browser: Browser, url: str) -> tuple[float, Page]:
    """Open the page, and wait until its first result is drawn."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    started = time.perf_counter()
    page.goto(url)
    page.wait_for_selector("body[data-sequence]:not(.wait)", timeout=60_000)
    return time.perf_counter() - started, page


def key_seconds(page: Page, key: str) -> float:
    times = []
    for _ in range(ROUNDS):
        seconds = float(page.evaluate(PRESSED, key)) / 1000
        if seconds != seconds:
            raise SystemExit(f"The screen did not show the result of {key.upper()} within 5 s.")
        times.append(seconds)
        page.wait_for_timeout(300)
    return statistics.median(times)


def forward_ms(model: Path, data: Path) -> float:
    """Median milliseconds of an answer's forward pass: the picture and its mirror as one batch."""
    opened = load(model)
    view = opened.views[-1]
    picture = images.load_picture(datasets.open_dataset(data).queries(view)[0].path)
    prepared = opened.prepare(picture, view)[None]
    batch = prepared if opened.contract.mirror == "none" else prepared.repeat(2, 0)
    return medians({"pass": lambda: opened.run(batch, view)})["pass"]


def figures() -> list[Figure]:
    """Start everything, measure, and stop it."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        environment = {**os.environ, "LPN_CACHE": str(folder / "cache")}
        options = ["explore", str(DEMO), "--model", str(DEMO_MODEL), "--port"]
        command = [sys.executable, "-m", "lpn", *options]
        with ServerProcess([*command, str(free_port())], environment) as cold:
            pass
        starts = []
        for _ in range(5):
            with ServerProcess([*command, str(free_port())], environment) as again:
                starts.append(again.seconds)
        browser = launch(stack.enter_context(sync_playwright()))
        warm = stack.enter_context(ServerProcess([*command, str(free_port())], environment))
        opened = []
        for number in range(1 + OPENINGS):
            seconds, page = page_seconds(browser, warm.url)
            page.context.close()
            opened += [seconds] if number else []  # the browser's own start is nobody's
        _, page = page_seconds(browser, warm.url)
        page.wait_for_timeout(4000)  # the scene has been drawn before
        turn, pick = key_seconds(page, "j"), key_seconds(page, "n")
        browser.close()
        forward = forward_ms(DEMO_MODEL, DEMO) / 1000
    return [
        Figure("command to address, descriptors at hand", statistics.median(starts), "s"),
        Figure("command to address, nothing described yet", cold.seconds, "s"),
        Figure("address to the first result", statistics.median(opened), "s"),
        Figure("J, to new numbers (limit: the passes)", turn, "s", limit=forward),
        Figure("N, to new numbers (limit: the passes)", pick, "s", limit=forward),
    ]
