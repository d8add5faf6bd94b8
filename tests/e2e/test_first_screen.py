"""Tests of the first screen in a browser that has never been here."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Browser, Page, expect

from lpn.core.demo import DEMO_ANSWERS, DEMO_FLIGHT, DEMO_PLACE
from lpn.core.homography import apply_homography, corner_pixels, four_point_homography
from lpn.core.images import load_picture, shrink
from tests.e2e.conftest import PATIENCE, ExplorerPage, RunningApp, box, empty_context, expect_accessible, started
from tools.fixtures import small_worlds

# Note when a phone's sheet comes to rest after a scroll: a busy page may stand still in between.
NOTE_REST = """() => {
  const sheet = document.querySelector(".mantine-ScrollArea-viewport");
  sheet.addEventListener("scrollend", () => (window.atRest = true));
}"""

# Count what the stage draws from the page's beginning on, and note whether the panel of the query was ever unfolded.
COUNT = """
window.drawn = 0;
window.unfolded = false;
for (const name of ["drawElements", "drawArrays"]) {
  const draw = WebGL2RenderingContext.prototype[name];
  WebGL2RenderingContext.prototype[name] = function (...all) {
    if (this.canvas.dataset.engine && this.canvas.getBoundingClientRect().width > 300) window.drawn++;
    return draw.apply(this, all);
  };
}
new MutationObserver(() => {
  if (document.body?.textContent.includes("Find name")) window.unfolded = true;
}).observe(document, {childList: true, subtree: true});
"""
# Sizes and places of the stage, and of the controls over it.
LAID = """() => ["canvas[data-engine]", "#lpn-hud"].map(one => {
  const box = document.querySelector(one).getBoundingClientRect();
  return [box.left, box.top, box.width, box.height].map(Math.round);
})"""


# The places of numbered details, as shares of their picture's width and height.
PLACES = """(pins) => {
  const box = pins.getBoundingClientRect(), places = {};
  for (const pin of pins.querySelectorAll(".pin")) {
    const { left, top, width, height } = pin.getBoundingClientRect();
    places[pin.dataset.pin] = [(left + width / 2 - box.left) / box.width, (top + height / 2 - box.top) / box.height];
  }
  return places;
}"""


@pytest.fixture
def fresh(browser: Browser) -> Iterator[Page]:
    """A page of a browser profile without any storage."""
    context = empty_context(browser, viewport={"width": 1280, "height": 800}, color_scheme="dark")
    yield context.new_page()
    context.close()


@pytest.mark.slow
def test_save_waits_visibly_for_a_file_of_which_paper_shows_what_is_folded(
    app: RunningApp, fresh: Page, tmp_path: Path
) -> None:
    fresh.goto(app.url)
    save = fresh.locator("#lpn-first [data-act=report]")
    expect(save).to_have_text("Save")
    with fresh.expect_download() as download:
        # Both are read at once: the file may come before another question.
        waiting, animation = save.evaluate(
            "(button) => (button.click(), [button.matches('.waiting'), getComputedStyle(button, '::before').animationName])"
        )
        assert waiting
        assert animation != "none"
    assert download.value.suggested_filename == "0007.html"
    download.value.save_as(tmp_path / "0007.html")
    fresh.goto((tmp_path / "0007.html").as_uri())
    experts = fresh.locator("details.experts")
    room = "(folded) => folded.offsetHeight - folded.firstElementChild.offsetHeight"
    on_screen = experts.evaluate(room)
    fresh.emulate_media(media="print")
    assert experts.evaluate(room) > on_screen + 200


@pytest.mark.slow
def test_the_stage_is_drawn_only_while_it_is_seen(app: RunningApp, fresh: Page) -> None:
    first = fresh.locator("#lpn-first")
    fresh.add_init_script(COUNT)
    fresh.goto(app.url)
    expect(first.locator(".sentence")).to_be_visible()

    def comes_to_rest() -> bool:
        """The canvas's own first frames may come late; after them viser draws each second what is in sight."""
        for _ in range(8):
            before = fresh.evaluate("drawn")
            fresh.wait_for_timeout(2500)
            if fresh.evaluate("drawn") == before:
                return True
        return False

    assert comes_to_rest()
    assert fresh.evaluate("drawn") < 10
    first.locator("[data-act=all]").click()
    expect(first).to_have_count(0)
    fresh.wait_for_function("() => drawn > 40")  # the pictures of the stage
    stage, controls = fresh.evaluate(LAID)
    assert stage == controls
    assert stage[0] >= 0
    fresh.locator("a", has_text="Start").first.click()
    expect(first.locator(".sentence")).to_be_visible()
    assert comes_to_rest()


