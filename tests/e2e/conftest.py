"""The real app on real files, and a real browser."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import Browser, BrowserContext, FloatRect, Locator, Page, expect, sync_playwright

from explorer.app import App
from explorer.workspace import Workspace
from lpn.core.numbers import rounded_to_sum
from lpn.library.answer import Answer
from tests.explorer.conftest import answered, mapped_workspace
from tools.fixtures.chromium import SHORT_LIVED, launch
from tools.fixtures.processes import Process, free_port

Contexts = Callable[..., BrowserContext]
NewPage = Callable[[], Page]
# Seconds to wait for anything that must come: far longer than it takes, since the machine may be busy.
PATIENCE = 120.0
# Run in each page before its own scripts: nothing is stored yet, and the scene has a quarter of its pixels (for viser).
_PREPARE = """
const parameter = URLSearchParams.prototype.get;
URLSearchParams.prototype.get = function (name) { return name === 'fixedDpr' ? '0.5' : parameter.call(this, name) };
if (!sessionStorage.begun) { localStorage.clear(); sessionStorage.begun = 1 }
"""
# Without WebGL a page has no scene, whose drawing without a GPU takes longer than all else.
_WITHOUT_WEBGL = """
const made = HTMLCanvasElement.prototype.getContext;
HTMLCanvasElement.prototype.getContext = function (kind, ...rest) {
  return kind.startsWith("webgl") ? null : made.call(this, kind, ...rest);
};
"""

expect.set_options(timeout=1000 * PATIENCE)


@dataclass(frozen=True)
class RunningApp:
    """A running app and the files it was started on.

    Attributes:
        url: its address, which ends with a slash or a token.
    """

    url: str
    data: Path
    model: Path


@contextmanager
def started(
    data: Path, model: Path, cache: Path, default: bool = False, options: Sequence[str] = (), port: int = 0
) -> Iterator[RunningApp]:
    """Run `lpn explore` as a process.

    Args:
        default: name neither data nor model on the command line, which opens the demo.
        port: any that is free by default, which the app takes by itself: nobody else can take it meanwhile.
    """
    source = [] if default else [data, "--model", model]
    with Process(["explore", *source, *options, "--port", port], cache) as process:
        process.until(lambda: "ready: http" in process.out)
        url = process.out.partition("ready: ")[2].split()[0]
        yield RunningApp(url if "?" in url else f"{url.rstrip('/')}/", data, model)
        process.terminate()
        process.ended()


@pytest.fixture(scope="package")
def app(data: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApp]:
    """The app on drawn places."""
    with started(data, model_file, tmp_path_factory.mktemp("app") / "cache") as running:
        yield running


@dataclass(frozen=True)
class Running:
    """The app on eight places of a map, in this process."""

    app: App
    workspace: Workspace

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.app.server.get_port()}/"

    def analysis(self, **state: Any) -> Answer:
        return answered(self.workspace, **state).analysis


@pytest.fixture(scope="package")
def running(tmp_path_factory: pytest.TempPathFactory, model_file: Path, one_part_model_file: Path) -> Iterator[Running]:
    folder = tmp_path_factory.mktemp("screen")
    with (
        mapped_workspace(folder, model_file, one_part_model_file) as workspace,
        closing(App(workspace, "127.0.0.1", free_port())) as app,
    ):
        yield Running(app, workspace)


@pytest.fixture(scope="package")
def browser() -> Iterator[Browser]:
    """Headless Chromium: the system's where there is one, else playwright's own."""
    with sync_playwright() as playwright:
        launched = launch(playwright, SHORT_LIVED)
        yield launched
        launched.close()


class Screen:
    """A page of the screen."""

    def __init__(self, page: Page, url: str) -> None:
        self.page, self.url = page, url
        self.complaints: list[str] = []
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        page.on("console", lambda said: self.complaints.append(said.text) if said.type == "error" else None)
        self.photo, self.headline = page.locator("#photo .frame"), page.locator("#headline")
        self.rows, self.tiles = page.locator("#rows .row"), page.locator("#strip .tile")

    def open(self, search: str = "") -> Screen:
        self.page.goto(self.url + search)
        self.rest()
        return self

    def rest(self, angle: str | None = None) -> None:
        """Wait until the page shows the requested result."""
        body = self.page.locator("body")
        expect(body).to_have_attribute("data-sequence", re.compile(r"\d"))
        # A state that has come is drawn with the next frame.
        self.page.evaluate("() => new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
        expect(body).not_to_have_class(re.compile("wait|turning"))
        if angle is not None:
            expect(self.photo).to_have_attribute("aria-valuenow", angle)
            expect(body).not_to_have_class(re.compile("wait|turning"))

    def key(self, key: str) -> None:
        self.page.keyboard.press(key)

    def expect_numbers(self, analysis: Answer) -> None:
        """Check each number in sight against an analysis."""
        first, verdict = analysis.ranking.match(0), analysis.verdict
        expect(self.headline.locator("p")).to_contain_text(verdict.headline)
        shares = rounded_to_sum(first.contributions.tolist(), total=first.distance2)
        for row, share, gain in zip(self.rows.all(), shares, verdict.figures, strict=True):
            expect(row.locator("b")).to_have_text(f"{share:.3f}")
            expect(row.locator(".line i")).to_contain_text(f"{abs(gain):.3f}")
        sums = self.page.locator("#sum .total b")
        expect(sums.first).to_have_text(f"{first.distance2:.3f}")
        expect(sums.last).to_have_text(f"{verdict.rival.distance2:.3f}")
        for place, match in enumerate(analysis.matches[:3]):
            expect(self.tiles.nth(place)).to_have_attribute(
                "aria-label",
                f"{match.rank}: {analysis.task.gallery[match.index].title}, distance {match.distance2:.3f}",
            )


@pytest.fixture
def screen(running: Running, new_page: NewPage) -> Screen:
    return Screen(new_page(), running.url)


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


@pytest.fixture
def contexts(browser: Browser) -> Iterator[Contexts]:
    """A function that makes browser profiles, which share nothing; all are closed at the end."""
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
    """A browser profile on a system with a dark theme."""
    given = {"viewport": {"width": 1456, "height": 835}, "color_scheme": "dark", **options}
    context = empty_context(browser, **given)
    context.add_init_script(_PREPARE)
    return context


@pytest.fixture(scope="package")
def _warm_context(browser: Browser) -> Iterator[BrowserContext]:
    """A profile without WebGL that keeps the page's scripts in its cache, which halves the time to open a page.

    An empty page stays open in it: without one, each page would open a window of its own, which costs the browser a second.
    """
    context = new_context(browser)
    context.add_init_script(_WITHOUT_WEBGL)
    context.new_page()
    yield context
    context.close()


@pytest.fixture
def new_page(_warm_context: BrowserContext) -> Iterator[NewPage]:
    """A function that makes pages without WebGL and stored settings; all are closed at the end."""
    made: list[Page] = []

    def make() -> Page:
        made.append(_warm_context.new_page())
        return made[-1]

    yield make
    for page in made:
        page.close()
    _warm_context.clear_cookies()
