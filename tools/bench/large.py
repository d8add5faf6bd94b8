"""The explorer on a data set of 40,000 queries and 51,355 tiles: `python -m tools.bench.large [SHARE] [FOLDER]`.

Makes such a data set in University-1652's layout with descriptors that came along, and measures the real app on it in headless
Chromium. Its pictures are links to a few small files and its descriptors are drawn, both of which change no time. SHARE,
0 .. 1, is how much of it is made, 1 by default; FOLDER is where it is kept for the next time.
"""

from __future__ import annotations

import os
import re
import shutil
import statistics
import sys
import tempfile
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
from playwright.sync_api import Page, sync_playwright

import lpn
from lpn import datasets
from lpn.core.views import View
from lpn.descriptors import STORES, Manifest, Row
from lpn.descriptors.transforms import UNCHANGED
from lpn.models.base import Model
from tools.bench.evaluate import GallerySize, draw
from tools.bench.figures import Figure, below, show
from tools.bench.page import ServerProcess, page_seconds
from tools.fixtures.chromium import launch
from tools.fixtures.processes import free_port

QUERIES, TILES, PLACES = 40_000, 51_355, 951
PICTURES = 64
TURNS = 10
SHOWN = """
([selector, before]) => new Promise(done => {
  const started = performance.now(), check = () => {
    const found = document.querySelector(selector);
    if (performance.now() - started > 20000) return done(NaN);
    if (!found || found.outerHTML === before) return requestAnimationFrame(check);
    requestAnimationFrame(() => requestAnimationFrame(() => done(performance.now() - started)));
  };
  check();
})
"""