@pytest.mark.slow
def test_the_workbench_opens_at_its_final_size_with_the_left_panel_folded_or_open(app: RunningApp, fresh: Page) -> None:
    sent: list[str] = []
    heard = re.compile(rb'"kind":"(hello|viewport)".*?"(?:viewport|value)":\[(\d+),(\d+)\]')

    def note(payload: bytes | str) -> None:
        text = payload if isinstance(payload, bytes) else payload.encode()
        sent.extend(f"{int(width)} x {int(height)}" for _, width, height in heard.findall(text))

    fresh.on("websocket", lambda socket: socket.on("framesent", note))
    fresh.add_init_script(COUNT)
    fresh.goto(f"{app.url}/?screen=all")
    expect(fresh.locator("#lpn-status")).not_to_have_attribute("data-seq", "0")
    fresh.wait_for_timeout(2500)
    stage, _ = fresh.evaluate(LAID)
    assert set(sent) == {f"{stage[2]} x {stage[3]}"}
    assert not fresh.evaluate("unfolded")
    # A panel that was left open takes its room from the stage, and the page knows how much it took.
    fresh.evaluate("localStorage.setItem('lpn-panels', 'open')")
    fresh.reload()
    fresh.get_by_text("Degrees counter-clockwise").click()
    fresh.wait_for_function("() => localStorage.getItem('lpn-beside')")
    sent.clear()
    fresh.reload()
    expect(fresh.get_by_text("Degrees counter-clockwise")).to_be_visible()
    fresh.wait_for_timeout(2500)
    narrower, _ = fresh.evaluate(LAID)
    assert narrower[2] < stage[2]
    assert set(sent) == {f"{narrower[2]} x {narrower[3]}"}


@pytest.mark.slow
def test_the_left_panel_is_remembered_as_a_person_left_it(app: RunningApp, fresh: Page) -> None:
    """A press elsewhere remembers nothing: what it does may draw the panel anew, unfolded for a moment."""
    remembered = "() => localStorage.getItem('lpn-panels')"
    fresh.goto(app.url)
    first = fresh.locator("#lpn-first")
    first.locator("[data-act=why]").click()
    first.locator("[data-act=all]").first.click()
    fresh.get_by_role("button", name="Expand column").wait_for()
    fresh.wait_for_timeout(1000)
    assert fresh.evaluate(remembered) is None
    fresh.get_by_role("button", name="Expand column").click()
    fresh.wait_for_function(f"({remembered})() === 'open'")
    fresh.locator("[data-dock-region-collapse=left]").click()
    fresh.wait_for_function(f"({remembered})() === 'folded'")


