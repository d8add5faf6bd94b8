from __future__ import annotations

import asyncio
import json
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace
from typing import Any

import pytest

from explorer.server.message_filter import MAX_TEXT
from explorer.web.bridge import MAX_WAITING, PageBridge
from explorer.web.messages import Message


class Gui:
    """The part of viser's interface that a bridge needs."""

    class Text:
        value: Any = ""
        _impl = SimpleNamespace(uuid="the-uuid")

        def on_update(self, function: Callable[[Any], Coroutine[Any, Any, None]]) -> None:
            self.update = function

    def __init__(self) -> None:
        self.text, self.html = Gui.Text(), []
        self._thread_executor = ThreadPoolExecutor()

    def add_text(self, *_: Any) -> Gui.Text:
        return self.text

    def add_html(self, html: str) -> None:
        self.html.append(html)

    def send(self, *messages: Any) -> None:
        """Set the control to each message at once, as viser does, and wait until all are handled."""

        async def sent() -> None:
            for message in messages:
                self.text.value = message
                await self.text.update(None)
            await asyncio.gather(*(asyncio.all_tasks() - {asyncio.current_task()}))

        asyncio.run(sent())


class _Messages(Message):
    """The messages of these tests."""


class _Region(_Messages, tag="region"):
    cells: list[int]


def bridge_of(gui: Gui, take: Callable[[list[int]], None]) -> PageBridge:
    return PageBridge(gui, {_Messages: lambda message: take(message.cells)}, {}, "")  # type: ignore[arg-type]


def region(value: int) -> str:
    return json.dumps({"kind": "region", "value": [value], "count": value})


def test_a_bridge_hands_on_messages_and_drops_everything_else() -> None:
    gui, got = Gui(), []
    bridge = bridge_of(gui, got.append)
    assert "the-uuid" in gui.html[0]
    assert "<script" not in gui.html[0]
    deep = "[" * 50_000
    gui.send(
        None,
        3,
        "",
        "{",
        "[]",
        "null",
        '{"kind": []}',
        '{"kind": "other"}',
        '"region"',
        "x" * (MAX_TEXT + 1),
        deep,
        '{"kind": "region"}',
        '{"kind": "region", "value": ["1"]}',
        '{"kind": "region", "value": [1e400]}',
        '{"kind": "region", "value": ["\\ud800"]}',
    )
    assert got == []
    bridge.receive(region(1))
    assert got == [[1]]


def test_quick_messages_arrive_in_order_while_a_handler_is_slow_or_fails() -> None:
    gui, got, threads = Gui(), [], set[int]()

    def handle(value: list[int]) -> None:
        if value == [1]:
            threading.Event().wait(0.05)
        if value == [2]:
            raise RuntimeError("on purpose")
        threads.add(threading.get_ident())
        got.append(value)

    bridge_of(gui, handle)
    gui.send(*map(region, range(6)))
    assert got == [[0], [1], [3], [4], [5]]
    assert threading.get_ident() not in threads, "a handler must not hold up the event loop"


def test_a_page_that_sends_faster_than_its_handlers_work_has_a_bounded_queue(caplog: pytest.LogCaptureFixture) -> None:
    gui, got = Gui(), []
    bridge_of(gui, got.append)
    gui.send(*map(region, range(MAX_WAITING + 50)))
    assert got == [[number] for number in range(MAX_WAITING)]
    assert [record.message for record in caplog.records if record.levelname == "WARNING"] == [
        f"Dropped message 1 of a page of which {MAX_WAITING} wait"
    ]
    gui.send(region(7))
    assert got[-1] == [7]


def test_properties_hold_no_control_characters() -> None:
    gui = Gui()
    PageBridge(gui, {}, {"name": "a\x1b[31m\u202eb"}, "")  # type: ignore[arg-type]
    page = "".join(gui.html)
    assert "a?[31m?b" in page
    assert "001b" not in page
    assert "202e" not in page
