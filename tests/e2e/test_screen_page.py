"""The screen under hard conditions: keys alone, wrong addresses, storage denied, and several tabs."""

from __future__ import annotations

import re
from pathlib import Path

from playwright.sync_api import expect

from tests.e2e.conftest import Contexts, NewPage, Running, RunningApp, Screen, started
from tools.fixtures.processes import free_port


def test_all_that_can_be_pressed_is_reached_by_tab_and_says_its_name(running: Running, contexts: Contexts) -> None:
    screen = Screen(contexts().new_page(), running.url).open()
    page = screen.page
    reached = set()
    for _ in range(80):
        page.keyboard.press("Tab")
        focused = page.evaluate(
            """() => {
              const one = document.activeElement;
              if (one === document.body) return null;
              const name = one.getAttribute("aria-label") || one.title || one.textContent.trim() || one.placeholder;
              const seen = one.checkVisibility() && getComputedStyle(one).outlineStyle !== "none";
              return [one.id || one.className, name ?? "", seen];
            }"""
        )
        if focused is None or tuple(focused) in reached:
            continue
        assert focused[1], focused
        assert focused[2], f"the focus is not seen at {focused}"
        reached.add(tuple(focused))
    names = " ".join(name for _, name, _ in reached).lower()
    for expected in ("next", "previous", "search", "missed", "distance"):
        assert expected in names, names
    page.locator("#strip .tile").nth(2).focus()
    page.keyboard.press("Enter")
    expect(page.locator("#tile figcaption")).to_contain_text("Pinned")
    page.locator("#photo .frame").focus()
    page.keyboard.press("ArrowLeft")
    screen.rest("15")


def test_a_browser_that_denies_its_storage_shows_all(screen: Screen) -> None:
    screen.page.add_init_script(
        """for (const use of ["getItem", "setItem", "removeItem"])
          Storage.prototype[use] = () => { throw new DOMException("denied", "SecurityError") };"""
    )
    screen.open()
    screen.key("d")
    expect(screen.page.locator("html")).to_have_class("light")
    screen.key("j")
    screen.rest("15")
    assert not screen.complaints


def test_two_tabs_of_one_browser_are_two_screens(running: Running, contexts: Contexts) -> None:
    context = contexts()
    one, other = (Screen(context.new_page(), running.url).open() for _ in range(2))
    one.key("n")
    one.rest()
    one.key("j")
    one.rest("15")
    other.key("j")
    other.rest("15")
    one.expect_numbers(running.analysis(query=1, angle=15.0))
    other.expect_numbers(running.analysis(query=0, angle=15.0))


def test_without_positions_there_is_no_scene_of_a_place(app: RunningApp, contexts: Contexts) -> None:
    screen = Screen(contexts().new_page(), app.url).open()
    expect(screen.page.locator("#scene.ready iframe")).to_be_visible()
    expect(screen.page.locator("#scene [data-view=city]")).to_be_hidden()
    expect(screen.tiles).to_have_count(6)


def test_a_page_finds_its_server_again_as_it_was(app: RunningApp, tmp_path: Path, new_page: NewPage) -> None:
    port = free_port()
    with started(app.data, app.model, tmp_path / "cache", port=port) as running:
        screen = Screen(new_page(), running.url).open("?query=0009&angle=30")
    expect(screen.headline.locator("h1")).to_have_text("Connection lost. Trying again.")
    expect(screen.rows).to_have_count(4)
    with started(app.data, app.model, tmp_path / "cache", port=port):
        expect(screen.headline.locator("h1")).not_to_contain_text("Connection lost")
        screen.rest("30")
        expect(screen.page).to_have_url(re.compile("query=0009"))
