"""The real app on real files, and a real browser."""

from __future__ import annotations

import http.server
import os
import re
import shutil
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, BrowserContext, Error, FloatRect, Locator, Page, expect, sync_playwright

from lpn.core.demo import DEMO
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.models.network import LPN
from lpn.models.spec import ModelSpec
from tests.conftest import RealRun
from tools.fixtures import small_worlds
from tools.fixtures.chromium import RETURNING, SHORT_LIVED, launch
from tools.fixtures.published_results import save_result

# Seconds to wait for anything that must come: far longer than it takes, since the machine may be busy.
PATIENCE = 120.0
# Run in each page before its own scripts: no stored settings, no tour, no notice about software WebGL over
# the page, and a quarter of the stage's pixels (viser's own parameter), because software draws them.
_PREPARE = (
    """
const parameter = URLSearchParams.prototype.get;
URLSearchParams.prototype.get = function (name) { return name === 'fixedDpr' ? '0.5' : parameter.call(this, name) };
if (!sessionStorage.begun) { localStorage.clear(); sessionStorage.begun = 1 }
// Pictures of the stage that are not decoded yet: viser gives each an address of its own, which an image is to load.
window.undecoded = new Set();
const source = Object.getOwnPropertyDescriptor(HTMLImageElement.prototype, 'src');
Object.defineProperty(HTMLImageElement.prototype, 'src', { ...source, set(address) {
  if (String(address).startsWith('blob:')) {
    undecoded.add(this);
    for (const end of ['load', 'error']) this.addEventListener(end, () => undecoded.delete(this), { once: true });
  }
  source.set.call(this, address);
} });
"""
    + RETURNING
    + """
addEventListener('DOMContentLoaded', () => document.head.append(Object.assign(
  document.createElement('style'), {textContent: '#webgl-software-rendering { display: none !important }'})));
"""
)
# Resolves when the page has drawn what it knows: twice, as the first frame may have begun before.
_DRAWN = "() => new Promise(done => requestAnimationFrame(() => requestAnimationFrame(() => done())))"

expect.set_options(timeout=1000 * PATIENCE)


@dataclass(frozen=True)
class RunningApp:
    """A running app and the files it was started on.

    Attributes:
        url: address of the former page.
    """

    url: str
    data: Path
    model: Path

    @property
    def screen(self) -> str:
        """The address of the screen."""
        return self.url.replace("/classic", "")


def classic(url: str) -> str:
    """The address of the former page of an app, given the app's, which may have a token."""
    root, mark, query = url.partition("?")
    return f"{root.rstrip('/')}/classic" + (f"/{mark}{query}" if mark else "")


