"""A client in headless Chromium, which presses keys."""

from __future__ import annotations

import re
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

from playwright.sync_api import Browser, BrowserContext, Error, sync_playwright

from tools.fixtures.chromium import launch
from tools.soak.client import BOUND, FaultError, SoakClient
from tools.soak.reference import ClientState, PageContent, ShownTile

# A tile's label.
_LABEL = re.compile(r"(\d+): (.*), distance (\d\.\d+)", re.DOTALL)
# The photo's label and angle, whether the page waits for a result, the labels of the tiles, and the numbers at the rows' heads.
_SHOWN = """() => {
  const frame = document.querySelector("#photo .frame");
  const still = document.body.dataset.sequence && !/wait|turning|down/.test(document.body.className);
  const texts = (selector, read) => [...document.querySelectorAll(selector)].map(read);
  return [
    frame?.querySelector(".picture").ariaLabel ?? "", Number(frame?.ariaValueNow ?? NaN), Boolean(still),
    texts("#strip .tile", (tile) => tile.ariaLabel), texts("#rows .row b", (share) => share.textContent),
  ];
}"""


class BrowserSoakClient(SoakClient):
    """A user of keys; each visit has a profile of its own."""

    _browser: Browser
    _context: BrowserContext

    def run(self) -> None:
        """Visit in a browser of this thread's own, as playwright's objects belong to the thread that made them."""
        with sync_playwright() as playwright, launch(playwright, handle_sigint=False) as self._browser:
            super().run()

    def _acts(self) -> dict[Callable[[], None], float]:
        return {self._pick: 2, self._turn: 4}

    def _open(self, link: str) -> None:
        self._errors: list[str] = []
        self._context = self._browser.new_context(viewport={"width": 1280, "height": 800})
        self._context.set_default_timeout(1000 * BOUND)
        self._page = self._context.new_page()
        self._page.on("pageerror", lambda error: self._errors.append(str(error)))
        self._page.goto(f"{self._url}{'&' if '?' in self._url else '?'}{link}")

    def _pick(self) -> None:
        key, by = self._rng.choice([("n", 1), ("p", -1)])
        query = (self._state.query + by) % len(self._reference.tasks[self._state.task].queries)
        self._act("pick", lambda: self._page.keyboard.press(key), self._state.showing(query=query))

    def _turn(self) -> None:
        angle = (self._state.angle + 15 + 180) % 360 - 180
        self._act("turn", lambda: self._page.keyboard.press("j"), replace(self._state, angle=angle))

    def _leave(self) -> None:
        with suppress(Error, AttributeError):
            self._context.close()

    def _shows(self, state: ClientState) -> bool:
        photo, angle, still, *_ = self._page.evaluate(_SHOWN)
        return bool(still and photo == self._reference.label(state) and (angle - state.angle) % 360 == 0)

    def _look(self) -> PageContent:
        photo, _, _, labels, shares = self._page.evaluate(_SHOWN)
        found = [match for match in map(_LABEL.fullmatch, labels) if match]
        tiles = [ShownTile(int(match[1]), match[2], float(match[3])) for match in found]
        return PageContent(photo, tiles, [float(text) for text in shares])

    def _wait(self, holds: Callable[[], bool]) -> bool:
        time.sleep(0.03)
        return holds()

    def _check(self, _: Sequence[ClientState]) -> None:
        if self._errors:
            raise FaultError("page error", "; ".join(self._errors[:3]))
