"""An app that offers several workspaces, as a person uses it."""

from __future__ import annotations

import gc
import re
import threading
import time
import weakref
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
from playwright.sync_api import BrowserContext, Locator, Page, expect

from explorer.app import App
from explorer.client.services import WorkspaceServices
from explorer.client.session import ClientSession
from explorer.client.views import ClientViews
from explorer.opening import open_model
from explorer.stage.viewport import EDGE
from explorer.url_state import UrlState
from explorer.workspace import LazyWorkspace, Workspace
from lpn.core.errors import DataError
from lpn.core.progress import report_progress
from tests.e2e.conftest import PATIENCE, ExplorerPage, box, classic
from tools.fixtures.processes import free_port
from tools.fixtures.websocket_client import WebSocketClient


@dataclass(frozen=True)
class Offer:
    """A running app with a workspace of four parts, one of one part that opens when it may, and one that never opens."""

    app: App
    may_open: threading.Event

    @property
    def url(self) -> str:
        return classic(f"http://127.0.0.1:{self.app.server.get_port()}")


@pytest.fixture
def offer(data: Path, model_file: Path, one_part_model_file: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Offer]:
    monkeypatch.setenv("LPN_CACHE", str(model_file.parent / "cache"))
    may_open = threading.Event()

    def slowly() -> Workspace:
        report_progress("Describing", 3, 7)
        assert may_open.wait(PATIENCE)
        return open_model(data, one_part_model_file)

    def never() -> Workspace:
        raise DataError("The map is not there; give another.")

    others = {"whole": LazyWorkspace("whole pictures", slowly), "broken": LazyWorkspace("a broken map", never)}
    app = App(open_model(data, model_file), "127.0.0.1", free_port(), None, "four rings", others)
    yield Offer(app, may_open)
    may_open.set()
    app.close()


# Notes the theme of each frame: that of the cover while it lies over the page, else the page's.
NOTE_THEMES = """(() => {
  window.themes = [];
  const note = () => {
    const cover = document.getElementById("lpn-loading"), root = document.documentElement;
    if (cover?.className) themes.push(cover.className);
    else if (window.lpn) themes.push(root.getAttribute("data-mantine-color-scheme"), getComputedStyle(document.body).colorScheme);
    requestAnimationFrame(note);
  };
  note();
})()"""


def expect_only(page: Page, theme: str) -> None:
    assert set(page.evaluate("themes")) == {theme}


def chip(explorer: ExplorerPage, label: str) -> Locator:
    return explorer.page.locator("#lpn-workspaces a", has_text=label)


def expect_workspace(explorer: ExplorerPage, label: str, parts: int) -> None:
    expect(chip(explorer, label)).to_have_class("chosen")
    expect(explorer.page.locator("#lpn-header .facts", has_text=f"n = {parts}")).to_be_visible()


@pytest.mark.slow
def test_a_page_changes_its_workspace_and_back(
    offer: Offer, new_page: Callable[[], Page], caplog: pytest.LogCaptureFixture
) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(offer.url)
    expect_workspace(explorer, "four rings", 4)
    former = weakref.ref(*offer.app._sessions.values())
    explorer.key("o")
    expect(explorer.page.locator("html")).to_have_attribute("data-mantine-color-scheme", "light")
    chip(explorer, "whole pictures").click()
    notice = explorer.page.locator(".mantine-Notification-root", has_text="Opening whole pictures")
    expect(notice).to_contain_text("3 of 7 pictures are described")
    bar = explorer.page.locator("#lpn-work")
    expect(bar).to_have_js_property("value", 3)
    expect(bar).to_have_js_property("max", 7)
    explorer.fill("Rotate", "33")  # the page goes on meanwhile
    explorer.expect_status("angle", "33")
    offer.may_open.set()
    expect_workspace(explorer, "whole pictures", 1)
    expect(notice).to_have_count(0)
    expect(bar).to_be_hidden()
    explorer.expect_status("angle", "0")
    expect(explorer.page.locator("html")).to_have_attribute("data-mantine-color-scheme", "light")
    explorer.key("b")  # its windows know the size of the stage
    lab = explorer.page.locator(".mantine-Paper-root", has=explorer.page.locator("#lpn-lab-table")).last
    expect(lab).to_be_visible()

    def fits() -> None:
        window, stage = lab.bounding_box(), explorer.canvas.bounding_box()
        assert window is not None
        assert stage is not None
        assert window["width"] == pytest.approx(stage["width"] - 2 * EDGE, abs=2)

    explorer.eventually(fits)
    explorer.key("b")
    expect(lab).to_have_count(0)
    explorer.key("n")  # its controls, keys, and messages work
    explorer.expect_status("query", "1")
    name = explorer.status.get_attribute("data-name")
    expect(explorer.page).to_have_url(re.compile(f"(?=.*show=whole)(?=.*query={name})"))
    explorer.page.reload()
    expect_workspace(explorer, "whole pictures", 1)
    explorer.expect_status("query", "1")
    chip(explorer, "four rings").click()
    expect_workspace(explorer, "four rings", 4)
    explorer.expect_status("query", "0")
    expect(explorer.page).to_have_url(re.compile(r"\?(?!.*show=)"))
    for label, parts in (("whole pictures", 1), ("four rings", 4)):  # a page comes back to the picture that it left
        chip(explorer, label).click()
        expect_workspace(explorer, label, parts)
        explorer.expect_status("query", "1" if parts == 1 else "0")
    explorer.page.set_viewport_size({"width": 1000, "height": 900})  # no stage of a former session is asked to fit
    explorer.key("n")
    explorer.expect_status("query", "1")
    until = time.monotonic() + PATIENCE
    while gc.collect() >= 0 and former() is not None and time.monotonic() < until:
        time.sleep(0.2)
    assert former() is None
    assert len(offer.app._sessions) == 1
    assert "Traceback" not in caplog.text


