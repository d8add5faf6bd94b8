"""The real app on real files, and a real browser."""

from __future__ import annotations

import os
import re
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from playwright.sync_api import Browser, BrowserContext, Locator, Page, expect, sync_playwright

from lpn.core.demo import DEMO
from lpn.models.checkpoints import save
from lpn.models.export import export
from lpn.models.network import LPN
from lpn.models.spec import ModelSpec
from tests.conftest import RealRun
from tools.fixtures import small_worlds
from tools.fixtures.chromium import launch
from tools.fixtures.published_results import save_result


@dataclass(frozen=True)
class Running:
    """A running app and the files it was started on."""

    url: str
    data: Path
    model: Path


@contextmanager
def started(
    data: Path,
    model: Path,
    cache: Path,
    default: bool = False,
    saved: Path | None = None,
    beside: Path | None = None,
    options: Sequence[str] = (),
) -> Iterator[Running]:
    """`lpn explore` as a process of its own; by default it is told neither data nor model, or a saved result for a model."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    source = ["--model", model] if saved is None else ["--saved", saved, "--n-parts", "4"]
    source += [] if beside is None else ["--beside", beside]
    chosen = [] if default else ["--data", data, *source]
    command = [sys.executable, "-m", "lpn", "explore", *chosen, "--port", str(port), *options]
    environment = {**os.environ, "LPN_CACHE": str(cache)}
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)
    assert process.stdout is not None
    said: list[str] = []
    url = None
    for line in process.stdout:
        said.append(line)
        if found := re.search(r"ready: (http://\S+)", line):
            url = found[1]
            break
    try:
        assert url, "the app ended without an address: " + "".join(said)
        yield Running(url, data, model)
    finally:
        process.terminate()
        process.stdout.close()
        process.wait(timeout=20)


@pytest.fixture(scope="package")
def app(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Running]:
    """The app on drawn places."""
    folder = tmp_path_factory.mktemp("app")
    with started(
        small_worlds.make_dataset(folder / "places"), small_worlds.make_model(folder), folder / "cache"
    ) as running:
        yield running


@pytest.fixture
def two_models(tmp_path: Path) -> Iterator[Running]:
    """The app with a network of one part beside that of four."""
    small_worlds.make_model(tmp_path / "n1", n_parts=1).rename(tmp_path / "whole.onnx")
    model, data = small_worlds.make_model(tmp_path), small_worlds.make_dataset(tmp_path / "places")
    with started(data, model, tmp_path / "cache", beside=tmp_path / "whole.onnx") as running:
        yield running


@pytest.fixture
def demo_app(tmp_path: Path) -> Iterator[Running]:
    """The app as it starts when nothing is chosen."""
    with started(DEMO, DEMO / "lpn.onnx", tmp_path / "cache", default=True) as running:
        yield running


@pytest.fixture
def mapped_app(model_file: Path, tmp_path: Path) -> Iterator[Running]:
    """The app on drawn places whose positions are known."""
    data = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places"))
    with started(data, model_file, tmp_path / "cache") as running:
        yield running


@pytest.fixture
def city_app(model_file: Path, tmp_path: Path) -> Iterator[Running]:
    """The app on drawn places whose city stands beside their positions."""
    data = small_worlds.map_dataset(small_worlds.make_dataset(tmp_path / "places"))
    (data / "city.glb").write_bytes(small_worlds.city())
    with started(data, model_file, tmp_path / "cache") as running:
        yield running


@pytest.fixture
def saved_app(app: Running, tmp_path: Path) -> Iterator[Running]:
    """The same places and descriptors as of `app`, from a saved result."""
    save_result(tmp_path / "pytorch_result.mat", app.data, app.model)
    with started(app.data, app.model, tmp_path / "cache", saved=tmp_path / "pytorch_result.mat") as running:
        yield running


@pytest.fixture
def panorama_app(tmp_path: Path) -> Iterator[Running]:
    """The app on panoramas and tiles, with an untrained SAFA + LPN."""
    torch.manual_seed(0)
    spec = ModelSpec(
        "resnet18",
        "layer3",
        views=("satellite", "street"),
        shared=False,
        n_parts=4,
        embedding=8 * 256,
        input_size=(48, 256),
        pooling="safa",
        polar=True,
    )
    save(LPN(spec), tmp_path / "safa.safetensors")
    export(tmp_path / "safa.safetensors", tmp_path / "safa.onnx")
    with started(
        small_worlds.make_cvusa(tmp_path / "pairs", 12), tmp_path / "safa.onnx", tmp_path / "cache"
    ) as running:
        yield running


@pytest.fixture
def real_app(real_run: RealRun, tmp_path: Path) -> Iterator[Running]:
    """The app on real University-1652 pictures, with an LPN trained on them."""
    export(real_run.after, tmp_path / "real.onnx")
    with started(real_run.data, tmp_path / "real.onnx", tmp_path / "cache") as running:
        yield running


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Headless Chromium: the system's where there is one, else playwright's own."""
    with sync_playwright() as playwright:
        launched = launch(playwright)
        yield launched
        launched.close()


