"""Frames a second while the demo is moved under the mouse in headless Chromium: `python -m tools.bench.pan [SECONDS]`.

It drags the 3-D map of the city, and the flat map of the flight. The heading names what draws them; without a GPU,
that is software WebGL. The browser's processor time a frame depends less on what else the machine does.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from itertools import pairwise
from pathlib import Path

from playwright.sync_api import Page, sync_playwright

from lpn.core.demo import DEMO_QUERY
from tools.bench.figures import Figure, show
from tools.bench.page import ServerProcess, parent_and_seconds
from tools.fixtures.chromium import launch, returning
from tools.fixtures.processes import free_port

SECONDS = 8.0
# Half the way of the mouse, in pixels, and the seconds in which it goes round once.
_FAR, _ROUND = 120, 2.0
# Milliseconds from one move of the mouse to the next.
_MOVE = 16
# Each view that is moved has a name, an address that shows it, and a selector.
VIEWS = (
    ("the city's 3-D map", f"?query={DEMO_QUERY}&map=1&screen=all", "#root canvas[data-engine]"),
    ("the flight's flat map", "?show=flight&flight=1&query=LPN_0100.webp", "#lpn-flight .view"),
)
_COUNT = """() => {
  window.drawn = [];
  const draw = (now) => { window.drawn.push(now); window.counting = requestAnimationFrame(draw); };
  window.counting = requestAnimationFrame(draw);
}"""
_RENDERER = """() => {
  const gl = document.createElement("canvas").getContext("webgl2");
  return gl ? gl.getParameter(gl.getExtension("WEBGL_debug_renderer_info").UNMASKED_RENDERER_WEBGL) : "no WebGL";
}"""


def frame_rate(stamps: Sequence[float]) -> tuple[float, float]:
    """Return frames a second, and the milliseconds from one frame to the next that one of twenty exceeds.

    Args:
        stamps: of the frames, at least two, in milliseconds.
    """
    gaps = sorted(after - before for before, after in pairwise(stamps))
    return 1000 / (sum(gaps) / len(gaps)), gaps[min(math.ceil(0.95 * len(gaps)), len(gaps)) - 1]


def browser_seconds(apart: int) -> float:
    """Return the processor time so far of all processes that this one has started, without those of one of them."""
    parents, seconds = {}, {}
    for process in (int(folder.name) for folder in Path("/proc").glob("[0-9]*")):
        with suppress(OSError):  # it has ended meanwhile
            parents[process], seconds[process] = parent_and_seconds(process)

    def is_ours(process: int) -> bool:
        while process not in (0, apart):
            process = parents.get(process, 0)
            if process == os.getpid():
                return True
        return False

    return sum(spent for process, spent in seconds.items() if is_ours(process))


def pan(page: Page, selector: str, seconds: float) -> list[float]:
    """Drag the middle of an element round in circles; return the stamps of the page's frames in milliseconds."""
    box = page.locator(selector).first.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.mouse.move(x + _FAR, y)
    page.mouse.down()
    page.evaluate(_COUNT)
    started = time.monotonic()
    while (passed := time.monotonic() - started) < seconds:
        angle = 2 * math.pi * passed / _ROUND
        page.mouse.move(x + _FAR * math.cos(angle), y + _FAR * math.sin(angle))
        page.wait_for_timeout(_MOVE)
    stamps: list[float] = page.evaluate("cancelAnimationFrame(counting), drawn")
    page.mouse.up()
    return stamps


def main() -> None:
    """Start the demo, move each view, print the figures."""
    seconds = float(sys.argv[1]) if len(sys.argv) > 1 else SECONDS
    command = [sys.executable, "-m", "lpn", "explore", "--port", str(free_port())]
    measured = []
    with ServerProcess(command, dict(os.environ)) as app, sync_playwright() as playwright:
        browser = launch(playwright, ["--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"])
        for name, address, selector in VIEWS:
            page = returning(browser, 1440, 900).new_page()
            page.goto(f"{app.url}/{address}")
            page.wait_for_selector("#lpn-status:not([data-seq='0'])", state="attached", timeout=120_000)
            page.wait_for_timeout(5000)
            renderer = page.evaluate(_RENDERER)
            before = browser_seconds(app.pid)
            stamps = pan(page, selector, seconds)
            spent = browser_seconds(app.pid) - before
            rate, slow = frame_rate(stamps)
            measured.append(Figure(f"{name}, frames a second while it is dragged", rate, "/s"))
            measured.append(Figure(f"{name}, 95 % of its frames come within", slow, "ms"))
            measured.append(Figure(f"{name}, processor time of the browser a frame", 1000 * spent / len(stamps), "ms"))
            page.context.close()
        browser.close()
    show(f"{renderer}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}", measured)


if __name__ == "__main__":
    main()