# The next session's script runs twice, and its control of messages is drawn late, as on a busy machine.
LATE = """() => {
  const { greet } = lpn, { field } = lpn.viser, before = lpn.bridge;
  lpn.greet = () => {
    greet();
    greet();
  };
  let asked;
  lpn.viser.field = (uuid) => (uuid !== before && performance.now() - (asked ??= performance.now()) < 1000 ? null : field(uuid));
}"""


@pytest.mark.slow
def test_the_first_screen_of_another_place_is_there_before_its_session_and_loses_no_press(
    offer: Offer, new_page: Callable[[], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    build, may_build = ClientSession.__init__, threading.Event()

    def late(session: ClientSession, client: Any, services: WorkspaceServices, *rest: Any) -> None:
        assert services.workspace.key != "whole" or may_build.wait(PATIENCE)
        build(session, client, services, *rest)

    show, preview = ClientViews.show, ClientViews.preview
    previewed, drawn, order = threading.Event(), threading.Event(), list[str]()

    def draw_slowly(views: ClientViews, *rest: Any) -> None:
        opening = offer.may_open.is_set() and views._workspace.key != "whole"
        if opening:
            previewed.wait(2)
        show(views, *rest)
        if opening:
            order.append("the place before")
            drawn.set()

    def note(views: ClientViews, *rest: Any) -> None:
        preview(views, *rest)
        order.append("the next place")
        previewed.set()

    monkeypatch.setattr(ClientSession, "__init__", late)
    monkeypatch.setattr(ClientViews, "show", draw_slowly)
    monkeypatch.setattr(ClientViews, "preview", note)
    page = new_page()
    page.goto(f"{offer.url}/?screen=first")
    page.locator("#lpn-first .choice", has_text="whole pictures").click()
    expect(page.locator(".mantine-Notification-root", has_text="Opening whole pictures")).to_be_visible()
    offer.may_open.set()
    for session in offer.app._sessions.values():
        session._worker.wake()
    expect(page.locator("#lpn-first .choice.chosen")).to_have_text("whole pictures")
    assert drawn.wait(PATIENCE)
    assert order[-1] == "the next place"
    page.locator("#lpn-first [data-act=why]").click()
    page.evaluate(LATE)
    may_build.set()
    expect(page.locator("#lpn-first .reason")).to_be_visible()
    expect(page).to_have_url(re.compile("(?=.*show=whole)(?=.*why=1)"))


@pytest.mark.slow
@pytest.mark.parametrize("phone", [False, True], ids=["wide", "phone"])
def test_a_change_of_place_on_the_first_screen_shows_no_other_theme(
    offer: Offer, contexts: Callable[..., BrowserContext], phone: bool
) -> None:
    size = {"width": 390, "height": 844} if phone else {"width": 1440, "height": 900}
    page = contexts(color_scheme="light", viewport=size, has_touch=phone).new_page()
    offer.may_open.set()
    page.goto(f"{offer.url}/?screen=first")
    expect(page.locator("#lpn-first .choice.chosen")).to_have_text("four rings")
    page.evaluate(NOTE_THEMES)
    page.locator("#lpn-first .choice", has_text="whole pictures").click()
    expect(page).to_have_url(re.compile("show=whole"))  # the session of that place has answered
    expect_only(page, "light")


@pytest.mark.slow
def test_the_stage_of_another_place_is_awaited_by_the_outlines_of_its_pictures_in_the_same_theme(
    offer: Offer, contexts: Callable[..., BrowserContext], monkeypatch: pytest.MonkeyPatch
) -> None:
    build, may_build = ClientSession.__init__, threading.Event()

    def late(session: ClientSession, client: Any, services: WorkspaceServices, *rest: Any) -> None:
        assert services.workspace.key != "whole" or may_build.wait(PATIENCE)
        build(session, client, services, *rest)

    monkeypatch.setattr(ClientSession, "__init__", late)
    offer.may_open.set()
    explorer = ExplorerPage(contexts(color_scheme="light").new_page())
    explorer.open(offer.url)
    over, coming = explorer.page.locator("#lpn-hud > *"), explorer.page.locator("#lpn-hud .coming")
    # A busy page may draw its stage for a new size until that moment.
    explorer.page.evaluate("""() => {
      const clear = lpn.clearStage;
      lpn.clearStage = () => {
        window.height_before = document.querySelector("#lpn-stage-query").getBoundingClientRect().height;
        clear();
      };
    }""")
    explorer.page.evaluate(NOTE_THEMES)
    chip(explorer, "whole pictures").click()
    expect(coming).to_have_count(3)  # the pair and the strip of tiles
    expect(over).to_have_count(3)
    assert box(coming.first)["height"] == pytest.approx(explorer.page.evaluate("height_before"), abs=2)
    may_build.set()
    expect_workspace(explorer, "whole pictures", 1)
    expect(explorer.page.locator("#lpn-turn")).to_be_visible()
    expect(coming).to_have_count(0)
    expect_only(explorer.page, "light")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("system", "search", "theme"),
    [
        ("light", "?screen=first", "light"),
        ("dark", "?screen=all&theme=light", "light"),
        ("light", "?screen=first&theme=dark", "dark"),
        ("light", "?show=whole&screen=first", "light"),
    ],
)
def test_a_page_opens_in_its_theme(
    offer: Offer, contexts: Callable[..., BrowserContext], system: str, search: str, theme: str
) -> None:
    page = contexts(color_scheme=system).new_page()
    page.add_init_script(NOTE_THEMES)
    offer.may_open.set()
    page.goto(f"{offer.url}/{search}")
    expect(page.locator("#lpn-loading")).to_have_count(0)
    page.wait_for_function("lpn.screen() && !document.querySelector('#lpn-first .wait')")  # the first answer
    expect_only(page, theme)


def test_a_page_draws_nothing_before_its_address_is_read(offer: Offer, monkeypatch: pytest.MonkeyPatch) -> None:
    read = UrlState.read

    def slowly(*arguments: Any) -> Any:
        for session in offer.app._sessions.values():
            session._worker.wake()
        time.sleep(0.5)
        return read(*arguments)

    monkeypatch.setattr(UrlState, "read", slowly)
    with WebSocketClient(offer.url, origin=offer.url.removesuffix("/classic")) as client:
        client.greet("?screen=all&query=~3")
        assert (client.status("seq"), client.status("query")) == ("1", "3")


def test_a_link_to_another_place_stays_the_address_while_that_opens(offer: Offer) -> None:
    with WebSocketClient(offer.url, origin=offer.url.removesuffix("/classic")) as client:
        client.greet("?show=whole&query=~1")  # returns when the place that is open shows its first answer
        client.wait(lambda: any(title == "Opening whole pictures" for title, _ in client.notices))
        assert client.links == []
        former = client.find("page")
        offer.may_open.set()
        client.wait(lambda: client.find("page") not in (None, former))
        client.greet("?show=whole&query=~1")
        client.wait(lambda: client.link is not None)
        assert all("show=whole" in link for link in client.links)


@pytest.mark.slow
def test_a_workspace_that_does_not_open_and_one_that_is_asked_for_twice_leave_one_whole_page(
    offer: Offer, new_page: Callable[[], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(f"{offer.url}/?show=broken")
    said = explorer.page.locator(".mantine-Notification-root", has_text="Not opened: a broken map")
    expect(said).to_contain_text("The map is not there; give another.")
    expect_workspace(explorer, "four rings", 4)
    expect(explorer.page).to_have_url(re.compile(r"\?(?!.*show=)"))
    for _ in range(3):
        chip(explorer, "whole pictures").click()
    notice = explorer.page.locator(".mantine-Notification-root", has_text="Opening whole pictures")
    expect(notice).to_have_count(1)
    build = ClientSession.__init__

    def failing(session: ClientSession, client: Any, services: WorkspaceServices, *rest: Any) -> None:
        if services.workspace.key == "whole":
            raise RuntimeError("on purpose")
        build(session, client, services, *rest)

    monkeypatch.setattr(ClientSession, "__init__", failing)
    offer.may_open.set()
    failed = explorer.page.locator(".mantine-Notification-root", has_text="Not opened: whole pictures")
    expect(failed).to_contain_text("The server's log has the details.")
    expect_workspace(explorer, "four rings", 4)
    explorer.key("n")
    explorer.expect_status("query", "1")
