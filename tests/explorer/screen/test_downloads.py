from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any

import pytest

from explorer.compute.background_jobs import ReportProgress
from explorer.feeds import Feeds
from explorer.screen.downloads import Downloads
from lpn.core.errors import DataError
from tools.fixtures.waiting import TIMEOUT, wait_until


@pytest.fixture
def sent() -> list[dict[str, Any]]:
    return []


@pytest.fixture
def downloads(sent: list[dict[str, Any]]) -> Iterator[Downloads]:
    made = Downloads(sent.append)
    yield made
    made.close()


def test_a_second_file_of_a_kind_cancels_the_first_and_another_kind_is_made_beside_it(
    downloads: Downloads, sent: list[dict[str, Any]]
) -> None:
    begun, goes_on = threading.Event(), threading.Event()

    def slow(report: ReportProgress) -> tuple[str, bytes]:
        begun.set()
        assert goes_on.wait(TIMEOUT)
        report(1, 2)
        raise AssertionError("it goes on")

    downloads.make("Report", slow, Feeds(), downloads)
    assert begun.wait(TIMEOUT)
    feeds = Feeds()
    downloads.make("Story", lambda _: ("a.html", b"<p>"), feeds, downloads)
    wait_until(lambda: any("download" in message for message in sent))
    downloads.make("Report", slow, Feeds(), downloads)
    goes_on.set()
    wait_until(lambda: {"note": "Report: cancelled."} in sent)
    (file,) = [message["download"] for message in sent if "download" in message]
    assert file["name"] == "a.html"
    found = feeds.find(file["address"].removeprefix("pictures/"))
    assert found().data == b"<p>"


@pytest.mark.parametrize(
    ("error", "note"), [(DataError("The photo is gone."), "The photo is gone."), (KeyError("x"), "the server's log")]
)
def test_a_file_that_cannot_be_made_is_one_sentence(
    downloads: Downloads, sent: list[dict[str, Any]], error: Exception, note: str
) -> None:
    def fails(_: ReportProgress) -> tuple[str, bytes]:
        raise error

    downloads.make("Report", fails, Feeds(), downloads)
    wait_until(lambda: note in sent[-1]["note"])
    downloads.make("Report", lambda _: ("a.html", b""), Feeds(), downloads)
    wait_until(lambda: sent[-1] == {"note": "The browser saves a.html."})
