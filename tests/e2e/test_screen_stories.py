"""Stories on the screen, as a person keeps, tells, and saves them."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.e2e.conftest import Contexts, NewPage, Running, Screen, box, expect_accessible

STEPS = [
    {"shows": "query=0003&scoring=plain", "caption": "<i>The first</i> photo", "notes": "Wait for questions"},
    {"shows": "query=0005&angle=40&scoring=plain", "caption": "The second, turned"},
]


@pytest.fixture
def file(running: Running, tmp_path: Path) -> Iterator[Path]:
    """The file of stories, which has one."""
    running.workspace.stories = tmp_path / "own.json"
    running.workspace.stories.write_text(json.dumps([{"name": "Two & more", "steps": STEPS}]))
    yield running.workspace.stories
    running.workspace.stories = None


def expect_state(page: Page, query: str, angle: str) -> None:
    """Wait for the result of a state; the address changes before."""
    expect(page.locator("#photo .picture")).to_have_attribute("aria-label", query)
    expect(page.locator("#photo .frame")).to_have_attribute("aria-valuenow", angle)


def test_a_step_is_kept_by_s_and_renamed_in_place(running: Running, file: Path, new_page: NewPage) -> None:
    screen = Screen(new_page(), running.url).open("?query=0004&story=Two%20%26%20more")
    page, place = screen.page, box(screen.rows.first)
    page.keyboard.press("s")
    expect(page.locator("#headline p")).to_contain_text("Step 3 of Two & more")
    assert box(screen.rows.first) == place, "the note covers and moves nothing"
    page.keyboard.press("Control+k")
    page.locator("#commands input").fill("stories")
    page.keyboard.press("Enter")
    rows = page.locator("#panel li")
    expect(rows).to_have_count(3)
    said = rows.nth(2).get_by_label("Caption of step 3")
    expect(said).to_have_value(f"{page.locator('#headline h1').inner_text()[2:].rstrip('?')}. {screen_reason(page)}")
    said.fill("What I say")
    rows.nth(2).get_by_role("button", name="Move up").click()  # the caption loses the focus, and is saved
    expect(rows.nth(1).get_by_label("Caption")).to_have_value("What I say")
    rows.nth(0).get_by_role("button", name="Remove").click()
    expect(rows).to_have_count(2)
    rows.nth(1).get_by_role("button", name="Open").click()
    expect_state(page, "0005", "40")
    expect(rows).to_have_count(2)
    expect_accessible(page)
    (saved,) = json.loads(file.read_text("utf-8"))
    assert [step["caption"] for step in saved["steps"]] == ["What I say", "The second, turned"]
    assert not screen.complaints


def screen_reason(page: Page) -> str:
    """Return the headline's reason once the note has gone."""
    reason = page.locator("#headline p")
    expect(reason).not_to_contain_text("Step 3")
    return reason.inner_text()


@pytest.mark.usefixtures("file")
@pytest.mark.parametrize("size", [(1280, 720), (390, 844)])
def test_a_story_is_told_by_keys_and_its_end_brings_back_what_was_shown(
    running: Running, contexts: Contexts, size: tuple[int, int]
) -> None:
    page = contexts(viewport={"width": size[0], "height": size[1]}).new_page()
    screen = Screen(page, running.url).open("?query=0004&angle=15&panel=stories")
    page.get_by_role("button", name="Tell").click()
    told = page.locator("#told")
    expect(told.locator("p").first).to_have_text("<i>The first</i> photo")
    expect_state(page, "0003", "0")
    expect(page.locator("#rail")).to_be_hidden()
    expect(page.locator("#panel")).to_be_hidden()
    if size[0] > 760:
        for seen in (screen.rows.last, screen.tiles.last):
            place = box(seen)
            assert place["y"] + place["height"] <= box(told)["y"] + 1, "the caption covers nothing"
    expect(told.locator(".notes")).to_be_hidden()
    page.keyboard.press("n")
    expect(told.locator(".notes")).to_have_text("Wait for questions")
    page.keyboard.press("ArrowRight")
    expect(told.locator("p").first).to_have_text("The second, turned")
    expect_state(page, "0005", "40")
    expect_accessible(page)
    page.keyboard.press("ArrowLeft")
    expect_state(page, "0003", "0")
    page.keyboard.press("Escape")
    expect(told).to_have_count(0)
    expect_state(page, "0004", "15")
    expect(page.locator("#panel li")).to_have_count(2)
    assert not screen.complaints