@pytest.mark.slow
def test_a_newcomer_sees_one_answer_and_unfolds_the_rest(app: RunningApp, fresh: Page) -> None:
    first, button = fresh.locator("#lpn-first"), fresh.locator("#lpn-first button")
    explorer = ExplorerPage(fresh)
    fresh.goto(app.url)
    expect(first.locator(".sentence")).to_contain_text("The model compared 14 satellite pictures")
    expect(first.locator("figcaption").nth(1)).to_contain_text("The model’s answer")
    expect(button).to_have_text("Why?")
    expect(fresh.locator("#lpn-loading")).to_have_count(0)
    before = first.locator("img").first.get_attribute("src")

    # The keys work; those of the workbench unfold it.
    fresh.keyboard.press("n")
    expect(first.locator("figcaption").first).to_contain_text("0008")
    assert first.locator("img").first.get_attribute("src") != before
    button.press("Enter")
    expect(first.locator(".reason .track")).to_have_count(4)
    expect(fresh.locator("#lpn-why")).to_be_hidden()
    expect(button).to_be_focused()
    first.locator(".term").first.hover()
    expect(fresh.locator("#lpn-term")).to_contain_text("ring: A part between two squares")
    first.locator(".term").first.click()
    first.locator("h1").dispatch_event("mouseover")  # browsers add a mouse to a tap, which may lie beside it
    expect(fresh.locator("#lpn-term")).to_be_visible()
    fresh.keyboard.press("Escape")
    expect(fresh.locator("#lpn-term")).to_have_count(0)
    fresh.wait_for_url(lambda url: "screen=first" in url and "why=1" in url)
    link = fresh.url
    fresh.go_back()
    expect(first.locator(".reason")).to_have_count(0)
    expect(first.locator("figcaption").first).to_contain_text("0008")
    fresh.go_forward()
    expect(first.locator(".reason .track")).to_have_count(4)
    first.get_by_role("button", name="Look closer").click()
    expect(first).to_have_count(0)
    expect(fresh.locator("#lpn-counterfactual .painted img")).to_be_visible()

    # A link opens what it names, and an address that names nothing the first screen, wherever the page was left.
    fresh.goto(link)
    expect(first.locator(".reason .track")).to_have_count(4)
    expect(first.locator("figcaption").first).to_contain_text("0008")
    fresh.keyboard.press("b")
    expect(first).to_have_count(0)
    fresh.goto(app.url)
    expect(button).to_have_text("Why?")
    explorer.open(f"{app.url}/?screen=all")
    expect(explorer.rows).to_have_count(10)
    expect(first).to_have_count(0)
    fresh.keyboard.press("Escape")
    fresh.locator("#lpn-header").get_by_role("button", name="Start", exact=True).click()
    expect(button).to_have_text("Why?")
    fresh.keyboard.press("b")
    expect(first).to_have_count(0)
    expect(fresh.locator("#lpn-lab-table tr[data-row]").first).to_be_visible()
    fresh.wait_for_url(lambda url: "lab=1" in url)
    fresh.go_back()
    expect(button).to_have_text("Why?")


@pytest.mark.slow
def test_the_theme_is_the_system_s_until_somebody_chooses(app: RunningApp, fresh: Page) -> None:
    root = fresh.locator("html")
    fresh.emulate_media(color_scheme="light")
    fresh.goto(app.url)
    expect(fresh.locator("#lpn-first .sentence")).to_be_visible()
    expect(root).to_have_attribute("data-mantine-color-scheme", "light")
    fresh.locator("#lpn-first [data-act=dark]").click()
    expect(root).to_have_attribute("data-mantine-color-scheme", "dark")
    fresh.wait_for_function("localStorage.getItem('lpn-theme') === 'dark'")
    fresh.goto(f"{app.url}/?theme=light")
    expect(fresh.locator("#lpn-first .sentence")).to_be_visible()
    expect(root).to_have_attribute("data-mantine-color-scheme", "dark")


