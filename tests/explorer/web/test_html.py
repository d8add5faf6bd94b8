"""HTML elements that several threads write to."""

from __future__ import annotations

import threading
from types import SimpleNamespace
from typing import Any, cast

import viser

from explorer.web.html import Html


class Handle:
    """Stands for viser's handle; setting the text "one" blocks until `arrive` is set."""

    def __init__(self) -> None:
        self.shown, self.begun, self.arrive = "", threading.Event(), threading.Event()
        self._impl = SimpleNamespace(removed=False)

    @property
    def content(self) -> str:
        return self.shown

    @content.setter
    def content(self, text: str) -> None:
        if text == "one":
            self.begun.set()
            assert self.arrive.wait(120)
        self.shown = text


def test_the_last_text_stays() -> None:
    handle = Handle()
    gui: Any = SimpleNamespace(add_html=lambda _: handle)
    html = Html(cast(viser.GuiApi, gui))
    threads = [threading.Thread(target=html.show, args=(text,)) for text in ("one", "two")]
    threads[0].start()
    assert handle.begun.wait(120)
    threads[1].start()
    threads[1].join(0.2)
    handle.arrive.set()
    for thread in threads:
        thread.join()
    assert handle.shown == "two"


def test_an_element_that_left_the_page_gets_no_updates() -> None:
    handle = Handle()
    gui: Any = SimpleNamespace(add_html=lambda _: handle)
    html = Html(cast(viser.GuiApi, gui))
    html.show("before")
    handle._impl.removed = True
    html.show("after")
    assert handle.shown == "before"
