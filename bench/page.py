"""From command to page, and from slider to changed picture: `python -m bench.page [DATA MODEL]`.

Starts the real app as a process, opens it in headless Chromium, and changes the angle as a person does. Without DATA
and MODEL it draws a small data set and an untrained network, which changes the times little. The floor is the page's
own: a viser app with one slider and one html element whose callback does nothing else.
"""

from __future__ import annotations

import os
import re
import shutil
import socket
import statistics
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Self

from playwright.sync_api import Browser, Page, sync_playwright
from rich.console import Console
from rich.table import Table

from lpn import datasets, images, load

ROUNDS = 20
QUIET = [
    "--no-sandbox",
    "--disable-background-networking",
    "--disable-component-update",
    "--disable-sync",
    "--no-first-run",
]
FLOOR = """
import sys, time, viser
server = viser.ViserServer(host="127.0.0.1", port=int(sys.argv[1]), verbose=False)
@server.on_client_connect
def connected(client):
    status = client.gui.add_html("<div id='lpn-status' data-seq='1' data-angle='0'></div>")
    slider = client.gui.add_slider("Rotate", -180, 180, 1, 0)
    def show(_):
        status.content = f"<div id='lpn-status' data-seq='1' data-angle='{slider.value:g}'></div>"
    slider.on_update(show)
print(f"ready: http://127.0.0.1:{sys.argv[1]}", flush=True)
time.sleep(600)
"""
CLOCK = "document.addEventListener('input', () => { window.changedAt = performance.now(); }, true)"
SHOWN = """
angle => new Promise(done => {
  const deadline = performance.now() + 5000;
  const check = () => {
    if (performance.now() > deadline) return done(NaN);
    if (document.querySelector('#lpn-status').dataset.angle !== angle) return requestAnimationFrame(check);
    requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - window.changedAt)));
  };
  check();
})
"""


class Process:
    """A server process, for a `with` block, and how long it took to print its address."""

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

    @property
    def process(self) -> int:
        """Its number."""
        return self._process.pid

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.communicate()


def free_port() -> int:
    """A port nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def page_seconds(browser: Browser, url: str) -> tuple[float, Page]:
    """Open a page and wait for its first answer."""
    page = browser.new_context(viewport={"width": 1456, "height": 835}).new_page()
    started = time.perf_counter()
    page.goto(url)
    page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=60_000)
    return time.perf_counter() - started, page


def slider_seconds(page: Page) -> float:
    """Median time from a changed angle to two frames drawn after the page shows it."""
    page.wait_for_timeout(2000)
    page.evaluate(CLOCK)
    row = page.locator('label:text-is("Rotate")').locator("xpath=ancestor::div[contains(@class,'Flex')][1]")
    box = row.locator("input").last
    times = []
    for angle in range(3, 3 + 7 * ROUNDS, 7):
        box.fill(str(angle), timeout=5000)
        seconds = page.evaluate(SHOWN, str(angle)) / 1000
        if seconds != seconds:
            raise SystemExit(f"The page did not show {angle} degrees within 5 s.")
        times.append(seconds)
        page.wait_for_timeout(150)
    return statistics.median(times)


def main() -> None:
    """Measure and print."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if len(sys.argv) == 3:
            data, model = Path(sys.argv[1]), Path(sys.argv[2])
        else:
            from tests import worlds

            data, model = worlds.make_dataset(folder / "places"), worlds.make_model(folder, size=256)
        environment = {**os.environ, "LPN_CACHE": str(folder / "cache")}
        command = [sys.executable, "-m", "lpn.cli", "explore", "--data", str(data), "--model", str(model), "--port"]
        with Process([*command, str(free_port())], environment) as cold:
            pass
        warm = stack.enter_context(Process([*command, str(free_port())], environment))
        floor = stack.enter_context(Process([sys.executable, "-c", FLOOR, str(free_port())], environment))
        browser = stack.enter_context(sync_playwright()).chromium.launch(
            executable_path=shutil.which("chromium"), args=QUIET
        )
        page_seconds(browser, floor.url)  # the browser's own start is nobody's
        bare_page, page = page_seconds(browser, floor.url)
        bare_slider = slider_seconds(page)
        page.context.close()
        full_page, page = page_seconds(browser, warm.url)
        slider = slider_seconds(page)
        browser.close()
        opened = load(model)
        picture = images.load_picture(datasets.open_dataset(data).queries(opened.views[-1])[0].path)
        prepared = images.prepare(picture, opened.input_size)[None]
        forward = []
        for _ in range(ROUNDS):
            started = time.perf_counter()
            opened.part_embeddings(prepared, opened.views[-1])
            forward.append(time.perf_counter() - started)
    table = Table(title=f"{model.name} on {data.name}, {os.cpu_count()} cores, medians of {ROUNDS}")
    for column in ("step", "explorer, s", "bare viser page, s", "ratio"):
        table.add_column(column, justify="right")
    table.add_row("command to address, first time", f"{cold.seconds:.2f}", f"{floor.seconds:.2f}", "")
    table.add_row(
        "command to address, again",
        f"{warm.seconds:.2f}",
        f"{floor.seconds:.2f}",
        f"{warm.seconds / floor.seconds:.2f}",
    )
    table.add_row("address to complete page", f"{full_page:.2f}", f"{bare_page:.2f}", f"{full_page / bare_page:.2f}")
    table.add_row("angle to changed picture", f"{slider:.3f}", f"{bare_slider:.3f}", f"{slider / bare_slider:.2f}")
    table.add_row("bare forward pass", f"{statistics.median(forward):.3f}", "", "")
    Console(width=110).print(table)


if __name__ == "__main__":
    main()