@pytest.mark.slow
def test_windows_and_the_tour_lead_back_to_where_they_were_begun(app: RunningApp, fresh: Page) -> None:
    first = fresh.locator("#lpn-first")
    fresh.goto(app.url)
    query = first.locator("[data-query]")
    before = query.get_attribute("data-query")
    assert before is not None
    first.get_by_role("button", name="Where it fails").click()
    expect(first.locator(".walk")).to_contain_text("1 of ")
    fresh.keyboard.press("n")
    expect(first.locator(".walk")).to_contain_text("2 of ")
    first.get_by_role("button", name="Charts of all pictures").click()
    expect(fresh.locator("#lpn-lab-breakdown")).to_be_visible()
    fresh.keyboard.press("b")
    expect(first.locator(".walk")).to_contain_text("2 of ")
    fresh.keyboard.press("Escape")
    expect(query).to_have_attribute("data-query", before)
    first.get_by_role("button", name="All pictures in a table").click()
    expect(fresh.locator("#lpn-lab-table")).to_be_visible()
    expect(first).to_have_count(0)
    fresh.keyboard.press("b")
    expect(first.locator(".sentence")).to_contain_text("The model compared")
    for key in ("Escape", "ArrowDown"):
        first.get_by_role("button", name="Tour").click()
        expect(fresh.locator("#lpn-told.free")).to_be_visible()
        fresh.keyboard.press(key)
        expect(fresh.locator("#lpn-told")).to_have_count(0)
        if key == "Escape":
            expect(first.locator(".sentence")).to_contain_text("The model compared")
    # Any other key goes on in what the tour showed.
    expect(fresh.locator("#lpn-header .tools")).to_be_visible()
    expect(first).to_have_count(0)


@pytest.mark.slow
def test_a_picture_of_ones_own_is_chosen_on_a_small_screen(app: RunningApp, fresh: Page, tmp_path: Path) -> None:
    fresh.set_viewport_size({"width": 1024, "height": 600})  # the left panel is folded
    fresh.goto(app.url)
    first = fresh.locator("#lpn-first")
    expect(first.locator(".sentence")).to_contain_text("The model compared")
    # The key brings the reason, and the button that closes it, into sight from wherever it is pressed.
    first.get_by_role("button", name="Where it fails").focus()
    fresh.keyboard.press("y")
    expect(first.locator(".reason")).to_be_in_viewport()
    expect(first.locator("button.main")).to_be_focused()
    expect(first.locator("button.main")).to_be_in_viewport()
    fresh.keyboard.press("y")
    expect(first.locator(".reason")).to_have_count(0)
    small_worlds.write(tmp_path / "mine.png", small_worlds.place(5))
    first.locator("[data-act=upload]").click()
    with fresh.expect_file_chooser() as chooser:
        first.get_by_role("button", name="Choose pictures").click()
    chooser.value.set_files(tmp_path / "mine.png")
    expect(first.locator("figcaption").first).to_contain_text("Your picture mine.png")
    expect(first.locator(".sentence")).to_contain_text("not graded")
    first.locator("button.main").click()
    expect(first.locator(".reason")).to_be_visible()
    fresh.keyboard.press("Escape")
    expect(first.locator(".reason")).to_have_count(0)
    link = first.get_by_role("button", name="Link", exact=True)
    link.focus()
    why = "A link cannot carry your own picture. “Save” makes a file that can be sent."
    expect(link).to_have_accessible_description(why)
    with fresh.expect_download() as download:
        first.get_by_role("button", name="Save this answer").click()
    assert "mine.png" in download.value.path().read_text("utf-8")
    expect(first.locator(".overall")).to_contain_text(
        "stays in the memory of the computer that runs this page (this one, unless its port is forwarded) until"
    )

    # Several at once are stepped through.
    for index in (6, 7):
        small_worlds.write(tmp_path / f"{index}.png", small_worlds.place(index))
    with fresh.expect_file_chooser() as chooser:
        first.locator("[data-act=upload]").click()
    chooser.value.set_files([tmp_path / "6.png", tmp_path / "7.png"])
    expect(first.locator(".steps")).to_contain_text("2 of 3")
    first.get_by_role("button", name="Next picture of yours").click()
    expect(first.locator(".steps")).to_contain_text("3 of 3")
    expect(first.locator("figcaption").first).to_contain_text("7.png")

    # The tour speaks of the data's pictures, so it does not begin by itself now.
    first.locator("[data-act=all]").first.click()
    expect(first).to_have_count(0)
    expect(fresh.locator("#lpn-header .tools")).to_be_visible()
    fresh.wait_for_timeout(1500)  # the tour comes after 0.7 s
    expect(fresh.locator("#lpn-told")).to_have_count(0)
    # The field's terms came unasked with the workbench, so they stay with it, and the next visit speaks plain words.
    fresh.reload()
    tools, words = fresh.locator("#lpn-header .tools"), first.locator("[data-act=words]")
    expect(tools).to_contain_text("Plain words")
    # The first screen speaks as it did, however the page comes back to it.
    fresh.goto(f"{app.url}/?screen=first")
    expect(words).to_have_text("Expert words")
    for back in (fresh.locator("#lpn-header .home").click, fresh.go_back):
        first.locator("[data-act=all]").first.click()
        expect(tools).to_contain_text("Plain words")
        fresh.wait_for_function("() => !location.search.includes('screen=first')")  # the address is written 0.2 s later
        back()
        expect(words).to_have_text("Expert words")
    # It keeps expert words that were asked for.
    words.click()
    expect(words).to_have_text("Plain words")
    first.locator("[data-act=all]").first.click()
    fresh.locator("#lpn-header .home").click()
    expect(words).to_have_text("Plain words")
    words.click()
    expect(words).to_have_text("Expert words")
    fresh.goto(app.url)
    expect(words).to_have_text("Expert words")


