"""Times from command to page, and from a control to the changed picture: `python -m tools.bench.page [DATA MODEL]`.

Starts the real app as a process, opens it in headless Chromium, and turns and picks as a person does. Without DATA and MODEL it
draws a small data set and an untrained network. The limits are measured in the same run: a bare viser page with as many scene
nodes and controls as the explorer's, and the forward passes of an answer.
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
from typing import Any, Self

from playwright.sync_api import Browser, Page, sync_playwright

from lpn import datasets, load
from lpn.core import images
from tools.bench.figures import Figure, below, medians, show, within
from tools.fixtures.chromium import launch
from tools.fixtures.processes import free_port

ROUNDS, OPENINGS = 20, 7
BARE = """
import sys, time, numpy as np, viser
pictures, buttons, sliders, texts = (int(value) for value in sys.argv[2:])
server = viser.ViserServer(host="127.0.0.1", port=int(sys.argv[1]), verbose=False)
photo = np.random.default_rng(0).integers(0, 256, (64, 64, 3), np.uint8).repeat(4, 0).repeat(4, 1)
@server.on_client_connect
def connected(client):
    client.scene.configure_default_lights(cast_shadow=False)
    for i in range(pictures):
        place = (i % 8, i // 8, 0)
        client.scene.add_image(f"/{i}", photo, 1, 1, format="jpeg", cast_shadow=False, receive_shadow=False, position=place)
    for i in range(buttons):
        client.gui.add_button(f"button {i}")
    for i in range(sliders):
        client.gui.add_slider(f"slider {i}", 0, 1, 0.1, 0)
    for i in range(texts):
        client.gui.add_html(f"<p>{i}</p>")
    client.gui.add_html("<div id='lpn-status' data-seq='1'></div>")
print(f"ready: http://127.0.0.1:{sys.argv[1]}", flush=True)
time.sleep(600)
"""
# The explorer, which tells how many scene nodes and controls its page has.
COUNTED = """
import os, sys
from pathlib import Path
import viser
counts = dict.fromkeys(("add_image", "add_button", "add_slider", "add_html"), 0)
def counted(owner, names, key):
    for name in names:
        def add(self, *args, _made=getattr(owner, name), **kwargs):
            counts[key] += 1
            Path(os.environ["LPN_BENCH_COUNTS"]).write_text(" ".join(map(str, counts.values())))
            return _made(self, *args, **kwargs)
        setattr(owner, name, add)
counted(viser.SceneApi, ["add_image", "add_line_segments", "add_frame"], "add_image")
counted(viser.GuiApi, ["add_button", "add_button_group", "add_upload_button", "add_command"], "add_button")
counted(viser.GuiApi, ["add_slider", "add_checkbox", "add_dropdown", "add_text"], "add_slider")
counted(viser.GuiApi, ["add_html"], "add_html")
from lpn.cli.main import main
sys.exit(main())
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
PICKED = SHOWN.replace("angle", "before").replace("dataset.before !== before", "dataset.query === before")


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


# Presses the key that turns by 15 degrees; the milliseconds until the result of the new angle is drawn, not a number after 5 s.
TURNED = """() => new Promise((done) => {
  const photo = document.querySelector("#photo .frame"), before = photo.getAttribute("aria-valuenow"), begun = performance.now();
  dispatchEvent(new KeyboardEvent("keydown", { key: "j" }));
  const look = () => {
    const turned = photo.getAttribute("aria-valuenow") !== before && !document.body.classList.contains("turning");
    if (turned || performance.now() - begun > 5000) done(turned ? performance.now() - begun : NaN);
    else requestAnimationFrame(look);
  };
  requestAnimationFrame(look);
})"""


def screen_seconds(browser: Browser, url: str) -> tuple[float, Page]:
    """Open the screen, and wait until its first result is drawn."""
    page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()
    started = time.perf_counter()
    page.goto(url)
    page.wait_for_selector("body[data-sequence]:not(.wait)", timeout=60_000)
    return time.perf_counter() - started, page


def turn_seconds(page: Page) -> float:
    """Median time from the key that turns the photo to the new numbers; the scene has been drawn before."""
    page.wait_for_timeout(4000)
    times = []
    for _ in range(ROUNDS):
        seconds = float(page.evaluate(TURNED)) / 1000
        if seconds != seconds:
            raise SystemExit("The screen did not show the next angle within 5 s.")
        times.append(seconds)
        page.wait_for_timeout(300)
    return statistics.median(times)


def page_seconds(browser: Browser, url: str) -> tuple[float, Page]:
    """Open a page, the former one with its workbench, and wait for its first answer."""
    page = browser.new_context(viewport={"width": 1456, "height": 835}).new_page()
    started = time.perf_counter()
    page.goto(f"{url}/?screen=all")
    page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=60_000)
    return time.perf_counter() - started, page


