"""Tests with axe-core, of what lies over what, and of the sizes of texts."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from playwright.sync_api import BrowserContext, Page, expect

from tests.e2e.conftest import ExplorerPage, RunningApp, box, expect_accessible

_SMALLEST = """() => [...document.querySelectorAll('body *')]
  .filter(one => one.checkVisibility({checkOpacity: true, checkVisibilityCSS: true}) && !one.closest('[hidden], #lpn-live'))
  .filter(one => [...one.childNodes].some(child => child.nodeType === 3 && child.textContent.trim()))
  .map(one => [parseFloat(getComputedStyle(one).fontSize), one.textContent.trim().slice(0, 40)])
  .filter(([size]) => size < 12)"""
_COVERED = """() => {
  const all = (selector) => [...document.querySelectorAll(selector)];
  const box = (one) => one.getBoundingClientRect();
  // A tab that is scrolled out of its panel still has a box; notifications let the pointer through.
  const middle = ({left, right, top, bottom}) => [(left + right) / 2, (top + bottom) / 2];
  const seen = (one) => document.elementsFromPoint(...middle(box(one))).includes(one);
  const meets = (a, b) => a.left < b.right && b.left < a.right && a.top < b.bottom && b.top < a.bottom;
  const notices = all('.mantine-Notification-root').map(box);
  return all('[role=tab]').filter((tab) => seen(tab) && notices.some((notice) => meets(notice, box(tab)))).length;
}"""


@pytest.mark.slow
def test_axe_finds_nothing_serious(app: RunningApp, new_page: Callable[[], Page]) -> None:
    explorer = ExplorerPage(new_page())
    page = explorer.page
    root = page.locator("html")

    def check(ready: str, change_theme: Callable[[], None]) -> None:
        expect(page.locator(ready).first).to_be_visible()
        expect(root).to_have_attribute("data-mantine-color-scheme", "dark")
        expect_accessible(page)
        assert not page.evaluate(_SMALLEST), "a text is smaller than 12 px"
        # The light theme differs in its colours alone.
        change_theme()
        expect(root).to_have_attribute("data-mantine-color-scheme", "light")
        page.wait_for_function("!document.getAnimations().some((one) => one instanceof CSSTransition)")
        expect_accessible(page, ["color-contrast"])

    page.goto(f"{app.url}/?query=0008&screen=first&why=1")
    explorer.await_answer()
    check("#lpn-first .reason .track", page.locator("#lpn-first [data-act=dark]").click)
    page.evaluate("localStorage.removeItem('lpn-theme')")
    page.goto(f"{app.url}/?query=0008")
    explorer.await_answer()
    check("#lpn-matches .row", page.get_by_text("Light", exact=True).click)
    explorer.key("o")
    explorer.explain()
    check("#lpn-why .lpn-map", lambda: explorer.key("o"))
    explorer.key("Escape")
    expect(page.locator("#lpn-why")).to_be_hidden()
    explorer.key("o")
    explorer.key("b")
    check("#lpn-lab-table tr[data-row]", lambda: explorer.key("o"))


@pytest.mark.slow
def test_a_notification_catches_no_click(explorer: ExplorerPage) -> None:
    page = explorer.page
    explorer.page.locator("input[type=file]").set_input_files(
        files=[{"name": "x.png", "mimeType": "image/png", "buffer": b"x"}]
    )
    notice = explorer.notifications.first
    expect(notice).to_be_visible()
    tab = page.get_by_role("tab", name="Parts")
    place = box(tab)
    page.evaluate(
        "([left, top]) => Object.assign(document.querySelector("
        "'.mantine-Notification-root:not(#webgl-software-rendering)').style, "
        "{position: 'fixed', left: left + 'px', top: top + 'px', zIndex: 9999})",
        [place["x"] - 20, place["y"] - 10],
    )
    x, y = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2

    def lies_over_the_tab() -> None:  # it slides into its place
        over = box(notice)
        assert over["x"] < x < over["x"] + over["width"]
        assert over["y"] < y < over["y"] + over["height"]

    explorer.eventually(lies_over_the_tab)
    page.mouse.click(x, y)
    expect(page.get_by_text("All parts equal")).to_be_visible()


@pytest.mark.slow
def test_a_notification_lies_over_no_tab(app: RunningApp, contexts: Callable[..., BrowserContext]) -> None:
    for width, height in ((1440, 900), (1024, 600), (390, 844)):
        page = contexts(viewport={"width": width, "height": height}).new_page()
        explorer = ExplorerPage(page)
        explorer.open(app.url + "/?query=nothing&why=1")
        expect(explorer.notifications.first).to_be_visible()
        expect(page.locator("#lpn-why .lpn-map").first).to_be_attached()
        expect(explorer.notifications.first).to_be_in_viewport(ratio=1)

        def lies_over_none(page: Page = page) -> None:
            covered = page.evaluate(_COVERED)
            assert covered == 0

        explorer.eventually(lies_over_none)
        page.close()


@pytest.mark.slow
def test_the_tour_ends_at_any_key_or_press_elsewhere_and_comes_again(explorer: ExplorerPage) -> None:
    page, card = explorer.page, explorer.page.locator("#lpn-told.card")
    call = page.locator("#lpn-header").get_by_role("button", name="Tour", exact=True)
    call.click()
    expect(card).to_contain_text("1 of 5")
    expect(card.get_by_role("button", name="Next")).to_be_focused()
    page.keyboard.press("Enter")
    expect(card).to_contain_text("2 of 5")
    page.keyboard.press("n")
    expect(card).to_have_count(0)
    explorer.expect_status("name", "0008")
    call.click()
    expect(card).to_contain_text("1 of 5")
    explorer.rows.nth(3).click()
    expect(card).to_have_count(0)
    expect(explorer.rows.nth(3)).to_have_class("row chosen")
