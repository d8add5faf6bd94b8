"""Times from command to page, and from a control to the changed picture: `python -m tools.bench.page [DATA MODEL]`.

Starts the real app as a process, opens it in headless Chromium, and turns, picks, and drags as a person does. Without DATA and
MODEL it draws a small data set and an untrained network. Two floors are measured in the same run: a bare viser page with as many
scene nodes and controls as the explorer's, and the explorer's own page whose worker computes and draws nothing, but says that
it was asked. For comparison there is the same page with a worker that shows one of two answers it has.
"""

from __future__ import annotations

import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
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
EVENTS = 50
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
_COUNTED = """
import os, sys
from dataclasses import replace
import viser
from explorer.client.session import ClientSession
from explorer.panels import pages
from explorer.stage.cards import SHOWN
counts = dict.fromkeys(("add_image", "add_button", "add_slider", "add_html"), 0)
def counted(owner, names, key):
    for name in names:
        def add(self, *args, _made=getattr(owner, name), **kwargs):
            counts[key] += 1
            return _made(self, *args, **kwargs)
        setattr(owner, name, add)
counted(viser.SceneApi, ["add_image", "add_line_segments", "add_frame"], "add_image")
counted(viser.GuiApi, ["add_button", "add_button_group", "add_upload_button", "add_command"], "add_button")
counted(viser.GuiApi, ["add_slider", "add_checkbox", "add_dropdown", "add_text"], "add_slider")
counted(viser.GuiApi, ["add_html"], "add_html")
def show(self, answer):
    with self.client.atomic():
        self.views.stage.show(answer)
        self.views.panels.show(answer, self.views.sequence)
"""
_RUN = """
ClientSession._work = work
from lpn.cli.main import main
sys.exit(main())
"""
IDLE = f"""{_COUNTED}
def work(self):
    self.views.sequence += 1
    if self.views.sequence == 1:
        self._idle = self._analyser.analyse(self._state, SHOWN)
        show(self, self._idle)
        with open(os.environ["LPN_BENCH_COUNTS"], "w") as file:
            file.write(" ".join(str(count) for count in counts.values()))
    else:
        shown = pages.ShownAnalysis(replace(self._idle, state=self._state), self.views.sequence)
        self.views.panels.answer._status.show(pages.status(shown))
{_RUN}"""
READY = f"""{_COUNTED}
def work(self):
    self.views.sequence += 1
    if self.views.sequence == 1:
        turned = replace(self._state, angle=90.0)
        self._ready = [self._analyser.analyse(state, SHOWN) for state in (self._state, turned)]
    show(self, replace(self._ready[self.views.sequence % 2], state=self._state))
{_RUN}"""
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
WATCH = """
() => {
  const status = () => document.querySelector('#lpn-status').dataset.seq;
  window.seen = new Set([status()]);
  window.watcher?.disconnect();
  window.watcher = new MutationObserver(() => document.querySelector('#lpn-status') && window.seen.add(status()));
  window.watcher.observe(document.body, {subtree: true, childList: true, attributes: true});
}
"""
PLACE_SHOWN = """
place => (!place || document.querySelector('#lpn-first .choice.chosen')?.textContent === place)
  && document.querySelector('#lpn-first [data-query]')
  && [...document.querySelectorAll('#lpn-first figure img')].every(picture => picture.naturalWidth)
"""
# Milliseconds in which a place's session is built behind its first screen.
SETTLED = 4000
DRAG = """
async (box, events) => {
  const set = Object.getOwnPropertyDescriptor(HTMLInputElement.prototype, 'value').set;
  for (let value = 1; value <= events; value++) {
    set.call(box, String(value));
    box.dispatchEvent(new Event('input', {bubbles: true}));
    await new Promise(done => setTimeout(done, 1000 / events));
  }
}
"""


class ServerProcess:
    """A server process as a context manager, with the seconds until it printed its address."""

    def __init__(self, arguments: list[str], environment: dict[str, str]) -> None:
        self._arguments, self._environment = arguments, environment
        self.url, self.seconds, self.pid = "", 0.0, 0

    def __enter__(self) -> Self:
        started = time.perf_counter()
        self._process = subprocess.Popen(self._arguments, stdout=subprocess.PIPE, text=True, env=self._environment)
        assert self._process.stdout is not None
        self.pid = self._process.pid
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


def page_seconds(browser: Browser, url: str) -> tuple[float, Page]:
    """Open a page, the explorer's with its workbench, and wait for its first answer."""
    page = browser.new_context(viewport={"width": 1456, "height": 835}).new_page()
    started = time.perf_counter()
    page.goto(f"{url}/?screen=all")
    page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=60_000)
    return time.perf_counter() - started, page


def processor_seconds(process: ServerProcess) -> float:
    """Return the processor time of a process so far; it depends less than the time on what else the machine does."""
    return parent_and_seconds(process.pid)[1]


