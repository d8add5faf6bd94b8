"""Tests of the address of one page: which words a page speaks that is opened, reloaded, or gone back to."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol
from unittest.mock import Mock

import pytest

from explorer import session_state
from explorer.client.address import PageAddress
from explorer.client.messages import Greeting
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.url_state import UrlState
from explorer.workspace import Workspace

TASK = "drone-to-satellite"


@pytest.fixture(scope="module")
def workspace(data: Path, model_file: Path) -> Workspace:
    return open_model(data, model_file)


class _Page:
    """A page that is greeted with an address, and what it shows."""

    def __init__(self, workspace: Workspace, search: str, before: SessionState | None = None) -> None:
        self.show_other = Mock()
        self.shown, views, self.links = [SessionState(TASK, 4)], Mock(), UrlState(workspace)
        views.show_state.side_effect = self.shown.append
        lock = threading.RLock()
        self.address = PageAddress(
            workspace, self.links, views, lock, lambda: self.shown[-1], self.show_other, None, Mock(), before
        )
        self.address.greet(Greeting(search, plain=True, light="theme=light" in search))  # as the page reads it

    @property
    def state(self) -> SessionState:
        return self.shown[-1]

    @property
    def search(self) -> str:
        return f"?{self.links.write(self.state)}"


class _OpenPage(Protocol):
    """Opens a page; `before` is what it showed of another place."""

    def __call__(self, search: str, before: SessionState | None = None) -> _Page: ...


@pytest.fixture
def open_page(workspace: Workspace) -> Iterator[_OpenPage]:
    pages: list[_Page] = []

    def page(search: str, before: SessionState | None = None) -> _Page:
        pages.append(_Page(workspace, search, before))
        return pages[-1]

    yield page
    for one in pages:
        one.address.leave()


def test_the_map_that_stands_alone_comes_back_by_its_address(
    open_page: _OpenPage, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Workspace, "has_flight", True)
    page = open_page("?screen=first")
    alone = session_state.leave_first_screen(page.state, session_state.show_map_alone(page.state))
    page.shown.append(alone)
    again = open_page(page.search)
    assert "flight=map" in page.search
    reloaded = session_state.leave_first_screen(again.shown[0], again.state)
    assert (reloaded.flight, reloaded.map_alone, reloaded.first_screen) == (True, True, False)
    closed = session_state.leave_first_screen(reloaded, replace(reloaded, flight=False))
    assert closed.first_screen, "its end leads back"
    in_terms = open_page(page.search.replace("words=plain", "words=expert"))
    assert (in_terms.state.flight, in_terms.state.map_alone) == (True, False), "experts have the workbench beside it"
    window = open_page("?flight=1&words=plain")
    assert (window.state.flight, window.state.map_alone) == (True, False)


def test_back_and_forward_keep_the_words_of_the_first_screen_and_of_the_workbench(
    open_page: _OpenPage,
) -> None:
    page = open_page("?screen=first")
    first = page.search
    assert (page.state.first_screen, page.state.plain) == (True, True)
    page.shown.append(session_state.show_everything(page.state))
    workbench = page.search
    assert not page.state.plain
    for search, plain in ((first, True), (workbench, False)):
        page.address.go_back(search)
        assert (page.state.first_screen, page.state.plain) == (plain, plain)


@pytest.fixture
def places(workspace: Workspace, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], None]:
    """Two places of one page, and a function that says which of them the next page is of."""
    monkeypatch.setattr(workspace, "choices", {"here": "a city", "there": "another"})
    return lambda key: monkeypatch.setattr(workspace, "key", key)


@pytest.mark.parametrize("plain", [True, False])
def test_back_to_another_place_keeps_words_and_theme(
    workspace: Workspace,
    open_page: _OpenPage,
    places: Callable[[str], None],
    monkeypatch: pytest.MonkeyPatch,
    plain: bool,
) -> None:
    words, old = ("plain", "expert") if plain else ("expert", "plain")

    def back(shown: SessionState, search: str) -> SessionState:
        """Return what a page shows that goes back from a state to an address of another place."""
        places("here")
        page = open_page("?show=here")
        page.shown.append(shown)
        page.address.go_back(search)
        key, asked = page.show_other.call_args.args
        assert key == "there"
        places("there")
        return open_page(asked, shown).state

    places("here")
    first = open_page(f"?show=here&screen=first&words={words}&theme=light").state
    assert (first.first_screen, first.plain, first.start_plain, first.dark) == (True, plain, plain, False)
    kept = back(first, f"?show=there&query=0003&screen=first&words={old}&theme=dark")
    assert (kept.first_screen, kept.plain, kept.start_plain, kept.dark) == (True, plain, plain, False)
    for address, of_address in (("?show=there&lab=1", False), ("?show=there&lab=1&words=plain&theme=dark", True)):
        kept = back(first, address)
        assert (kept.lab, kept.plain, kept.dark) == (True, of_address, False)
        assert session_state.to_first_screen(kept).plain is plain, "the first screen's words go on behind the workbench"
    # The workbench's words go on where it lies before and behind the step.
    workbench = replace(session_state.show_everything(first), plain=plain)
    assert back(workbench, f"?show=there&lab=1&words={old}").plain is plain
    # An address of a place alone opens what it opens by itself, in the words of that screen.
    monkeypatch.setattr(workspace, "flight", object())
    for about in ("", "of a storm"):
        monkeypatch.setattr(workspace, "about", about)
        bare = back(replace(workbench, plain=not plain), "?show=there")
        assert (bare.first_screen, bare.flight) == (bool(about), not about)
        assert bare.plain is (plain if about else not plain)


def test_the_button_of_another_place_keeps_words_and_theme(open_page: _OpenPage, places: Callable[[str], None]) -> None:
    places("here")
    page = open_page("?show=here&screen=first&words=expert")
    for shown in (page.state, replace(session_state.show_everything(page.state), plain=True)):
        places("here")
        page.shown.append(replace(shown, dark=False))
        page.address.show_other("there")
        places("there")
        other = open_page(page.show_other.call_args.args[1], page.state).state
        assert (other.first_screen, other.plain, other.start_plain, other.dark) == (
            shown.first_screen,
            shown.plain,
            False,
            False,
        )


def test_a_first_screen_that_was_opened_with_expert_words_keeps_them_when_it_is_loaded_again(
    open_page: _OpenPage,
) -> None:
    page = open_page("?screen=first&words=expert")
    assert (page.state.first_screen, page.state.plain) == (True, False)
    again = open_page(page.search)
    assert (again.state.first_screen, again.state.plain) == (True, False)
    assert open_page("?screen=first").state.plain


@pytest.mark.parametrize("first", [True, False])
def test_a_page_whose_greeting_is_late_keeps_screen_words_and_theme(workspace: Workspace, first: bool) -> None:
    shown, views, wake = [SessionState(TASK, 4, dark=True)], Mock(), Mock()
    views.show_state.side_effect = shown.append
    before = SessionState(TASK, 4, dark=False, plain=True, first_screen=first, start_plain=True)
    lock, links = threading.RLock(), UrlState(workspace)
    search = f"?show=x{'&screen=first' if first else ''}"
    address = PageAddress(workspace, links, views, lock, lambda: shown[-1], Mock(), search, wake, before)
    address.leave()
    address._stop_waiting()
    state = shown[-1]
    assert (state.dark, state.plain, state.first_screen) == (False, True, first)
    assert not address.waiting
    wake.assert_called_once_with()
