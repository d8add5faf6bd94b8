"""The progress of files that are made in the background."""

from __future__ import annotations

import threading
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
from explorer.explain_window import window
from explorer.explain_window.window import ExplainWindow
from explorer.reports import Reporter

from explorer.compute.background_jobs import ReportProgress
from lpn.core.errors import InputError
from lpn.drawing.words import Vocabulary
from tools.fixtures.waiting import wait_until


def test_the_progress_of_a_report_says_what_to_press_to_cancel_it() -> None:
    shown: list[Any] = []
    told, sent = [], threading.Event()

    def add_notification(title: str, body: str, **_: Any) -> Any:
        shown.append(SimpleNamespace(title=title, body=body, loading=True))
        return shown[-1]

    def work(progress: ReportProgress, _: object) -> tuple[str, bytes]:
        told.append(shown[0].body)
        progress(1, 2)
        told.append(shown[0].body)
        return "story.html", b""

    client = SimpleNamespace(add_notification=add_notification, send_file_download=lambda *_, **__: sent.set())
    counts: list[tuple[int, int]] = []
    Reporter(client, None, lambda *count: counts.append(count)).make(work, "story", "Export")  # type: ignore[arg-type]
    assert sent.wait(60)
    assert (shown[0].title, shown[0].body, shown[0].loading) == (
        "The story is made",
        "The browser saves story.html.",
        False,
    )
    wait_until(lambda: counts == [(1, 2), (0, 0)])  # the bar of the page is gone at the end
    assert told == ["Press “Export” again to cancel.", "1 of 2 done. Press “Export” again to cancel."]


def test_a_report_before_there_is_an_answer_is_refused_by_a_sentence() -> None:
    told: list[tuple[str, str]] = []
    client = SimpleNamespace(add_notification=lambda title, body, **_: told.append((title, body)))
    unready: Any = SimpleNamespace(_content=None, _open=False, _failure="", _reporter=Reporter(client, None))  # type: ignore[arg-type]
    ExplainWindow._report(unready)
    assert told == [("No report", "The answer is still being computed. Press “Save” again when it is shown.")]


def test_no_control_character_of_a_name_is_in_a_reason() -> None:
    shown: list[Any] = []

    def add_notification(title: str, body: str, **_: Any) -> Any:
        shown.append(SimpleNamespace(title=title, body=body))
        return shown[-1]

    def work(*_: object) -> tuple[str, bytes]:
        raise InputError("a\x1b[2J.jpg is damaged.")

    client: Any = SimpleNamespace(add_notification=add_notification)
    reporter = Reporter(client, None)
    reporter.refuse("\u202egpj.a cannot be read.")
    reporter.make(work, "story", "Export")
    wait_until(lambda: shown[-1].body.endswith("damaged."))
    assert [(told.title, told.body) for told in shown] == [
        ("No report", "?gpj.a cannot be read."),
        ("No story", "a?[2J.jpg is damaged."),
    ]


def test_after_a_failure_a_report_is_refused_with_its_reason_though_the_answer_before_is_known() -> None:
    told: list[tuple[str, str]] = []
    client = SimpleNamespace(add_notification=lambda title, body, **_: told.append((title, body)))
    unready: Any = SimpleNamespace(_content=object(), _open=False, _failure="", _reporter=Reporter(client, None))  # type: ignore[arg-type]
    ExplainWindow.fail(unready, "a.jpg cannot be read; choose another picture.")
    ExplainWindow._report(unready)
    assert told == [("No report", "There is no answer to save. a.jpg cannot be read; choose another picture.")]


def test_the_reading_of_a_large_map_is_told_while_an_answer_is_saved(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(window, "_READING", 0.0)
    monkeypatch.setattr(window, "said", lambda *of: [of[2](done, 800_000_000) for done in (16_000_000, 800_000_000)])
    monkeypatch.setattr(window.reports, "of_analysis", lambda *_: ("answer.html", b""))
    bodies: list[str] = []

    class Notification(SimpleNamespace):
        def __setattr__(self, name: str, value: Any) -> None:
            super().__setattr__(name, value)
            if name == "body":
                bodies.append(value)

    sent = threading.Event()
    client: Any = SimpleNamespace(
        add_notification=lambda *_, **__: Notification(), send_file_download=lambda *_, **__: sent.set()
    )
    shown: Any = SimpleNamespace(_workspace=SimpleNamespace(vocabulary=lambda _: Vocabulary(plain=True)))
    Reporter(client, None).make(partial(ExplainWindow._reported, shown, object()), control="Save")
    assert sent.wait(60)
    assert bodies[:2] == [
        f"{read} of 800 MB of the map's files read for their SHA-256. Press “Save” again to cancel."
        for read in (16, 800)
    ]
