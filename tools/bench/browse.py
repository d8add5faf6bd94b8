"""The lists and the live map of the explorer with 10^5 made-up queries: `python -m tools.bench.browse [COUNT]`.

Draws descriptors and names of COUNT queries, 100,000 by default, links their pictures to a few small files, and opens the real
app on them in headless Chromium, which draws in software. Measured are the time from the address to the first thumbnails, the
frames while lists scroll at several speeds, the elements and the memory that the page holds after that, and the frames of the map
while it is zoomed.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

from tools.bench.figures import Figure, show
from tools.bench.page import ServerProcess
from tools.fixtures import small_worlds
from tools.fixtures.chromium import launch
from tools.fixtures.processes import free_port

COUNT, TILES, PICTURES, WIDTH = 100_000, 500, 64, 16
# Seconds of each kind of scrolling, and of each movement of the map.
SECONDS = 4
# Counts frames while `step` is called before each; resolves to frames per second and the longest wait for one in milliseconds.
FRAMES = """
([step, seconds]) => new Promise(done => {
  const act = Function('number', step), begun = performance.now();
  let frames = 0, last = begun, longest = 0;
  const next = now => {
    longest = Math.max(longest, now - last);
    last = now;
    if (now - begun > 1000 * seconds) return done([frames / ((now - begun) / 1000), longest]);
    act(frames++);
    requestAnimationFrame(next);
  };
  requestAnimationFrame(next);
})
"""
HEAP = "performance.memory.usedJSHeapSize"
ELEMENTS = "document.querySelectorAll('*').length"
SCROLL = "const list = document.getElementById('{}'); list.scrollTop += {};"
WHEEL = (
    "const canvas = document.querySelector('.lab-map .marks'), box = canvas.getBoundingClientRect();"
    "canvas.dispatchEvent(new WheelEvent('wheel', {clientX: box.x + 200 + number % 50, clientY: box.y + 80, "
    "deltaY: number % 8 < 4 ? -20 : 20, cancelable: true}));"
)
# Resolves to the frames per second that the map itself drew.
DRAWN = """
async ([step, seconds]) => {
  const map = document.querySelector('.lab-map'), before = Number(map.dataset.frames), begun = performance.now();
  const act = Function('number', step);
  let number = 0;
  while (performance.now() - begun < 1000 * seconds) {
    act(number++);
    await new Promise(done => requestAnimationFrame(done));
  }
  return [(Number(map.dataset.frames) - before) / ((performance.now() - begun) / 1000), Number(map.dataset.frame)];
}
"""


def make(folder: Path, count: int) -> list[str]:
    """Make the arrays and pictures, and return the options that open them."""
    rng = np.random.default_rng(0)
    places = rng.standard_normal((TILES, 2, WIDTH)).astype(np.float32)
    of = rng.integers(0, TILES, count)
    np.save(folder / "g.npy", places)
    np.save(folder / "q.npy", places[of] + 1.1 * rng.standard_normal((count, 2, WIDTH)).astype(np.float32))
    for number in range(PICTURES):
        small_worlds.write(folder / f"picture-{number}.jpg", small_worlds.place(number))
    lines = ["file,side,label"]
    for number, place in enumerate(of.tolist()):
        name = f"flight-{number // 1000:03d}/image-{number:06d}.jpg"
        if number % 1000 == 0:
            (folder / name).parent.mkdir()
        os.link(folder / f"picture-{number % PICTURES}.jpg", folder / name)
        lines.append(f"{name},query,{place}")
    lines += [f"picture-{number % PICTURES}.jpg,gallery,{number}" for number in range(TILES)]
    (folder / "paths.csv").write_text("\n".join(lines))
    files = {"--queries": "q.npy", "--gallery": "g.npy", "--paths": "paths.csv"}
    return ["arrays", *(text for option, name in files.items() for text in (option, str(folder / name)))]


def first_paint(page: Page, url: str) -> float:
    """Seconds from the address to the first thumbnails in sight."""
    started = time.perf_counter()
    page.goto(url)
    page.wait_for_selector("#lpn-queries img.there", state="attached", timeout=120_000)
    return time.perf_counter() - started


def measure(page: Page, url: str) -> list[Figure]:
    """Measure a running app in a page."""
    found = [Figure("address to first thumbnails", first_paint(page, url), "s")]
    page.wait_for_timeout(2000)
    before = page.evaluate(HEAP), page.evaluate(ELEMENTS)
    for label, pixels in (
        ("a row in four frames", 24),
        ("a screen in a frame", 400),
        ("a hundred screens in a frame", 40_000),
    ):
        rate, longest = page.evaluate(FRAMES, [SCROLL.format("lpn-queries", pixels), SECONDS])
        found.append(Figure(f"list scrolls by {label}", rate, "frames/s"))
        found.append(Figure(f"list scrolls by {label}: longest wait", longest, "ms"))
        page.evaluate("document.getElementById('lpn-queries').scrollTop = 0")
        page.wait_for_timeout(500)
    page.keyboard.press("b")
    page.wait_for_selector("#lpn-lab-rows tbody tr[data-row]", state="attached", timeout=300_000)
    page.wait_for_timeout(2000)
    rate, longest = page.evaluate(FRAMES, [SCROLL.format("lpn-lab-rows", 300), SECONDS])
    found.append(Figure("laboratory's table scrolls by a screen in a frame", rate, "frames/s"))
    found.append(
        Figure("elements of the page after all scrolling, beyond those before", page.evaluate(ELEMENTS) - before[1], "")
    )
    found.append(Figure("JavaScript heap after all scrolling", page.evaluate(HEAP) / 1e6, "MB"))
    page.locator(".lab-bar .seg a", has_text="Maps").click()
    page.wait_for_function("Number(document.querySelector('.lab-map')?.dataset.frames || 0) > 0", timeout=300_000)
    page.wait_for_timeout(2000)
    for label in ("half of the stage", "the whole stage"):
        rate, cost = page.evaluate(DRAWN, [WHEEL, SECONDS])
        found.append(Figure(f"map on {label} is zoomed", rate, "frames/s"))
        found.append(Figure(f"map on {label}: one drawing", cost, "ms"))
        page.locator("#lpn-lab-tall").click()
        page.wait_for_timeout(2000)
        page.wait_for_function("Number(document.querySelector('.lab-map')?.dataset.frames || 0) > 0", timeout=60_000)
    return found


def figures(count: int = COUNT) -> list[Figure]:
    """Measure the app on made-up queries."""
    with tempfile.TemporaryDirectory() as folder, tempfile.TemporaryDirectory() as cache:
        options = make(Path(folder), count)
        command = [sys.executable, "-m", "lpn", "explore", *options, "--port", str(free_port())]
        with ServerProcess(command, {**os.environ, "LPN_CACHE": cache}) as app, sync_playwright() as playwright:
            browser = launch(playwright)
            context = browser.new_context(viewport={"width": 1440, "height": 900})
            context.add_init_script("localStorage.setItem('lpn-tour', 'seen')")
            found = measure(context.new_page(), f"{app.url}/?screen=all")
            browser.close()
    return found


if __name__ == "__main__":
    show("Lists and the live map", figures(int(sys.argv[1]) if len(sys.argv) > 1 else COUNT))