@pytest.mark.slow
def test_a_phone_shows_what_was_asked_for(app: RunningApp, browser: Browser) -> None:
    context = empty_context(browser, viewport={"width": 390, "height": 664}, has_touch=True, is_mobile=True)
    page = context.new_page()
    page.goto(app.url)
    first, query = page.locator("#lpn-first"), page.locator("#lpn-first .pair img").first
    first.get_by_role("button", name="Why?").tap()
    expect(first.locator(".reason p").first).to_be_in_viewport(ratio=1)
    expect(query).to_be_in_viewport(ratio=0.99)
    first.get_by_role("button", name="Tour").tap()
    expect(page.locator("#lpn-told")).to_be_visible()
    page.keyboard.press("Escape")
    expect(first.locator("h1")).to_be_in_viewport(ratio=1)
    page.evaluate("HTMLInputElement.prototype.click = function () { window.chooser = this; }; 0")
    # The page says what suits, and where it goes, before the chooser opens.
    first.locator("[data-act=upload]").tap()
    offer = first.locator(".offer")
    expect(offer).to_contain_text(
        "memory of the computer that runs this page (this one, unless its port is forwarded) until you close this page, and goes"
    )
    page.evaluate("lpn.firstAgain()")  # as when all pictures are ranked
    assert page.evaluate("window.chooser === undefined")
    first.get_by_role("button", name="Choose pictures").tap()
    assert page.evaluate("window.chooser !== undefined")
    first.locator("[data-act=not-now]").tap()
    expect(first.locator(".offer")).to_have_count(0)
    before = first.locator(".pair").get_attribute("data-query")
    assert before is not None
    first.get_by_text("Another picture").tap()
    expect(first.locator(".pair")).not_to_have_attribute("data-query", before)
    expect(query).to_be_in_viewport(ratio=0.99)
    expect(first.get_by_text("Another picture")).to_be_in_viewport(ratio=1)
    large = page.locator("#lpn-large")
    for close_large in (lambda: page.keyboard.press("Escape"), large.locator("img").tap, page.go_back):
        query.tap()
        expect(large.locator("img")).to_be_in_viewport(ratio=1)
        close_large()
        expect(large).to_have_count(0)
        expect(query).to_be_focused()
    first.get_by_role("button", name="Glossary").tap()
    close = page.locator("#lpn-glossary button")
    expect(close).to_be_in_viewport(ratio=1)
    close.tap()
    first.get_by_text("Where it fails").tap()
    expect(first.locator(".walk")).to_contain_text("1 of ")
    first.get_by_text("Charts of all pictures").tap()
    expect(page.locator("#lpn-lab-breakdown [tabindex]").first).to_be_in_viewport(ratio=1)
    expect(page.locator(".lab-bar")).to_be_in_viewport(ratio=0.99)
    start = page.get_by_role("button", name="Start", exact=True)
    expect(start).to_be_in_viewport(ratio=1)
    # A folded sheet hides neither the way back nor what is asked for next.
    page.evaluate("document.querySelector(lpn.viser.SELECTORS.sheetHead).click()")
    expect(page.locator("#lpn-header")).to_be_hidden()
    start.tap()
    link = context.new_page()
    link.goto(f"{app.url}/?why=1&reason=comparison")
    compared = link.locator("#lpn-counterfactual .facts")
    expect(compared).to_be_in_viewport(ratio=0.95)
    assert box(compared)["width"] <= 390, "it makes the sheet no wider"
    link.close()

    # The tour waits until it is asked for, and a finger that scrolls does not end it.
    first.locator("[data-act=all]").tap()
    expect(first).to_have_count(0)
    page.wait_for_timeout(1500)  # the tour comes after 0.7 s
    card = page.locator("#lpn-told")
    expect(card).to_have_count(0)
    page.locator("#lpn-header .tools").get_by_text("Tour").tap()
    expect(card).to_be_visible()
    page.evaluate(NOTE_REST)
    touch = context.new_cdp_session(page)
    for kind, y in (("Start", 620), *(("Move", y) for y in range(600, 400, -20)), ("End", None)):
        points = [] if y is None else [{"x": 195, "y": y}]
        touch.send("Input.dispatchTouchEvent", {"type": f"touch{kind}", "touchPoints": points})
    expect(page.locator("#lpn-header")).not_to_be_in_viewport()
    expect(card).to_be_visible()
    # A tap on a sheet that still glides stops it, and nothing else.
    page.wait_for_function("window.atRest")
    page.touchscreen.tap(195, 620)
    expect(card).to_have_count(0)
    page.get_by_label("Expand panel Query").tap()
    expect(page.get_by_role("button", name="Use my own picture").first).to_be_in_viewport(ratio=1)
    context.close()