def parent_and_seconds(process: int) -> tuple[int, float]:
    """Return the number of the process that started one, and the processor time of that one so far."""
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return int(fields[1]), (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def first_screens(browser: Browser) -> list[Figure]:
    """Open the demo and then each of its places, twice: seconds to the first screen with its pictures, and the server's share."""
    measured = []
    with ServerProcess(
        [sys.executable, "-m", "lpn", "explore", "--port", str(free_port())], dict(os.environ)
    ) as process:
        page = browser.new_context(viewport={"width": 1440, "height": 900}).new_page()

        def measure(label: str, act: Callable[[], object], place: str, limit: float) -> None:
            processor, started = processor_seconds(process), time.perf_counter()
            act()
            page.wait_for_function(PLACE_SHOWN, arg=place, timeout=60_000)
            seconds, processor = time.perf_counter() - started, processor_seconds(process) - processor
            measured.append(below(f"{label} ({processor:.2f} s of the server's processor)", seconds, limit, "s"))
            page.wait_for_timeout(SETTLED)

        measure("the demo's address to its first screen", lambda: page.goto(process.url), "", 2.0)
        chips = page.locator("#lpn-first .choice")
        start, *others = chips.all_text_contents()
        for again, limit in ((False, 2.0), (True, 1.0)):
            for place in (*others, start):
                chip = chips.get_by_text(place, exact=True)
                measure(f"chip to {place}{', again' if again else ''}", chip.click, place, limit)
        page.context.close()
    return measured


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


def drag(page: Page) -> tuple[int, bool]:
    """Change the angle fifty times within a second: the number of answers never shown, and True if the last one is shown."""
    box = (
        page.locator('label:text-is("Rotate")')
        .locator("xpath=ancestor::div[contains(@class,'Flex')][1]")
        .locator("input")
        .last
    )
    page.evaluate(WATCH)
    before = int(page.get_attribute("#lpn-status", "data-seq") or 0)
    box.evaluate(DRAG, EVENTS)
    page.wait_for_timeout(2500)
    after, angle = (page.get_attribute("#lpn-status", name) or "0" for name in ("data-seq", "data-angle"))
    shown = page.evaluate("before => [...window.seen].filter(seq => Number(seq) > before).length", before)
    return int(after) - before - int(shown), angle == str(EVENTS)


def resident(process: ServerProcess) -> float:
    """Resident memory of a process in MB."""
    lines = Path(f"/proc/{process.pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1000


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
        options = ["explore", "--data", str(data), "--model", str(model), "--port"]
        command = [sys.executable, "-m", "lpn", *options]
        with ServerProcess([*command, str(free_port())], environment) as cold:
            pass
        starts = []
        for _ in range(5):
            with ServerProcess([*command, str(free_port())], environment) as again:
                starts.append(again.seconds)
        warm = stack.enter_context(ServerProcess([*command, str(free_port())], environment))
        idle = stack.enter_context(ServerProcess([sys.executable, "-c", IDLE, *options, str(free_port())], environment))
        browser = launch(stack.enter_context(sync_playwright()))
        _, page = page_seconds(browser, idle.url)  # the browser's own start is nobody's
        idle_turn, idle_pick = slider_seconds(page), pick_seconds(page)
        page.context.close()
        with ServerProcess([sys.executable, "-c", READY, *options, str(free_port())], environment) as ready:
            _, page = page_seconds(browser, ready.url)
            ready_turn, ready_pick = slider_seconds(page), pick_seconds(page)
            page.context.close()
        numbers = counts.read_text().split()
        bare = stack.enter_context(ServerProcess([sys.executable, "-c", BARE, str(free_port()), *numbers], environment))
        opened: dict[str, list[float]] = {bare.url: [], warm.url: []}
        for _ in range(OPENINGS):
            for url, times in opened.items():  # by turns, and each page alone
                seconds, page = page_seconds(browser, url)
                page.context.close()
                times.append(seconds)
        bare_page, full_page = map(statistics.median, opened.values())
        _, page = page_seconds(browser, warm.url)
        turn, pick = slider_seconds(page), pick_seconds(page)
        drag(page)
        before = resident(warm)
        drags = [drag(page) for _ in range(5)]
        after = resident(warm)
        places = first_screens(browser)
        browser.close()
        forward = forward_ms(model, data) / 1000
    wasted, last = max(lost for lost, _ in drags), all(shown for _, shown in drags)
    nodes = f"{numbers[0]} pictures, {sum(map(int, numbers[1:]))} controls"
    return [
        below("command to address, descriptors at hand", statistics.median(starts), 1.5, "s"),
        Figure("command to address, nothing described yet", cold.seconds, "s"),
        within(f"address to complete page (limit: bare viser page, {nodes})", full_page, bare_page, 1.25, "s"),
        within("turned, to the changed picture (limit: passes + idle page)", turn, forward + idle_turn, 1.3, "s"),
        within("picked, to the changed picture (limit: passes + idle page)", pick, forward + idle_pick, 1.3, "s"),
        Figure("the same, against passes + answers at hand shown: turned", turn, "s", limit=forward + ready_turn),
        Figure("the same, picked", pick, "s", limit=forward + ready_pick),
        Figure(
            f"{EVENTS} turns in a second: answers nobody saw{'' if last else ', and the last is not shown'}",
            wasted,
            "passes",
            target="2 passes, the last shown",
            met=wasted <= 2 and last,
        ),
        below("resident memory of the server", after, 700, "MB"),
        Figure(f"its growth over {5 * EVENTS} turns", after - before, "MB"),
        *places,
    ]


def main(arguments: list[str]) -> None:
    """Measure and print."""
    if len(arguments) not in (0, 2):
        raise SystemExit(f"Given: {' '.join(arguments)}; expected DATA and MODEL, or nothing.")
    given: list[Any] = [Path(argument) for argument in arguments] or [None, None]
    show("The explorer", figures(*given))


if __name__ == "__main__":
    main(sys.argv[1:])