def slider_seconds(page: Page) -> float:
    """Median time from a changed angle to two frames drawn after the page shows it."""
    page.wait_for_timeout(2000)
    page.get_by_text("Query", exact=True).click()  # the panel of the controls begins folded
    page.evaluate(CLOCK)
    row = page.locator('label:text-is("Rotate")').locator("xpath=ancestor::div[contains(@class,'Flex')][1]")
    box = row.locator("input").last
    times = []
    for angle in range(3, 3 + 7 * ROUNDS, 7):
        box.fill(str(angle), timeout=5000)
        seconds = float(page.evaluate(SHOWN, str(angle))) / 1000
        if seconds != seconds:
            raise SystemExit(f"The page did not show {angle} degrees within 5 s.")
        times.append(seconds)
        page.wait_for_timeout(150)
    return statistics.median(times)


def pick_seconds(page: Page) -> float:
    """Median time from the key for the next picture to two frames drawn after the page shows it."""
    page.evaluate("document.activeElement.blur()")
    page.evaluate("document.addEventListener('keydown', () => { window.changedAt = performance.now(); }, true)")
    times = []
    for _ in range(ROUNDS):
        before = page.get_attribute("#lpn-status", "data-query")
        page.keyboard.press("n")
        seconds = float(page.evaluate(PICKED, before)) / 1000
        if seconds != seconds:
            raise SystemExit("The page did not show the next picture within 5 s.")
        times.append(seconds)
        page.wait_for_timeout(150)
    return statistics.median(times)


def forward_ms(model: Path, data: Path) -> float:
    """Median milliseconds of an answer's forward pass: the picture and its mirror as one batch."""
    opened = load(model)
    view = opened.views[-1]
    picture = images.load_picture(datasets.open_dataset(data).queries(view)[0].path)
    prepared = opened.prepare(picture, view)[None]
    batch = prepared if opened.contract.mirror == "none" else prepared.repeat(2, 0)
    return medians({"pass": lambda: opened.run(batch, view)})["pass"]


def figures(data: Path | None = None, model: Path | None = None) -> list[Figure]:
    """Start everything, measure, and stop it."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        if data is None or model is None:
            from tools.fixtures import small_worlds

            data, model = small_worlds.make_dataset(folder / "places"), small_worlds.make_model(folder, size=256)
        counts = folder / "counts"
        environment = {**os.environ, "LPN_CACHE": str(folder / "cache"), "LPN_BENCH_COUNTS": str(counts)}
        options = ["explore", str(data), "--model", str(model), "--port"]
        command = [sys.executable, "-m", "lpn", *options]
        with ServerProcess([*command, str(free_port())], environment) as cold:
            pass
        starts = []
        for _ in range(5):
            with ServerProcess([*command, str(free_port())], environment) as again:
                starts.append(again.seconds)
        browser = launch(stack.enter_context(sync_playwright()))
        counting = [sys.executable, "-c", COUNTED, *options, str(free_port())]
        with ServerProcess(counting, environment) as counted:
            _, page = page_seconds(browser, f"{counted.url}/classic")  # the browser's own start is nobody's
            page.context.close()
        numbers = counts.read_text().split()
        warm = stack.enter_context(ServerProcess([*command, str(free_port())], environment))
        bare = stack.enter_context(ServerProcess([sys.executable, "-c", BARE, str(free_port()), *numbers], environment))
        former = f"{warm.url}/classic"
        opened: dict[str, list[float]] = {bare.url: [], former: []}
        for _ in range(OPENINGS):
            for url, times in opened.items():  # by turns, and each page alone
                seconds, page = page_seconds(browser, url)
                page.context.close()
                times.append(seconds)
        screens = []
        for _ in range(OPENINGS):
            seconds, page = screen_seconds(browser, warm.url)
            page.context.close()
            screens.append(seconds)
        _, page = screen_seconds(browser, warm.url)
        screen_turn = turn_seconds(page)
        page.context.close()
        bare_page, full_page = map(statistics.median, opened.values())
        _, page = page_seconds(browser, former)
        turn, pick = slider_seconds(page), pick_seconds(page)
        browser.close()
        forward = forward_ms(model, data) / 1000
    nodes = f"{numbers[0]} pictures, {sum(map(int, numbers[1:]))} controls"
    return [
        below("command to address, descriptors at hand", statistics.median(starts), 1.5, "s"),
        Figure("command to address, nothing described yet", cold.seconds, "s"),
        within(f"address to complete page (limit: bare viser page, {nodes})", full_page, bare_page, 1.25, "s"),
        below("address to the screen's first result", statistics.median(screens), 0.8, "s"),
        Figure("J on the screen, to new numbers (limit: the passes)", screen_turn, "s", limit=forward),
        Figure("turned, to the changed picture (limit: the passes)", turn, "s", limit=forward),
        Figure("picked, to the changed picture (limit: the passes)", pick, "s", limit=forward),
    ]


def main(arguments: list[str]) -> None:
    """Measure and print."""
    if len(arguments) not in (0, 2):
        raise SystemExit(f"Given: {' '.join(arguments)}; expected DATA and MODEL, or nothing.")
    given: list[Any] = [Path(argument) for argument in arguments] or [None, None]
    show("The explorer", figures(*given))


if __name__ == "__main__":
    main(sys.argv[1:])