@pytest.mark.slow
def test_a_shared_link_opens_what_it_names_in_any_browser(app: RunningApp, fresh: Page) -> None:
    fresh.goto(f"{app.url}/?query=0011&lab=1")
    explorer = ExplorerPage(fresh)
    explorer.await_answer()
    explorer.expect_status("name", "0011")
    expect(fresh.locator("#lpn-lab-table tr[data-row]").first).to_be_visible()
    expect(fresh.locator("#lpn-first")).to_have_count(0)


@pytest.mark.slow
def test_why_shows_the_same_details_in_the_photo_and_on_the_map(demo_app: RunningApp, fresh: Page) -> None:
    first = fresh.locator("#lpn-first")
    fresh.goto(demo_app.url)
    expect(first.locator(".sentence")).to_contain_text("By its details: placed.")
    first.locator("[data-act=why]").click()
    photo, ground = first.locator(".pins").first, first.locator(".pins").last
    expect(ground.locator(".pin")).to_have_count(24)
    name = first.locator(".matched figcaption").first.locator(".dim").text_content()
    answers = json.loads((DEMO_PLACE[0].with_name(DEMO_ANSWERS) / "located.json").read_text())
    pose = np.array(answers["registration"][name]["homography"]).reshape(3, 3)
    height, width, _ = load_picture(DEMO_PLACE[1] / str(name)).shape
    in_photo, on_map = (pins.evaluate(PLACES) for pins in (photo, ground))
    assert list(in_photo) == list(on_map) == [str(number) for number in range(1, 25)]
    # The frame is where the pose lays the photo's corners, so it tells the ground of each point of the map.
    corners = ground.locator("polygon").last.evaluate("(one) => [...one.points].map(({x, y}) => [x / 100, y / 100])")
    to_ground = four_point_homography(corners, apply_homography(pose, corner_pixels(width, height)))
    off = [
        float(
            np.hypot(
                *(apply_homography(pose, np.multiply(at, (width, height)) - 0.5) - apply_homography(to_ground, there))
            )
        )
        for at, there in zip(in_photo.values(), on_map.values(), strict=True)
    ]
    limit = re.search(r"and all within ([\d.]+)\sm", str(first.locator(".agree").text_content()))
    assert limit is not None
    assert max(off) < float(limit[1])
    told = first.locator(".pinned td:last-child").evaluate_all("(all) => all.map((one) => parseFloat(one.textContent))")
    assert told == pytest.approx(off, abs=0.03)

    which, lit = first.locator(".which"), first.locator(".pin.lit")
    photo.locator("[data-pin='11']").hover()
    expect(which).to_contain_text(re.compile(r"Detail 11: [\d.]+\sm off its place, of 0.9\sm allowed"))
    assert lit.evaluate_all("(all) => all.map((one) => one.dataset.pin)") == ["11", "11"]
    ground.locator("[data-pin='7']").hover()
    assert lit.evaluate_all("(all) => all.map((one) => one.dataset.pin)") == ["7", "7"]
    first.locator("h1").hover()
    expect(lit).to_have_count(0)
    photo.focus()
    fresh.keyboard.press("ArrowRight")
    fresh.keyboard.press("ArrowRight")
    expect(which).to_contain_text("Detail 2:")
    over = ground.locator(".over")
    assert over.evaluate("(one) => getComputedStyle(one).opacity") == "0"
    first.get_by_label("Photo over map").focus()
    fresh.keyboard.press("End")
    assert over.evaluate("(one) => getComputedStyle(one).opacity") == "1"
    expect(first.locator(".reason .pair img")).to_have_count(3)
    first.get_by_text("The numbered details").click()
    first.locator(".pinned tr").nth(5).hover()
    assert lit.evaluate_all("(all) => all.map((one) => one.dataset.pin)") == ["5", "5"]
    expect_accessible(fresh)


