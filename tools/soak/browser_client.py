"""A client in headless Chromium, which presses keys."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

from playwright.sync_api import Browser, BrowserContext, Error, sync_playwright

from tools.fixtures.chromium import launch, returning
from tools.soak.client import BOUND, PARTS, FaultError, SoakClient
from tools.soak.page import ClientState

_SHOWN = f"[location.search, ...{list(PARTS)}.map((id) => document.getElementById(id)?.outerHTML ?? '')]"


class BrowserSoakClient(SoakClient):
    """A user of keys; each visit has a profile of its own."""

    _browser: Browser
    _context: BrowserContext

    def run(self) -> None:
        """Visit in a browser of this thread's own, as playwright's objects belong to the thread that made them."""
        with sync_playwright() as playwright, launch(playwright, handle_sigint=False) as self._browser:
            super().run()

    def _acts(self) -> dict[Callable[[], None], float]:
        return {self._pick: 2, self._turn: 4, self._why: 1}

    def _open(self, link: str) -> None:
        self._errors: list[str] = []
        self._context = returning(self._browser, 1280, 800)
        self._context.set_default_timeout(1000 * BOUND)
        self._page = self._context.new_page()
        self._page.on("pageerror", lambda error: self._errors.append(str(error)))
        self._page.goto(f"{self._url}/classic/?{link}")

    def _pick(self) -> None:
        key, by = self._rng.choice([("n", 1), ("p", -1)])
        query = (self._state.query + by) % len(self._reference.tasks[self._state.task].queries)
        self._act("pick", lambda: self._page.keyboard.press(key), self._state.showing(query=query))

    def _turn(self) -> None:
        angle = 180 - (175 - self._state.controls["Rotate"]) % 360
        self._act("turn", lambda: self._page.keyboard.press("j"), self._state.with_control("Rotate", angle))

    def _why(self) -> None:
        self._act("why", lambda: self._page.keyboard.press("y"), replace(self._state, why=not self._state.why))

    def _leave(self) -> None:
        with suppress(Error, AttributeError):
            self._context.close()

    def _look(self) -> tuple[str, list[str]]:
        link, *parts = self._page.evaluate(_SHOWN)
        return link, parts

    def _wait(self, holds: Callable[[], bool]) -> bool:
        time.sleep(0.03)
        return holds()

    def _check(self, _: Sequence[ClientState]) -> None:
        if self._errors:
            raise FaultError("page error", "; ".join(self._errors[:3]))