class Explorer:
    """A page of the app, spoken to as a person would."""

    def __init__(self, page: Page) -> None:
        self.page = page
        self.status = page.locator("#lpn-status")
        self.verdict = page.locator("#lpn-verdict")
        self.rows = page.locator("#lpn-matches .row")
        self.canvas = page.locator("canvas[data-engine]")

    def open(self, url: str) -> None:
        """Load the page and wait for the first answer."""
        self.page.goto(url)
        expect(self.status).not_to_have_attribute("data-seq", "0", timeout=60_000)
        self.page.wait_for_timeout(500)
        notice = self.page.locator(".mantine-Notification-closeButton")
        if notice.count():
            notice.first.click()
            expect(notice).to_have_count(0)

    def sequence(self) -> int:
        """Number of answers shown so far."""
        return int(self.status.get_attribute("data-seq") or 0)

    def expect_status(self, name: str, value: str) -> None:
        """Wait until the page shows an answer with this attribute."""
        expect(self.status).to_have_attribute(f"data-{name}", value, timeout=20_000)
        self.page.wait_for_timeout(120)

    def field(self, label: str) -> Locator:
        """The text or number box in the row of a label."""
        row = self.page.locator(f'label:text-is("{label}")').locator("xpath=ancestor::div[contains(@class,'Flex')][1]")
        return row.locator("input").last

    def fill(self, label: str, value: str) -> None:
        """Type a value into a control."""
        self.page.wait_for_timeout(80)
        box = self.field(label)
        box.fill(value)
        box.press("Enter")

    def tick(self, label: str, on: bool) -> None:
        """Switch a checkbox."""
        self.page.wait_for_timeout(80)
        self.field(label).set_checked(on)

    def key(self, key: str) -> None:
        """Press a key while no control has the focus."""
        self.page.wait_for_timeout(80)
        self.page.evaluate("document.activeElement.blur()")
        self.page.keyboard.press(key)

    def tab(self, name: str) -> None:
        """Open a tab of a panel."""
        self.page.get_by_role("tab", name=name).click()

    def stage(self) -> bytes:
        """A picture of the 3-D stage, taken when it moves no more."""
        self.page.wait_for_timeout(500)
        before, shown = b"", self.canvas.screenshot()
        for _ in range(20):
            if shown == before:
                break
            self.page.wait_for_timeout(200)
            before, shown = shown, self.canvas.screenshot()
        return shown

    def filled(self, axis: int) -> float:
        """How much of the stage's height (axis 0) or width (axis 1) its things take: 0 to 1."""
        picture = cv2.imdecode(np.frombuffer(self.stage(), np.uint8), cv2.IMREAD_COLOR)
        places = np.flatnonzero((picture > 90).any(axis=(1 - axis, 2)))
        return float(places[-1] - places[0]) / picture.shape[axis] if len(places) else 0.0

    def expect_filled(self, axis: int, share: float) -> None:
        """Wait until they take more than that."""
        for _ in range(10):
            if (found := self.filled(axis)) > share:
                return
        raise AssertionError(f"things take {found:.2f} of the stage; expected more than {share}")


@pytest.fixture
def contexts(browser: Browser) -> Iterator[Callable[..., BrowserContext]]:
    """Makes browser profiles that share nothing and have seen the tour; all are closed at the end."""
    made: list[BrowserContext] = []

    def make(**options: Any) -> BrowserContext:
        made.append(browser.new_context(**{"viewport": {"width": 1456, "height": 835}, **options}))
        made[-1].add_init_script("localStorage.setItem('lpn-tour', 'seen')")
        return made[-1]

    yield make
    for context in made:
        context.close()


@pytest.fixture
def explorer(app: Running, contexts: Callable[[], BrowserContext]) -> Explorer:
    """The app opened in a fresh browser."""
    opened = Explorer(contexts().new_page())
    opened.open(app.url)
    return opened