@pytest.mark.slow
def test_an_own_picture_of_the_real_place_is_laid_on_its_map_and_a_foreign_one_is_refused(
    demo_app: RunningApp, fresh: Page, tmp_path: Path
) -> None:
    first = fresh.locator("#lpn-first")
    sentence, captions, place = first.locator(".sentence"), first.locator("figcaption"), first.locator("details.bring")

    def send(file: Path) -> None:
        with fresh.expect_file_chooser() as chooser:
            first.locator("[data-act=upload]").click()
            if (choose := first.get_by_role("button", name="Choose pictures")).is_visible():
                choose.click()
        chooser.value.set_files(file)
        expect(captions.first).to_contain_text(file.name)
        expect(first.locator(".comparing")).to_contain_text("Its details are compared with the map")
        expect(first.locator(".coming")).to_contain_text("Its place is not known yet")
        expect(first.locator("figure img")).to_have_count(1)
        assert fresh.evaluate("document.getAnimations().every((one) => one.animationName !== 'lpn-turn')")

    # A ring that turns while the map is searched would take the time of the search from it.
    fresh.emulate_media(reduced_motion="reduce")
    fresh.goto(demo_app.url)
    expect(sentence).to_contain_text("By its details: placed.")
    first.get_by_text("See it on the map").click()
    alone = fresh.locator(".flight.alone")
    expect(alone.locator(".legend .marks")).to_contain_text(
        "Dots and line: the places of the photos, by their details."
    )
    expect(alone.locator(".legend")).to_contain_text("Red diamond: in doubt")
    expect(alone.locator(".legend table")).to_be_hidden()
    alone.get_by_role("button", name="Back").click()
    send(DEMO_PLACE[1] / "IMG_9368.webp")
    place.locator("summary").click()
    # The search gives way to all else that the machine does.
    expect(sentence).to_contain_text("On this map.", timeout=3000 * PATIENCE)
    expect(sentence).to_contain_text("your picture fits the map; its GPS tag lies ")
    expect(first).to_contain_text("only 19 of 30 photos here lie that near to their GPS tags, where nearly all should")
    expect(captions.nth(2)).to_contain_text("On the map")
    # The opened details and the focus outlast the answer.
    expect(place).to_have_attribute("open", "")
    expect(place.locator("summary")).to_be_focused()
    first.get_by_text("See it on the map").click()
    window = fresh.locator("#lpn-flight.own")
    expect(window.locator(".laid img")).to_be_visible()
    expect(window.locator("#lpn-flight-verdict")).to_contain_text("Middle of the picture: latitude 30.17")
    expect(window.locator(".time")).to_be_hidden()
    expect(fresh.get_by_text("Matches", exact=True)).to_have_count(0)
    window.get_by_role("button", name="Back").click()

    # Half its size, which is searched in a fifth of the time; tests/lpn/locate/test_own_photo.py has the whole.
    foreign = load_picture(DEMO_FLIGHT[1] / "LPN_0086.webp")
    small_worlds.write(tmp_path / "foreign.png", shrink(foreign, 320))
    send(tmp_path / "foreign.png")
    expect(sentence).to_contain_text("Its details fit nowhere on this map", timeout=6000 * PATIENCE)
    expect(captions).to_have_count(2)


