"""Drive a real page in headless Chromium with mouse, fields, and keys."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterable
from typing import TypeVar

from playwright.sync_api import Browser, BrowserContext, Error, Locator, Page, sync_playwright

from tools.fixtures.chromium import launch, returning
from tools.soak import page_content
from tools.soak.client_state import ClientState, PictureNames, UploadedPicture, shows_state, unexpected_links
from tools.soak.websocket_driver import BOUND, RATE, FaultError, SettledPage, StoppedError

T = TypeVar("T")
# The page writes its address late, so what it is told to write is noted when it is told, and taken with the next look.
SHOWN = """
() => {
  const html = (id) => document.getElementById(id)?.outerHTML ?? "";
  const told = window.lpn;
  if (told?.address && !told.listened) {
    const plain = told.address;
    told.listened = [];
    told.address = (query, keys) => { told.listened.push(query); plain(query, keys); };
  }
  const links = told?.listened?.splice(0) ?? [];
  return [links, location.search, html("lpn-status"), html("lpn-matches"), html("lpn-parts")];
}
"""
# Seconds between two looks at the page.
EVERY = 0.03
# Attempts to type a number until the box shows it: a page that is redrawn between selecting the old number and typing can keep
# a part of it.
TYPINGS = 5
KEYS = {"Why this answer?": "y", "All pictures in a table": "b", "Next ›": "n", "‹ Previous": "p"}


class Chromium:
    """A browser process for one thread, for a `with` block; playwright's objects belong to the thread that made them."""

    def __enter__(self) -> Browser:
        self._playwright = sync_playwright().start()
        try:
            self.browser = launch(self._playwright, handle_sigint=False)
        except BaseException:
            self._playwright.stop()
            raise
        return self.browser

    def __exit__(self, *_: object) -> None:
        for end in (self.browser.close, self._playwright.stop):
            with contextlib.suppress(Exception):  # Ctrl-C ends the browser, too
                end()


