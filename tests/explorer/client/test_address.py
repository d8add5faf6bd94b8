"""Tests of the address of one page: which words a page speaks that is opened, reloaded, or gone back to."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from unittest.mock import Mock
from urllib.parse import parse_qsl

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

    def __init__(self, workspace: Workspace, search: str) -> None:
        self.show_other = Mock()
        self.shown, views, self.links = [SessionState(TASK, 4)], Mock(), UrlState(workspace)
        views.show_state.side_effect = self.shown.append
        lock = threading.RLock()
        self.address = PageAddress(
            workspace, self.links, views, lock, lambda: self.shown[-1], self.show_other, None, Mock()
        )
        self.address.greet(Greeting(search, plain=True))

    @property
    def state(self) -> SessionState:
        return self.shown[-1]

    @property
    def search(self) -> str:
        return f"?{self.links.write(self.state)}"


@pytest.fixture
def open_page(workspace: Workspace) -> Iterator[Callable[[str], _Page]]:
    pages: list[_Page] = []

    def page(search: str) -> _Page:
        pages.append(_Page(workspace, search))
        return pages[-1]

    yield page
    for one in pages:
        one.address.leave()


def test_back_and_forward_keep_the_words_of_the_first_screen_and_of_the_workbench(
    open_page: Callable[[str], _Page],
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


@pytest.mark.parametrize("plain", [True, False])
def test_back_to_another_place_keeps_words_and_theme(
    workspace: Workspace,
    open_page: Callable[[str], _Page],
    monkeypatch: pytest.MonkeyPatch,
    plain: bool,
) -> None:
    monkeypatch.setattr(workspace, "choices", {"here": "a city", "there": "a flight"})
    monkeypatch.setattr(workspace, "key", "here")
    page = open_page(f"?show=here&screen=first&words={'plain' if plain else 'expert'}&theme=light")
    kept, old = f"theme=light&words={'plain' if plain else 'expert'}", "expert" if plain else "plain"
    for search, expected in (
        (f"?show=there&query=a%20b&screen=first&words={old}", f"?show=there&query=a%20b&screen=first&{kept}"),
        ("?show=there&lab=1", "?show=there&lab=1&theme=light&words=expert"),
        ("?show=there&flight=1&words=plain&theme=dark", "?show=there&flight=1&theme=light&words=plain"),
    ):
        page.address.go_back(search)
        key, asked = page.show_other.call_args.args
        assert key == "there"
        assert dict(parse_qsl(asked)) == dict(parse_qsl(expected)), (search, asked)
    # The workbench's words go on where it lies before and behind the step.
    page.shown.append(replace(session_state.show_everything(page.state), plain=plain))
    page.address.go_back(f"?show=there&lab=1&words={old}")
    asked = dict(parse_qsl(page.show_other.call_args.args[1].removeprefix("?")))
    assert asked == {"show": "there", "lab": "1", **dict(parse_qsl(kept))}


def test_a_first_screen_that_was_opened_with_expert_words_keeps_them_when_it_is_loaded_again(
    open_page: Callable[[str], _Page],
) -> None:
    page = open_page("?screen=first&words=expert")
    assert (page.state.first_screen, page.state.plain) == (True, False)
    again = open_page(page.search)
    assert (again.state.first_screen, again.state.plain) == (True, False)
    assert open_page("?screen=first").state.plain