@pytest.mark.slow
def test_a_notice_covers_no_button(demo_app: RunningApp, fresh: Page, tmp_path: Path) -> None:
    (tmp_path / "torn.jpg").write_bytes(b"no picture")
    fresh.goto(demo_app.url)
    first = fresh.locator("#lpn-first")
    first.locator("[data-act=upload]").click()
    with fresh.expect_file_chooser() as chooser:
        first.get_by_role("button", name="Choose pictures").click()
    chooser.value.set_files(tmp_path / "torn.jpg")
    notice = fresh.locator(".mantine-Notification-root", has_text="torn.jpg").last
    expect(notice).to_contain_text("is not a picture that can be read")
    first.get_by_role("button", name="Not now").click()
    buttons = first.locator(".acts").locator("a, button")
    for width in (1600, 1440, 1280, 1160, 1000, 700):
        fresh.set_viewport_size({"width": width, "height": 800})
        first.evaluate("(page) => page.scrollTo(0, page.scrollHeight)")

        def covers_none(width: int = width) -> None:
            for button in buttons.all():
                button.evaluate("(button) => button.scrollIntoView({ block: 'end' })")  # as low as it can stand
                low, high = box(button), box(notice)
                beside = high["x"] + high["width"] <= low["x"] or low["x"] + low["width"] <= high["x"]
                above = low["y"] + low["height"] <= high["y"] + 0.5
                assert beside or above, (width, button.text_content(), low, high)

        ExplorerPage(fresh).eventually(covers_none)  # a busy page is laid out later than its window has another size


@pytest.mark.slow
def test_own_pictures_go_to_the_host_of_the_address(data: Path, model_file: Path, tmp_path: Path, fresh: Page) -> None:
    options = ["--allow-host", "lab.localhost"]  # browsers find such a name on this computer
    with started(data, model_file, tmp_path / "cache", options=options) as app:
        fresh.goto(app.url.replace("127.0.0.1", "lab.localhost"))
        fresh.locator("#lpn-first [data-act=upload]").click()
        offer = fresh.locator("#lpn-first .offer")
        expect(offer).to_contain_text("the memory of the computer that runs this page (lab.localhost) until")
