"""Stories as a person keeps, tells, and exports them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Browser, BrowserContext, Locator, Page, expect

from tests.e2e.conftest import ExplorerPage, RunningApp, empty_context, outlast, started


@pytest.fixture(scope="module")
def kept_app(data: Path, model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningApp]:
    """The app on places that tests may keep stories beside."""
    folder = tmp_path_factory.mktemp("stories")
    shutil.copytree(
        data, folder / "places", ignore=shutil.ignore_patterns("stories.json")
    )  # other tests share the data
    with started(folder / "places", model_file, folder / "cache") as running:
        yield running


@pytest.fixture
def story_app(kept_app: RunningApp) -> Iterator[RunningApp]:
    """The same, beside which no story is kept yet."""
    yield kept_app
    (kept_app.data / "stories.json").unlink(missing_ok=True)


def told(page: Page) -> Locator:
    return page.locator("#lpn-told")


@pytest.mark.slow
def test_two_steps_are_kept_told_and_exported(
    story_app: RunningApp, contexts: Callable[..., BrowserContext], browser: Browser, tmp_path: Path
) -> None:
    explorer = ExplorerPage(contexts(accept_downloads=True).new_page())
    page = explorer.page
    explorer.open(story_app.url)
    first = explorer.status.get_attribute("data-name")
    explorer.key("s")
    expect(page.locator("#lpn-notice")).to_contain_text("Step 1 of 'Story 1' is kept")
    explorer.fill("Find name", "0011")
    explorer.expect_status("name", "0011")
    explorer.fill("Find name", "")
    explorer.fill("Rotate", "40")
    explorer.expect_status("angle", "40")
    explorer.key("s")
    expect(page.locator("#lpn-notice")).to_contain_text("Step 2 of 'Story 1' is kept")

    file = story_app.data / "stories.json"
    (saved,) = json.loads(file.read_text("utf-8"))
    first_step, second_step = saved["steps"]
    assert first_step["shows"] == f"task=drone-to-satellite&query={first}"
    assert second_step["shows"] == "task=drone-to-satellite&query=0011&angle=40"
    assert first_step["caption"].startswith(f"{first}. ")
    # A person edits the file.
    first_step["caption"], second_step["caption"] = "<i>The first</i> picture", "The second, turned"
    second_step["notes"] = "Wait for questions"
    file.write_text(json.dumps([saved | {"name": "Two & more"}]))
    page.reload()
    explorer.await_answer()

    page.locator("#lpn-story-names a", has_text="Two & more").click()
    expect(told(page).locator(".caption")).to_have_text("<i>The first</i> picture")
    explorer.expect_status("name", str(first))
    expect(page.locator("#lpn-verdict")).to_be_hidden()
    expect(told(page).locator("button").first).to_be_disabled()
    width = page.evaluate("innerWidth")
    explorer.eventually(lambda: _expect_wide(explorer, width))
    page.keyboard.press("ArrowRight")
    explorer.expect_status("name", "0011")
    explorer.expect_status("angle", "40")
    expect(told(page).locator(".count")).to_have_text("2 of 2")
    expect(told(page).locator(".notes")).to_be_hidden()
    page.keyboard.press("n")
    expect(told(page).locator(".notes")).to_have_text("Wait for questions")
    page.keyboard.press("PageUp")
    explorer.expect_status("angle", "0")
    with page.expect_popup() as popup:
        told(page).locator("button", has_text="Notes").click()
    notes_page = popup.value
    expect(notes_page.locator(".notes")).to_have_text("No notes for this step.")
    notes_page.keyboard.press("ArrowRight")
    expect(notes_page.locator(".notes")).to_have_text("Wait for questions")
    explorer.expect_status("angle", "40")
    page.bring_to_front()
    page.keyboard.press("Escape")
    expect(told(page)).to_have_count(0)
    expect(page.locator("#lpn-verdict")).to_be_visible()
    explorer.expect_status("angle", "40")  # what was shown before the story
    page.locator("#lpn-story-names a", has_text="Two & more").click()
    explorer.expect_status("angle", "0")
    told(page).locator("button", has_text="Stay here").click()
    expect(told(page)).to_have_count(0)
    explorer.expect_status("name", str(first))
    explorer.key("n")
    explorer.expect_status("name", "0008")

    with page.expect_download() as download:
        explorer.command("Export the story")
    download.value.save_as(tmp_path / "story.html")
    context = empty_context(browser, offline=True)
    exported, requests, problems = context.new_page(), [], []
    exported.on("request", lambda request: requests.append(request.url))
    exported.on("console", lambda message: problems.append(message.text))
    exported.on("pageerror", lambda error: problems.append(str(error)))
    exported.goto((tmp_path / "story.html").as_uri())
    expect(exported.locator(".said .headline")).to_have_text(["<i>The first</i> picture", "The second, turned"])
    cases = exported.locator("section.case")
    expect(cases).to_have_count(2)
    expect(cases.nth(1)).to_contain_text("0011, drone")
    expect(exported.locator(".said").nth(1)).to_contain_text("Altered by")
    assert exported.evaluate("[...document.images].every(image => image.complete && image.naturalWidth > 0)")
    assert {url for url in requests if not url.startswith("data:")} == {(tmp_path / "story.html").as_uri()}
    assert not problems
    assert "Wait for questions" not in exported.content()
    exported.set_viewport_size({"width": 390, "height": 844})
    assert exported.evaluate("document.documentElement.scrollWidth") <= 390
    context.close()


def _expect_wide(explorer: ExplorerPage, width: float) -> None:
    stage, bar = explorer.canvas.bounding_box(), told(explorer.page).bounding_box()
    assert stage is not None
    assert bar is not None
    assert (stage["x"], stage["width"]) == (0, width), "the panels are gone"
    assert abs(stage["y"] + stage["height"] - bar["y"]) < 2, "the caption covers nothing of the stage"


@pytest.mark.slow
def test_a_story_begun_on_the_first_screen_ends_there_and_no_tour_covers_it(
    story_app: RunningApp, browser: Browser
) -> None:
    steps = [{"shows": "query=0011", "caption": "The first"}, {"shows": "query=0012", "caption": "The second"}]
    (story_app.data / "stories.json").write_text(json.dumps([{"name": "Two", "steps": steps}]))
    context = empty_context(browser)
    page = context.new_page()
    explorer = ExplorerPage(page)
    page.goto(story_app.url)
    outlast(page, 5000)  # after which a caption waits no more for its picture
    first = page.locator("#lpn-first")
    first.get_by_role("button", name="Glossary").click()
    page.get_by_role("dialog").get_by_role("button", name="Close").click()
    expect(page.get_by_role("dialog")).to_have_count(0)
    page.keyboard.press("s")
    expect(page.locator("#lpn-notice")).to_contain_text("Step 1 of 'Story 1' is kept")
    assert "screen=" not in (story_app.data / "stories.json").read_text("utf-8")

    first.get_by_role("button", name="Two").click()
    # The caption of another picture waits for it.
    expect(told(page).locator(".caption")).to_be_visible()
    assert explorer.status.get_attribute("data-name") == "0011"
    explorer.expect_status("name", "0011")
    expect(first).to_have_count(0)
    page.wait_for_timeout(1500)  # the tour comes after 0.7 s
    expect(page.locator("#lpn-told.card")).to_have_count(0)
    page.keyboard.press("ArrowRight")
    explorer.expect_status("name", "0012")
    page.keyboard.press("Escape")
    assert page.evaluate("document.getElementById('lpn-first') !== null")  # at once
    expect(told(page)).to_have_count(0)
    expect(first.locator("figcaption").first).to_contain_text("0007")  # what was shown before
    context.close()


@pytest.mark.slow
def test_a_step_may_point_at_what_it_speaks_of_between_others(
    story_app: RunningApp, new_page: Callable[[], Page]
) -> None:
    steps = [
        {"shows": "query=0011", "caption": "The whole"},
        {"shows": "query=0012", "caption": "The ranking\nis here", "notes": "Wait", "points_at": "ranking"},
        {"shows": "", "caption": "What decided", "points_at": "verdict"},
    ]
    (story_app.data / "stories.json").write_text(json.dumps([{"name": "Three", "steps": steps}]))
    explorer = ExplorerPage(new_page())
    page = explorer.page
    explorer.open(story_app.url)
    page.locator("#lpn-story-names a", has_text="Three").click()
    explorer.expect_status("name", "0011")
    expect(page.locator("#lpn-verdict")).to_be_hidden()
    page.keyboard.press("ArrowRight")
    explorer.expect_status("name", "0012")
    card, spot = page.locator("#lpn-told.card"), page.locator("#lpn-spot")
    expect(card.locator(".caption b")).to_have_text("The ranking")
    matches = page.locator("#lpn-matches")
    expect(matches).to_be_visible()

    def framed(element: Locator) -> None:
        inner, outer, beside = element.bounding_box(), spot.bounding_box(), card.bounding_box()
        assert inner is not None
        assert outer is not None
        assert beside is not None
        assert outer["x"] <= inner["x"] < inner["x"] + inner["width"] <= outer["x"] + outer["width"] + 1
        assert beside["x"] + beside["width"] <= outer["x"] or beside["y"] + beside["height"] <= outer["y"]

    explorer.eventually(lambda: framed(matches))
    explorer.rows.nth(2).click()  # a step that shows something goes on while the page is used
    expect(explorer.rows.nth(2)).to_have_class("row chosen")
    page.keyboard.press("n")
    expect(card.locator(".notes")).to_have_text("Wait")
    page.keyboard.press("ArrowRight")
    expect(card.locator(".caption")).to_have_text("What decided")
    explorer.eventually(lambda: framed(explorer.verdict))
    expect(explorer.rows.nth(2)).to_have_class("row chosen")
    page.keyboard.press("n")
    expect(told(page)).to_have_count(0)
    expect(spot).to_have_count(0)
    explorer.expect_status("name", "0013")