class BrowserDriver:
    """One client in a browser; each visit has a profile of its own.

    Args:
        url: the server's address.
        names: names of the pictures.
        stop: set when the soak ends.
    """

    def __init__(self, browser: Browser, url: str, names: PictureNames, stop: threading.Event) -> None:
        self._browser, self._url, self._names, self._stop = browser, url, names, stop
        self._context: BrowserContext | None = None
        self._changed = time.monotonic()
        self._link: str | None = None
        self._links: list[str] = []
        self._before: list[ClientState] = []
        self.page: Page

    def enter(self, link: str) -> None:
        """Open the page by a link's query, as a browser that comes back."""
        began = time.monotonic()
        self._link, self._links, self._before = None, [], []
        self.errors: list[str] = []
        self._doing(self._open)
        self._doing(lambda: self.page.goto(f"{self._url}/?{link}"))
        self._await(lambda: page_content.status(self._look()[1]).get("seq", "0") != "0", "a first answer")
        notice = self.page.locator(".mantine-Notification-closeButton")  # of software WebGL
        if self._doing(notice.count):
            self._doing(notice.first.click)
        self._doing(lambda: self.page.get_by_text("Shift and zoom", exact=True).click())
        self._doing(lambda: self.page.wait_for_timeout(400))
        self._changed = began

    def _open(self) -> None:
        self._context = returning(self._browser, 1280, 800)
        self._context.set_default_timeout(1000 * BOUND)
        self.page = self._context.new_page()
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))

    def drag(self, label: str, values: list[float]) -> float:
        """Drag a slider's thumb through values, which the page rounds to pixels."""
        row = self._row(label)
        low, high = {"Rotate": (-180.0, 180.0), "Zoom": (0.25, 4.0)}.get(label, (0.0, 2.0))
        thumb, track = row.get_by_role("slider"), row.locator(".mantine-Slider-root")

        def moved() -> float:
            thumb.scroll_into_view_if_needed()
            at, box = thumb.bounding_box(), track.bounding_box()
            assert at is not None
            assert box is not None
            mouse, height = self.page.mouse, at["y"] + at["height"] / 2
            mouse.move(at["x"] + at["width"] / 2, height)
            mouse.down()
            for value in values:
                mouse.move(box["x"] + box["width"] * (value - low) / (high - low), height)
                self._changed = time.monotonic()
                time.sleep(1 / RATE)
            mouse.up()
            return float(row.locator("input").last.input_value())

        return self._doing(moved)

    def fill(self, label: str, value: float) -> None:
        """Type into a slider's field."""

        def typed() -> None:
            box = self._row(label).locator("input").last
            for _ in range(TYPINGS):
                box.fill(f"{value:g}")
                box.press("Enter")
                self.page.wait_for_timeout(60)
                if box.input_value() == f"{value:g}":
                    return
            raise AssertionError(f"{label} shows {box.input_value()} where {value:g} was typed {TYPINGS} times")

        self._changing(typed)

    def switch(self, label: str, on: bool) -> None:
        """Set a checkbox."""
        self._changing(lambda: self._row(label).locator("input").last.set_checked(on))

    def press(self, label: str) -> None:
        """Press the key that stands for a button."""

        def pressed() -> None:
            self.page.evaluate("document.activeElement.blur()")
            self.page.keyboard.press(KEYS[label])

        self._changing(pressed)

    def choose(self, label: str, option: str) -> None:
        """Choose an option: of a row of buttons by its key, else from a list."""
        if option in KEYS:
            self.press(option)
            return

        def chosen() -> None:
            self.page.get_by_label(label, exact=True).click()
            self.page.get_by_role("option", name=option, exact=True).click()

        self._changing(chosen)

    def take(self, task: str) -> None:
        """Choose a task by its button."""
        name = task.replace("-to-", " → ")
        self._changing(lambda: self.page.locator("#lpn-tasks a").get_by_text(name, exact=True).click())

    def send(self, own_picture: UploadedPicture) -> None:
        """Upload a picture."""
        file = {"name": own_picture.name, "mimeType": "image/jpeg", "buffer": own_picture.content}
        self._changing(lambda: self.page.locator("input[type=file]").set_input_files(file))  # type: ignore[arg-type]

    def open_tab(self, name: str) -> None:
        """Open a tab of a panel."""
        self._doing(lambda: self.page.get_by_role("tab", name=name).click())

    def settle(self, state: ClientState, path: Iterable[ClientState] = ()) -> SettledPage:
        """Wait for the answer, and check that the page's URL held nothing foreign before it."""
        found = list[tuple[str | None, str, str, str]]()

        def there() -> bool:
            link, status, matches, parts = self._look()
            if shows_state(self._names, state, link, page_content.status(status)):
                found.append((link, status, matches, parts))
            return bool(found)

        self._await(there, f"{self._names.address(state)} with {self._names.label(state)}")
        seconds = time.monotonic() - self._changed
        if self.errors:
            raise FaultError("page error", "; ".join(self.errors[:3]))
        links, self._links = self._links, []
        if text := unexpected_links(self._names, [state, *path, *self._before], links):
            raise FaultError("foreign state", f"the page's address said {', '.join(text)}, which was not asked for")
        self._before = [
            state,
            *path,
        ]  # a mouse may pass the last value on its way, and what follows comes after that answer
        return SettledPage(page_content.shown(*found[0][1:]), seconds)

    def leave(self, how: str) -> None:
        """Close the profile; to vanish, load another page first."""
        context, self._context = self._context, None
        if context is not None:
            with contextlib.suppress(Error):
                if how == "vanish":
                    self.page.goto("about:blank")
                context.close()

    def _look(self) -> tuple[str | None, str, str, str]:
        links, address, status, matches, parts = self.page.evaluate(SHOWN)
        self._links += links
        self._link = links[-1] if links else self._link
        return address if self._link is None else self._link, status, matches, parts

    def _row(self, label: str) -> Locator:
        return self.page.locator(f'label:text-is("{label}")').locator("xpath=ancestor::div[contains(@class,'Flex')][1]")

    def _await(self, holds: Callable[[], bool], what: str) -> None:
        deadline = time.monotonic() + BOUND
        while not self._doing(holds):
            time.sleep(EVERY)
            if time.monotonic() > deadline:
                link, status, *_ = self._look()
                raise FaultError(
                    "no answer",
                    f"expected {what} within {BOUND:g} s; the page shows {link} with {page_content.status(status)}",
                )

    def _changing(self, act: Callable[[], object]) -> None:
        """Perform an act that the page must answer."""
        self._doing(act)
        self._changed = time.monotonic()

    def _doing(self, act: Callable[[], T]) -> T:
        """Call `act`; an error is a fault of the page, unless the soak ends."""
        try:
            return act()
        except (Error, AssertionError) as error:
            if self._stop.is_set():
                raise StoppedError from error
            raise FaultError("page", f"{type(error).__name__}: {str(error)[:400]}") from error
