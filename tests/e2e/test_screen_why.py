"""The page behind the verdict, and the panels beside the rings, used as a person would."""

from __future__ import annotations

import re

import pytest
from playwright.sync_api import expect

from explorer.workspace import LazyWorkspace, Workspace
from lpn.core.errors import DataError
from tests.e2e.conftest import NewPage, Running, Screen, box, expect_accessible
from tests.explorer.screen.test_why import mendable


def test_the_verdict_opens_what_a_newcomer_needs(running: Running, screen: Screen) -> None:
    screen.open()
    page = screen.page
    screen.headline.get_by_role("button").click()
    panel = page.locator("#panel")
    expect(panel.get_by_role("heading", level=3).first).to_be_visible()
    ranking = running.workspace.rankings["drone-to-satellite"]
    recall = f"{100 * float((ranking.ranks == 0).mean()):.1f} %"
    expect(panel.locator("tr", has_text="R@1").locator("td").first).to_have_text(recall)
    expect(panel.locator(".uplot canvas")).to_be_visible()
    expect_accessible(page)
    screen.key("d")
    expect(page.locator("html")).to_have_class(re.compile("light"))
    expect_accessible(page)
    screen.key("Escape")
    expect(panel).to_be_hidden()
    screen.key("y")
    expect(panel).to_be_visible()
    assert not screen.complaints


def test_weights_of_a_click_find_a_missed_photo(running: Running, screen: Screen) -> None:
    query, angle = mendable(running.workspace)
    screen.open(f"?query=~{query}&angle={angle}&panel=compare")
    panel = screen.page.locator("#panel")
    expect(screen.headline).to_contain_text("Missed")
    expect(panel.locator(".column")).to_have_count(2)
    expect_accessible(screen.page)
    panel.get_by_role("button", name="Try on all photos").click()
    expect(panel.locator(".pair")).to_contain_text("R@1 goes from")
    panel.get_by_role("button", name="Use these weights").click()
    expect(screen.headline).to_contain_text("Found")
    assert "weights=" in screen.page.url
    assert not screen.complaints


def test_a_region_is_painted_by_mouse_and_keys(screen: Screen) -> None:
    screen.open("?panel=region")
    panel = screen.page.locator("#panel")
    grid = panel.locator(".cells")
    expect(grid).to_be_visible()
    place = box(grid)
    mouse = screen.page.mouse
    mouse.move(place["x"] + 0.4 * place["width"], place["y"] + 0.4 * place["height"])
    mouse.down()
    mouse.move(place["x"] + 0.6 * place["width"], place["y"] + 0.4 * place["height"], steps=4)
    mouse.up()
    expect(panel.locator(".said")).to_contain_text("2 of 16 cells")
    grid.focus()
    screen.key("ArrowDown")
    screen.key(" ")
    expect(panel.locator(".said")).to_contain_text("3 of 16 cells")
    assert "angle" not in screen.page.url, "its arrows do not turn the photo"
    assert "cells=5-6,10" in screen.page.url
    expect_accessible(screen.page)
    whole = panel.locator(".tiles button span:last-child").all_inner_texts()
    third = next(number for number, text in enumerate(whole) if int(text.removeprefix("was ")) > 2)
    panel.locator(".tiles button").nth(third).click()
    expect(screen.page.locator("#tile figcaption")).to_contain_text("Pinned")
    panel.get_by_role("button", name="Clear").click()
    expect(panel.locator(".tiles button")).to_have_count(0)
    assert not screen.complaints


def test_a_sweep_is_drawn_beside_the_rings(screen: Screen) -> None:
    screen.open("?panel=sweep")
    panel = screen.page.locator("#panel")
    panel.get_by_role("button", name="Zoom").click()
    expect(panel.locator(".said p").first).to_be_visible(timeout=120_000)
    expect(panel.locator(".uplot")).to_have_count(3)
    expect(screen.rows.first).to_be_visible()
    expect_accessible(screen.page)
    assert "sweep=zoom" in screen.page.url
    assert not screen.complaints


def test_more_than_two_models_are_a_list(running: Running, new_page: NewPage, monkeypatch: pytest.MonkeyPatch) -> None:
    def never() -> Workspace:
        raise DataError("The file is not there; give another.")

    beside = running.workspace.beside
    monkeypatch.setattr(running.workspace, "beside", [*beside, LazyWorkspace("third", never)])
    screen = Screen(new_page(), running.url).open()
    models = screen.page.get_by_role("combobox", name="Model")
    expect(models.locator("option")).to_have_count(3)
    expect(screen.page.locator("#model")).to_be_hidden()
    models.select_option("1")
    expect(screen.page.locator("#about")).to_contain_text("baseline")
    models.select_option("2")
    expect(screen.headline).to_contain_text("The file is not there; give another.")
    expect(models).to_have_value("1")