def make(folder: Path, share: float) -> tuple[Path, Path]:
    """Make the data set and its model, unless they exist."""
    from tools.fixtures import small_worlds

    data, model = folder / f"large-{round(share * TILES)}", folder / "model.onnx"
    if not model.is_file():
        folder.mkdir(parents=True, exist_ok=True)
        small_worlds.make_model(folder, size=256)
    if (data / "done").is_file():
        return data, model
    shutil.rmtree(data, ignore_errors=True)
    for number in range(PICTURES):
        small_worlds.write(data / "pictures" / f"{number}.jpg", small_worlds.place(number))
    pictures = sorted((data / "pictures").iterdir())
    opened = lpn.load(model)
    size = GallerySize("large", round(share * QUERIES), round(share * TILES), max(round(share * TILES) // PLACES, 1))
    queries, asked, tiles, labels = draw(size, 1.0)
    # Pictures of one place lie together, and files are listed by place.
    queries = queries[np.argsort(asked, kind="stable")]
    sides: list[tuple[str, View, np.ndarray, np.ndarray]] = [
        ("query", "drone", np.sort(asked), queries),
        ("gallery", "satellite", labels, tiles),
    ]
    for role, view, of, values in sides:
        first = np.searchsorted(of, of)
        for index, label in enumerate(of.tolist()):
            file = data / "test" / f"{role}_{view}" / f"{label:04d}" / f"image-{index - first[index]:03d}.jpg"
            if first[index] == index:
                file.parent.mkdir(parents=True)
            os.link(pictures[index % PICTURES], file)
        _keep(data, role, view, opened, values)
    (data / "done").touch()
    return data, model


def _keep(data: Path, role: str, view: View, model: Model, values: np.ndarray) -> None:
    """Save descriptors as a store inside the data set."""
    dataset = datasets.open_dataset(data)
    listed = dataset.queries(view) if role == "query" else dataset.gallery(view)
    rows = tuple(Row("/".join(p.path.parts[-2:]), p.path.stat().st_size, 0, None) for p in listed)
    store = data / STORES / f"{role}_{view}"
    store.mkdir(parents=True)
    np.save(store / "descriptors.npy", values.reshape(len(values), model.n_parts, -1))
    (store / "manifest.json").write_bytes(Manifest.for_model(model, view, UNCHANGED, rows).to_json())


def seconds_until(page: Page, selector: str, act: str) -> float:
    """Seconds from an act, given as JavaScript, to two frames after an element has changed."""
    before = page.evaluate("s => document.querySelector(s)?.outerHTML ?? ''", selector)
    page.evaluate(act)
    seconds = float(page.evaluate(SHOWN, [selector, before])) / 1000
    if seconds != seconds:
        raise SystemExit(f"{selector} did not change within 20 s.")
    return seconds


def turns(page: Page) -> float:
    """Median seconds from a scroll to another place of the list of queries to its pictures' names."""
    times = []
    for number in range(TURNS):
        act = f"document.querySelector('#lpn-queries').scrollTop = {(number + 1) * 20_000}"
        times.append(seconds_until(page, "#lpn-queries .thumb[data-query]", act))
        page.wait_for_timeout(100)
    return statistics.median(times)


def picks(page: Page) -> float:
    """Median seconds from a click on a picture to its answer."""
    times = []
    for number in range(TURNS):
        act = f"document.querySelectorAll('#lpn-queries .thumb[data-query]:not(.chosen)')[{number % 4}].click()"
        times.append(seconds_until(page, "#lpn-matches", act))
        page.wait_for_timeout(100)
    return statistics.median(times)


def memory(process: int) -> tuple[float, float]:
    """Resident memory of a process in bytes: in all, and without mapped files."""
    status = Path(f"/proc/{process}/status").read_text()
    found = dict(re.findall(r"^(VmRSS|RssAnon):\s+(\d+) kB", status, re.MULTILINE))
    return 1024.0 * int(found["VmRSS"]), 1024.0 * int(found["RssAnon"])


def measure(app: ServerProcess) -> list[Figure]:
    """Measure a running app."""
    with sync_playwright() as playwright:
        browser = launch(playwright)
        page_seconds(browser, app.url)[1].context.close()  # the browser's own start is nobody's
        opened, page = page_seconds(browser, app.url)
        meanwhile = turns(page), picks(page)
        if page.query_selector("#lpn-header .big"):
            raise SystemExit("All queries were ranked before the list was scrolled; give a larger share.")
        started = time.perf_counter()
        page.wait_for_selector("#lpn-header .big", state="attached", timeout=3_600_000)
        ranked = time.perf_counter() - started
        page.wait_for_timeout(2000)
        found = [
            below("command to address", app.seconds, 5, "s"),
            Figure("address to complete page", opened, "s"),
            Figure("scroll to other pictures", turns(page), "s"),
            Figure("scroll to other pictures while queries are ranked", meanwhile[0], "s"),
            Figure("pick a picture", picks(page), "s"),
            Figure("pick a picture while queries are ranked", meanwhile[1], "s"),
            Figure("until all queries are ranked, after that", ranked, "s"),
        ]
        started = time.perf_counter()
        page.keyboard.press("b")
        page.wait_for_selector("#lpn-lab-table", timeout=60_000)
        found.append(Figure("open the failure laboratory", time.perf_counter() - started, "s"))
        resident, own = memory(app.pid)
        found.append(Figure("resident memory, mapped descriptors included", resident / 1e9, "GB"))
        found.append(Figure("resident memory of no file", own / 1e9, "GB"))
        browser.close()
    return found


def figures(share: float = 1.0, kept: Path | None = None) -> list[Figure]:
    """Measure such a data set, which is kept in a folder where one is given."""
    with ExitStack() as stack:
        folder = kept or Path(stack.enter_context(tempfile.TemporaryDirectory()))
        data, model = make(folder, share)
        cache = stack.enter_context(tempfile.TemporaryDirectory())
        environment = {**os.environ, "LPN_CACHE": cache}
        command = [
            sys.executable,
            "-m",
            "lpn",
            "explore",
            "--data",
            str(data),
            "--model",
            str(model),
            "--port",
        ]
        with ServerProcess([*command, str(free_port())], environment) as app:
            found = measure(app)
        with ServerProcess([*command, str(free_port())], environment) as again:
            found.append(below("command to address, all ranked before", again.seconds, 5, "s"))
    what = f"{round(share * QUERIES):,} queries, {round(share * TILES):,} tiles: "
    return [replace(figure, what=what + figure.what) for figure in found]


if __name__ == "__main__":
    part = float(sys.argv[1]) if len(sys.argv) > 1 else 1.0
    if not 0 < part <= 1:
        raise SystemExit(f"The share is {part:g}; expected more than 0 and at most 1.")
    show("A large data set", figures(part, Path(sys.argv[2]) if len(sys.argv) > 2 else None))