@contextmanager
def started(
    data: Path,
    model: Path,
    cache: Path,
    default: bool = False,
    saved: Path | None = None,
    beside: Sequence[Path] = (),
    options: Sequence[str] = (),
    program: Sequence[str] = ("-m", "lpn"),
    port: int = 0,
) -> Iterator[RunningApp]:
    """Run `lpn explore` as a process.

    Args:
        default: name neither data nor model on the command line, which opens the demo.
        saved: a published result to open in place of the model.
        beside: further models.
        program: what Python runs.
        port: any that is free by default, which the app takes by itself: nobody else can take it meanwhile.
    """
    source = [data, "--model", model]
    if saved is not None:
        source = [saved, "--data", data, "--n-parts", "4"]
    source += ["--beside", *beside] if beside else []
    inputs = [] if default else source
    command = [sys.executable, *program, "explore", *inputs, *options, "--port", str(port)]
    environment = {**os.environ, "LPN_CACHE": str(cache)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
    assert process.stdout is not None
    output: list[str] = []
    url = None
    for line in process.stdout:
        output.append(line)
        if match := re.search(r"ready: (http://\S+)", line):
            url = match[1]
            break
    # A pipe that nobody reads would stop the app when it is full.
    reader = threading.Thread(target=process.stdout.read, daemon=True)
    reader.start()
    try:
        assert url, "the app ended without an address: " + "".join(output)
        yield RunningApp(classic(url), data, model)
    finally:
        process.terminate()
        process.wait(PATIENCE)
        reader.join(PATIENCE)
        process.stdout.close()


@contextmanager
def served_folder(folder: Path) -> Iterator[str]:
    """Serve the files of a folder at another address of this machine, as a notebook's server does; yields the address."""
    handler = partial(http.server.SimpleHTTPRequestHandler, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://localhost:{server.server_port}"
        server.shutdown()


@pytest.fixture(scope="package")
def app(data: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApp]:
    """The app on drawn places."""
    with started(data, model_file, tmp_path_factory.mktemp("app") / "cache") as running:
        yield running


@pytest.fixture
def three_models(data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path) -> Iterator[RunningApp]:
    """The app with networks of one part, and of two parts and more pixels, beside that of four."""
    whole, two = tmp_path / "whole.onnx", tmp_path / "two.onnx"
    whole.symlink_to(one_part_model_file)
    two.symlink_to(small_worlds.make_model(tmp_path / "large", n_parts=2, size=96))
    with started(data, model_file, tmp_path / "cache", beside=[whole, two]) as running:
        yield running


@pytest.fixture
def demo_app(tmp_path: Path) -> Iterator[RunningApp]:
    """The app as it starts when nothing is chosen."""
    with started(DEMO, DEMO / "lpn.onnx", tmp_path / "cache", default=True) as running:
        yield running


@pytest.fixture
def baseline_app(data: Path, model_file: Path, one_part_model_file: Path, tmp_path: Path) -> Iterator[RunningApp]:
    """The app as it starts when nothing is chosen, with a small demo that has a baseline."""
    demo = tmp_path / "demo"
    shutil.copytree(data, demo)
    shutil.copy(model_file, demo / "lpn.onnx")
    shutil.copy(one_part_model_file, demo / "baseline.onnx")
    program = (
        "import runpy; from pathlib import Path; import lpn.core.demo as demo; "
        f"demo.DEMO = Path({str(demo)!r}); demo.DEMO_BASELINE = demo.DEMO / 'baseline.onnx'; demo.DEMO_QUERY = '0007'; "
        "demo.DEMO_PLACE = demo.DEMO_FLIGHT = (demo.DEMO / 'none', demo.DEMO / 'none'); "
        "runpy.run_module('lpn', run_name='__main__', alter_sys=True)"
    )
    with started(demo, demo / "lpn.onnx", tmp_path / "cache", default=True, program=("-c", program)) as running:
        yield running


@pytest.fixture(scope="module")
def mapped_app(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApp]:
    """The app on drawn places with known positions."""
    folder = tmp_path_factory.mktemp("mapped")
    data = small_worlds.map_dataset(small_worlds.make_dataset(folder / "places"))
    with started(data, model_file, folder / "cache") as running:
        yield running


@pytest.fixture
def city_app(model_file: Path, tmp_path: Path) -> Iterator[RunningApp]:
    """The app on drawn places with known positions and a 3-D city."""
    data = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places"))
    (data / "city.glb").write_bytes(small_worlds.city())
    with started(data, model_file, tmp_path / "cache") as running:
        yield running


@pytest.fixture
def saved_app(app: RunningApp, tmp_path: Path) -> Iterator[RunningApp]:
    """The places and descriptors of `app`, from a published result."""
    save_result(tmp_path / "pytorch_result.mat", app.data, app.model)
    with started(app.data, app.model, tmp_path / "cache", saved=tmp_path / "pytorch_result.mat") as running:
        yield running


@pytest.fixture
def panorama_app(tmp_path: Path) -> Iterator[RunningApp]:
    """The app on panoramas and tiles, with an untrained SAFA + LPN."""
    torch.manual_seed(0)
    spec = ModelSpec(
        "resnet18",
        "layer3",
        views=("satellite", "street"),
        shared=False,
        n_parts=4,
        embedding=256,
        input_size=(48, 256),
        pooling="safa",
        maps=1,
        polar=True,
    )
    save(LPN(spec), tmp_path / "safa.safetensors")
    export(tmp_path / "safa.safetensors", tmp_path / "safa.onnx")
    with started(
        small_worlds.make_cvusa(tmp_path / "pairs", 12), tmp_path / "safa.onnx", tmp_path / "cache"
    ) as running:
        yield running


@pytest.fixture
def real_app(real_run: RealRun, tmp_path: Path) -> Iterator[RunningApp]:
    """The app on real University-1652 pictures, with an LPN trained on them."""
    with started(real_run.data, real_run.exported, tmp_path / "cache") as running:
        yield running


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Headless Chromium: the system's where there is one, else playwright's own."""
    with sync_playwright() as playwright:
        launched = launch(playwright, SHORT_LIVED)
        yield launched
        launched.close()


class ExplorerPage:
    """A page of the app, used as a person would."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.status = page.locator("#lpn-status")
        self.verdict = page.locator("#lpn-verdict")
        self.rows = page.locator("#lpn-matches .row")
        self.canvas = page.locator("canvas[data-engine]")
        self.notifications = page.locator(".mantine-Notification-root:not(#webgl-software-rendering)")

    def open(self, url: str) -> None:
        """Load the page, its workbench for an address that names nothing, and wait for the first answer on the stage."""
        self.page.goto(url if "?" in url else f"{url}/?screen=all")
        self.await_answer()

    def await_answer(self) -> None:
        """Wait for the first answer on the stage."""
        expect(self.status).not_to_have_attribute("data-seq", "0")
        expect(self.canvas).to_be_visible()
        self.settle()

    def settle(self) -> None:
        """Wait until the page has drawn the messages that reached it."""
        for _ in range(2):
            self.page.evaluate(_DRAWN)

    def sequence(self) -> int:
        """The number of answers shown so far."""
        return int(self.status.get_attribute("data-seq") or 0)

    def expect_answers(self, count: int) -> None:
        """Check that one more change, of the angle, is answer number `count`: nothing was answered or queued before."""
        self.fill("Rotate", "17")
        self.expect_status("angle", "17")
        assert self.sequence() == count

    def expect_status(self, name: str, value: str) -> None:
        """Wait until the page shows an answer with this attribute."""
        expect(self.status).to_have_attribute(f"data-{name}", value)
        self.settle()

    def eventually(self, check: Callable[[], object]) -> None:
        """Repeat a check until it raises no AssertionError; after `PATIENCE` let the error pass."""
        deadline = time.monotonic() + PATIENCE
        while True:
            try:
                check()
                return
            except AssertionError:
                if time.monotonic() > deadline:
                    raise
            self.page.wait_for_timeout(50)

    def command(self, label: str) -> None:
        """Choose a command in the palette; until its field has the focus, keys go to the page."""
        self.page.keyboard.press("Control+k")
        self.page.get_by_placeholder("Search commands").fill(label)
        expect(self.page.locator(".mantine-Spotlight-action").first).to_contain_text(re.compile(label, re.IGNORECASE))
        self.page.keyboard.press("Enter")

    def field(self, label: str) -> Locator:
        """The text or number box in the row of a label."""
        row = self.page.locator(f'label:text-is("{label}")').locator("xpath=ancestor::div[contains(@class,'Flex')][1]")
        return row.locator("input").last

    def fill(self, label: str, value: str) -> None:
        """Type a value into a control."""
        self.settle()
        box = self.field(label)
        box.fill(value)
        box.press("Enter")

    def tick(self, label: str, on: bool) -> None:
        """Switch a checkbox."""
        self.settle()
        self.field(label).set_checked(on)

    def upload(self, *files: Path) -> None:
        """Choose files of one's own."""
        with self.page.expect_file_chooser(timeout=1000 * PATIENCE) as chooser:
            self.page.get_by_role("button", name="Use my own picture").click()
        chooser.value.set_files(list(files))

    def key(self, key: str) -> None:
        """Press a key while no control has the focus."""
        self.settle()
        self.page.evaluate("document.activeElement.blur()")
        self.page.keyboard.press(key)

    def explain(self) -> None:
        """Press Y, and open the evidence, which is not what comes first for a wrong answer."""
        wrong = "✗" in self.verdict.inner_text()
        self.key("y")
        if wrong:
            expect(self.page.get_by_role("tab", name="True or wrong")).to_have_attribute("aria-selected", "true")
            self.page.get_by_role("tab", name="Why").click()

    def tab(self, name: str) -> None:
        """Open a tab of a panel."""
        self.page.get_by_role("tab", name=name).click()

    def at_rest(self, shown: Locator, holds: Callable[[np.ndarray], bool] = lambda _: True) -> np.ndarray:
        """A picture of an element that no longer changes, (H, W, 3) BGR.

        Args:
            holds: what must be true of the picture; it is taken again until then.
        """
        deadline = time.monotonic() + PATIENCE
        shots = [b"", b""]
        while True:
            self.settle()
            if not self._decoded():
                shots = [b"", b""]
            try:
                shots = [*shots[-2:], shown.screenshot()]
            except Error as error:
                if "not attached" not in error.message:  # else the page has just put another in its place
                    raise
                continue
            if len(set(shots)) == 1:
                picture = cv2.imdecode(np.frombuffer(shots[-1], np.uint8), cv2.IMREAD_COLOR).astype(int)
                if holds(picture):
                    return picture
            assert time.monotonic() < deadline, f"the picture is not as expected after {PATIENCE:g} s"
            self.page.wait_for_timeout(100)

    def _decoded(self) -> bool:
        """Return True if no picture of the stage is still being decoded: a stage without it may be at rest as well."""
        return bool(self.page.evaluate("!window.undecoded?.size"))

    def stage(self, holds: Callable[[np.ndarray], bool] = lambda _: True) -> np.ndarray:
        """A picture of the 3-D stage at rest, as `at_rest` takes it."""
        return self.at_rest(self.canvas, holds)

    def expect_filled(self, axis: int, share: float) -> None:
        """Wait until things take more than a share of the stage's height (axis 0) or width (axis 1)."""

        def filled(picture: np.ndarray) -> bool:
            places = np.flatnonzero((picture > 90).any(axis=(1 - axis, 2)))
            return len(places) > 0 and places[-1] - places[0] > share * picture.shape[axis]

        self.stage(filled)


def expect_accessible(page: Page, rules: Sequence[str] = ()) -> None:
    """Check that axe-core finds nothing serious or critical in a page, by all rules or some."""
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python")
    options = {"runOnly": {"type": "rule", "values": list(rules)}} if rules else {}
    found = axe.Axe().run(page, options={"resultTypes": ["violations"], **options}).response["violations"]
    grave = [one for one in found if one["impact"] in ("serious", "critical")]
    lines = [f"{one['impact']} {one['id']}: {node['html'][:160]}" for one in grave for node in one["nodes"]]
    assert not lines, "\n".join(lines)


def box(locator: Locator) -> FloatRect:
    """Return the box of an element, once it is laid out: a view that is drawn anew has none for a moment."""
    deadline = time.monotonic() + PATIENCE
    while (laid_out := locator.bounding_box()) is None:
        assert time.monotonic() < deadline, f"{locator} has no box"
        locator.page.wait_for_timeout(50)
    return laid_out


def difference(one: np.ndarray, other: np.ndarray) -> float:
    """The share of pixels that differ visibly between two pictures of the stage."""
    return float((np.abs(one - other).max(axis=2) > 25).mean()) if one.shape == other.shape else 1.0


@pytest.fixture
def contexts(browser: Browser) -> Iterator[Callable[..., BrowserContext]]:
    """A function that makes browser profiles, which share nothing and have seen the tour; all are closed at the end."""
    made: list[BrowserContext] = []

    def make(**options: Any) -> BrowserContext:
        made.append(new_context(browser, **options))
        return made[-1]

    yield make
    for context in made:
        context.close()


def empty_context(browser: Browser, **options: Any) -> BrowserContext:
    """A browser profile that has never been here, as patient as all others: playwright itself waits 30 s."""
    context = browser.new_context(**options)
    context.set_default_timeout(1000 * PATIENCE)
    return context


def new_context(browser: Browser, **options: Any) -> BrowserContext:
    """A browser profile that has seen the tour, on a system with a dark theme."""
    given = {"viewport": {"width": 1456, "height": 835}, "color_scheme": "dark", **options}
    context = empty_context(browser, **given)
    context.add_init_script(_PREPARE)
    return context


def deny_storage(page: Page) -> None:
    """Let each use of the browser's storage fail from now on, as it does where a person has denied it."""
    page.evaluate(
        """() => ["getItem", "setItem", "removeItem"].forEach(
          (use) => (Storage.prototype[use] = () => { throw new DOMException("denied", "SecurityError") }))"""
    )


def outlast(page: Page, milliseconds: int) -> None:
    """Give timers of a limit in a page's scripts `PATIENCE`: a page goes on without what is late, as a busy machine is."""
    page.evaluate(
        """([limit, patience]) => {
          const timer = window.setTimeout;
          window.setTimeout = (act, delay, ...rest) => timer(act, delay === limit ? patience : delay, ...rest);
        }""",
        [milliseconds, 1000 * PATIENCE],
    )


@pytest.fixture(scope="package")
def _warm_context(browser: Browser) -> Iterator[BrowserContext]:
    """A profile that keeps the page's scripts in its cache, which halves the time to open a page.

    An empty page stays open in it: without one, each page would open a window of its own, which costs the browser a second.
    """
    context = new_context(browser)
    context.new_page()
    yield context
    context.close()


@pytest.fixture
def new_page(_warm_context: BrowserContext) -> Iterator[Callable[[], Page]]:
    """A function that makes pages without stored settings; all are closed at the end."""
    made: list[Page] = []

    def make() -> Page:
        made.append(_warm_context.new_page())
        return made[-1]

    yield make
    for page in made:
        page.close()
    _warm_context.clear_cookies()


@pytest.fixture
def explorer(app: RunningApp, new_page: Callable[[], Page]) -> ExplorerPage:
    """The app opened in a page of its own."""
    opened = ExplorerPage(new_page())
    opened.open(app.url)
    return opened
