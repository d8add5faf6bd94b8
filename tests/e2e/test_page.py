"""Tests of the page itself: its address, two themes, a tour, commands, and screens of every size."""

from __future__ import annotations

import re
import threading
from collections.abc import Callable
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import cv2
import numpy as np
import pytest
from playwright.sync_api import Browser, BrowserContext, FloatRect, Page, expect

from explorer.app import App
from explorer.layout import layout_for
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.workspace import StateAnalyser, StateAnalysis
from tests.e2e.conftest import PATIENCE, ExplorerPage, RunningApp, box, classic, difference, empty_context, started
from tools.fixtures import small_worlds
from tools.fixtures.processes import free_port

# Two elements have boxes and no pixel in common.
APART = """selectors => {
  const [one, other] = selectors.map((selector) => document.querySelector(selector)?.getBoundingClientRect());
  if (!one?.width || !other?.width) return false;
  return one.right <= other.left || other.right <= one.left || one.bottom <= other.top || other.bottom <= one.top;
}"""
# Puts a copy of an element, if it is there, where that lies, or to the window's edge; returns its place.
STAYING = """id => {
  const found = document.getElementById(id);
  if (!found) return null;
  const { left, top, width, height } = found.getBoundingClientRect(), copy = found.cloneNode(true);
  copy.id = "staying";
  const x = Math.max(0, Math.min(left, innerWidth - width)), y = Math.max(0, Math.min(top, innerHeight - height));
  copy.style.cssText = `position:fixed;left:${x}px;top:${y}px;width:${width}px;height:${height}px;pointer-events:none`;
  document.body.append(copy);
  return { x, y };
}"""
SHOWN = ("query", "name", "angle", "chosen", "top")


def asked(explorer: ExplorerPage) -> dict[str, str]:
    return {key: values[0] for key, values in parse_qs(urlsplit(explorer.page.url).query).items()}


def shown(explorer: ExplorerPage) -> dict[str, str | None]:
    return {name: explorer.status.get_attribute(f"data-{name}") for name in SHOWN}


def wait_address(explorer: ExplorerPage, key: str, value: str | None) -> None:
    explorer.page.wait_for_function(
        "([key, value]) => new URLSearchParams(location.search).get(key) === value", arg=[key, value]
    )


def overlap(one: FloatRect, other: FloatRect) -> float:
    across = min(one["x"] + one["width"], other["x"] + other["width"]) - max(one["x"], other["x"])
    down = min(one["y"] + one["height"], other["y"] + other["height"]) - max(one["y"], other["y"])
    return max(across, 0) * max(down, 0)


def test_an_address_brings_back_what_was_shown(explorer: ExplorerPage, contexts: Callable[..., BrowserContext]) -> None:
    explorer.fill("Find name", "0011")
    explorer.expect_status("name", "0011")
    explorer.fill("Rotate", "-40")
    explorer.expect_status("angle", "-40")
    explorer.tab("Parts")
    explorer.tick("Part 4 outer", False)
    explorer.fill("Weight 1 centre", "1.5")
    expect(explorer.page.locator("#lpn-parts")).to_contain_text("43 %")
    explorer.rows.nth(2).click()
    expect(explorer.rows.nth(2)).to_have_class(re.compile("chosen"))
    for key in "xoy":
        explorer.key(key)
    expect(explorer.page.locator("#lpn-why .lpn-map")).to_have_count(2)
    wait_address(explorer, "why", "1")
    assert asked(explorer)["query"] == "0011"

    other = ExplorerPage(contexts().new_page())
    other.open(explorer.page.url)
    assert other.sequence() == 1, "another state was shown first"
    assert shown(other) == shown(explorer)
    assert other.verdict.inner_text() == explorer.verdict.inner_text()
    assert other.rows.all_inner_texts() == explorer.rows.all_inner_texts()
    expect(other.page.locator("#lpn-why .lpn-map")).to_have_count(2)
    expect(other.page.locator("html")).to_have_attribute("data-mantine-color-scheme", "light")
    expect(other.field("Take apart")).to_be_checked()
    expect(other.field("Rotate")).to_have_value("-40")
    other.tab("Parts")
    expect(other.field("Part 4 outer")).not_to_be_checked()
    expect(other.field("Weight 1 centre")).to_have_value("1.5")
    assert asked(other) == asked(explorer)


@pytest.mark.slow
def test_an_address_can_name_another_task(app: RunningApp, new_page: Callable[[], Page]) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(f"{app.url}/?task=satellite-to-drone&query=0010&with=truth")
    expect(explorer.page.locator("#lpn-tasks a.chosen")).to_have_text("satellite → drone")
    expect(explorer.page.locator("#lpn-header")).to_contain_text("14 gallery pictures")
    assert (shown(explorer)["name"], explorer.sequence()) == ("0010", 1)
    explorer.key("n")
    explorer.expect_status("name", "0011")
    wait_address(explorer, "task", "satellite-to-drone")


@pytest.mark.slow
def test_a_hostile_address_does_no_harm(app: RunningApp, new_page: Callable[[], Page]) -> None:
    explorer = ExplorerPage(new_page())
    alarms: list[str] = []
    explorer.page.on("dialog", lambda dialog: (alarms.append(dialog.message), dialog.dismiss()))
    explorer.page.on("pageerror", lambda error: alarms.append(str(error)))
    explorer.page.goto(
        f"{app.url}/?query=%3Cimg%20src%3Dx%20onerror%3Dalert(1)%3E&angle=1e99&with=%00&weights=a,b"
        "&region=0-9999999&theme=');alert(2)//&part=2&other=a%26b"
    )
    expect(explorer.status).not_to_have_attribute("data-seq", "0")
    notice = explorer.page.locator(".mantine-Notification-root", has_text="Not all of the link")
    for text in ("query=<img", "angle=1e99", "with=", "weights=", "region=", "theme="):
        expect(notice).to_contain_text(text)
    wait_address(explorer, "query", "0007")
    assert asked(explorer) == {"task": "drone-to-satellite", "query": "0007", "part": "2", "other": "a&b"}
    assert not alarms
    explorer.fill("Rotate", "10")
    explorer.expect_status("angle", "10")
    expect(notice).to_be_visible()
    explorer.key("n")  # another picture, of which it does not speak
    expect(notice).to_have_count(0)


@pytest.mark.slow
def test_ones_own_picture_is_in_no_link(
    app: RunningApp, contexts: Callable[..., BrowserContext], tmp_path: Path
) -> None:
    explorer = ExplorerPage(contexts(permissions=["clipboard-read", "clipboard-write"]).new_page())
    explorer.open(app.url)
    explorer.page.evaluate("navigator.clipboard.writeText('before')")
    file = tmp_path / "mine.png"
    small_worlds.write(file, small_worlds.place(77))
    explorer.upload(file)
    explorer.expect_status("name", "mine.png")
    wait_address(explorer, "query", "own")
    explorer.page.get_by_role("button", name="Link", exact=True).hover()
    expect(explorer.page.locator("#lpn-term")).to_contain_text("A link cannot carry your own picture.")
    explorer.key("i")
    expect(explorer.page.locator("#lpn-notice")).to_have_text("A link cannot carry your own picture.")
    assert explorer.page.evaluate("navigator.clipboard.readText()") == "before"
    other = ExplorerPage(contexts().new_page())
    other.page.goto(explorer.page.url)
    expect(other.notifications.first).to_contain_text("An own picture is held only by the page that opened it")


@pytest.mark.slow
def test_the_link_is_copied_by_key(app: RunningApp, contexts: Callable[..., BrowserContext]) -> None:
    context = contexts(permissions=["clipboard-read", "clipboard-write"])
    explorer = ExplorerPage(context.new_page())
    explorer.open(app.url)
    explorer.fill("Rotate", "25")
    wait_address(explorer, "angle", "25")
    explorer.key("i")
    expect(explorer.page.locator("#lpn-notice")).to_have_text(
        "Link copied: it opens what you see, on this computer only, as its address is 127.0.0.1."
    )
    assert explorer.page.evaluate("navigator.clipboard.readText()") == f"{explorer.page.url}&words=expert"


def coarse(picture: np.ndarray) -> np.ndarray:
    """A picture's blocks of 8 x 8 pixels."""
    return cv2.resize(picture.astype(np.float32), None, fx=1 / 8, fy=1 / 8, interpolation=cv2.INTER_AREA)


@pytest.mark.slow
def test_light_and_dark(explorer: ExplorerPage) -> None:
    dark = explorer.stage(lambda picture: picture[3, 3].max() < 60)
    explorer.page.get_by_text("Light", exact=True).click()
    expect(explorer.page.locator("html")).to_have_attribute("data-mantine-color-scheme", "light")
    wait_address(explorer, "theme", "light")
    light = explorer.stage(lambda picture: picture[3, 3].min() > 240)
    assert (light.min(axis=2) < 25).mean() < 0.1  # no caption stays on a dark patch
    explorer.key("o")
    expect(explorer.page.locator("html")).to_have_attribute("data-mantine-color-scheme", "dark")
    wait_address(explorer, "theme", None)
    # The key moved no camera; where drawing is slow viser takes fewer pixels, which moves single ones.
    explorer.stage(lambda picture: difference(coarse(picture), coarse(dark)) < 0.1)


@pytest.mark.slow
def test_the_tour_and_the_notice_about_software_webgl_are_shown_once_and_the_tour_follows_the_stage(
    app: RunningApp, browser: Browser
) -> None:
    context = empty_context(browser, viewport={"width": 1280, "height": 720})
    explorer = ExplorerPage(context.new_page())
    explorer.open(app.url)
    notice = explorer.page.locator("#webgl-software-rendering")
    card, spot = explorer.page.locator("#lpn-told.card"), explorer.page.locator("#lpn-spot")
    expect(card).to_contain_text("1 of 5")
    # A browser that draws without a graphics card shows the notice. It moves and goes by itself, so a copy that stays is pressed.
    if place := explorer.page.evaluate(STAYING, "webgl-software-rendering"):
        explorer.page.mouse.click(place["x"] + 20, place["y"] + 20)
        explorer.page.evaluate("document.getElementById('staying').remove()")
    for step in range(1, 6):
        expect(card).to_contain_text(f"{step} of 5")
        # Both are moved in one step while panels settle, so both are measured in one.
        explorer.page.wait_for_function(APART, arg=["#lpn-told.card", "#lpn-spot"])
        card.get_by_role("button", name="Done" if step == 5 else "Next").click()
    expect(card).to_have_count(0)
    expect(notice).to_have_count(0)  # it goes by itself
    explorer.page.reload()
    explorer.await_answer()
    expect(explorer.rows).to_have_count(10)
    expect(card).to_have_count(0)
    expect(notice).to_have_count(0)
    explorer.command("tour")
    expect(card).to_contain_text("1 of 5")
    expect(explorer.page.get_by_placeholder("Search commands")).to_have_count(0)
    explorer.page.set_viewport_size({"width": 1024, "height": 600})

    def follows() -> None:
        stage, frame = box(explorer.canvas), box(spot)
        layout = layout_for((256, 256), 4, (round(stage["width"]), round(stage["height"])))
        (x, _), (width, _) = layout.query
        assert frame["x"] + frame["width"] / 2 == pytest.approx(
            stage["x"] + stage["width"] / 2 + x * layout.unit, abs=2
        )
        assert frame["width"] == pytest.approx(width * layout.unit + 8, abs=3)
        assert overlap(box(card), box(explorer.verdict)) == 0

    explorer.eventually(follows)
    for step in range(2, 6):
        card.get_by_role("button", name="Next").click()
        expect(card).to_contain_text(f"{step} of 5")

    def stands_beside() -> None:
        beside, frame = box(card), box(spot)
        assert 0 <= frame["x"] - beside["x"] - beside["width"] < 200
        assert overlap(beside, box(explorer.verdict)) == 0

    explorer.eventually(stands_beside)
    explorer.page.keyboard.press("Escape")
    expect(card).to_have_count(0)
    expect(spot).to_have_count(0)
    context.close()


@pytest.mark.slow
def test_queries_are_steps_of_the_browser_s_history_and_of_the_list(explorer: ExplorerPage) -> None:
    expect(explorer.page).to_have_title(re.compile("^places · LPN Explorer$"))
    wait_address(explorer, "query", "0007")
    for name in ("0008", "0009"):
        explorer.key("n")
        wait_address(explorer, "query", name)
    explorer.key("j")
    wait_address(explorer, "angle", "5")
    explorer.key("h")
    wait_address(explorer, "heat", "0")
    explorer.key("j")
    wait_address(explorer, "angle", "10")
    for angle, heat in (("5", "0"), ("5", None), (None, None)):  # each act is one step back
        explorer.page.go_back()
        wait_address(explorer, "angle", angle)
        wait_address(explorer, "heat", heat)
        explorer.expect_status("name", "0009")
    explorer.page.go_back()
    explorer.expect_status("name", "0008")
    explorer.page.go_back()
    explorer.expect_status("name", "0007")
    explorer.page.go_forward()
    explorer.expect_status("name", "0008")
    wait_address(explorer, "query", "0008")
    for _ in range(2):
        explorer.key("p")
    explorer.expect_status("name", "0020")
    expect(explorer.page.locator("#lpn-picker .thumb.chosen")).to_contain_text("0020")


@pytest.mark.slow
def test_everything_can_be_reached_by_keyboard_and_read_aloud(explorer: ExplorerPage, tmp_path: Path) -> None:
    page = explorer.page
    expect(page.locator("#lpn-live")).to_contain_text(explorer.verdict.locator("b").inner_text())
    expect(explorer.canvas).to_have_attribute("aria-label", re.compile("^Stage: "))
    head = page.get_by_role("button", name="Compared pair")
    expect(head).to_have_attribute("aria-expanded", "true")
    head.press("Enter")
    expect(head).to_have_attribute("aria-expanded", "false")
    expect(page.locator("#lpn-parts")).to_be_hidden()
    for name in ("Link", "Tour"):
        assert page.get_by_role("button", name=name, exact=True).evaluate("one => (one.focus(), one.matches(':focus'))")
    sizes = page.evaluate(
        "() => [...document.querySelectorAll('.mantine-Slider-markLabel, label, .lpn')].filter(one => one.offsetHeight)"
        ".map(one => [parseFloat(getComputedStyle(one).fontSize), one.innerText.slice(0, 30)])"
    )
    assert min(sizes)[0] >= 12, min(sizes)
    (tmp_path / "empty.png").write_bytes(b"")
    explorer.upload(tmp_path / "empty.png")
    expect(page.get_by_text("Sent; it is being read.")).to_be_visible()  # first, as it goes after 4 s
    expect(page.get_by_text("empty.png is empty, or has more than 30 MB")).to_be_visible()
    assert page.get_by_text("uploaded successfully").count() == 0
    explorer.tab("Parts")
    expect(page.get_by_text("All parts equal")).to_be_visible()


@pytest.mark.slow
def test_what_has_no_key_is_in_the_palette(explorer: ExplorerPage) -> None:
    for command, key, value in (
        ("Part 2 on or off", "off", "2"),
        ("Shift right by", "shift", "8"),
        ("Heatmap of part 4", "part", "4"),
        ("Task: satellite", "task", "satellite-to-drone"),
    ):
        explorer.command(command)
        wait_address(explorer, key, value)
        expect(explorer.page.get_by_placeholder("Search commands")).to_have_count(0)


@pytest.mark.slow
def test_everything_needed_is_in_view_on_a_projector(app: RunningApp, contexts: Callable[..., BrowserContext]) -> None:
    context = contexts(viewport={"width": 1280, "height": 720})
    context.add_init_script("localStorage.removeItem('lpn-open')")  # what is unfolded is not needed
    explorer = ExplorerPage(context.new_page())
    explorer.open(app.url)
    expect(explorer.rows).to_have_count(10)

    def are_in_view() -> None:
        for wanted in (explorer.verdict, explorer.rows.nth(9), explorer.page.locator("#lpn-picker .thumb").first):
            seen = box(wanted)
            assert seen["y"] >= 0
            assert seen["y"] + seen["height"] <= 720

    explorer.eventually(are_in_view)


@pytest.mark.slow
def test_a_phone_held_upright_whose_page_nothing_scrolls(
    app: RunningApp, contexts: Callable[..., BrowserContext]
) -> None:
    context = contexts(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True)
    explorer = ExplorerPage(context.new_page())
    explorer.open(app.url)

    def fits() -> None:
        stage, verdict = box(explorer.canvas), box(explorer.verdict)
        assert stage["width"] == 390
        assert stage["height"] > 330
        assert stage["y"] + stage["height"] <= box(explorer.page.locator("#lpn-header"))["y"]
        assert verdict["y"] + verdict["height"] < 844
        assert verdict["width"] > 340

    explorer.eventually(fits)
    explorer.expect_filled(1, 0.85)
    # Framed: it fills the width and no more.
    explorer.stage(lambda picture: np.flatnonzero((picture > 90).any(axis=(0, 2)))[0] >= 2)
    explorer.rows.nth(1).tap()
    expect(explorer.rows.nth(1)).to_have_class(re.compile("chosen"))
    explorer.page.get_by_role("button", name="Why this answer?").tap()
    expect(explorer.page.locator("#lpn-why .said")).to_be_in_viewport(ratio=0.95)
    expect(explorer.page.get_by_text("Tap a cell to see")).to_be_visible()
    expect(explorer.page.get_by_text("Move over a cell to see")).to_be_hidden()
    scroll = """() => {
      const boxes = [".mantine-ScrollArea-root", "#root", "html"].map((one) => document.querySelector(one));
      const filler = boxes.map((box) => box.appendChild(document.createElement("div")));
      filler.forEach((one) => (one.style = "height: 2000px; flex: none"));
      const could = boxes.map((box) => box.scrollHeight > box.clientHeight);
      boxes.forEach((box) => box.scrollTo(0, 419));
      return could;
    }"""
    assert all(explorer.page.evaluate(scroll))
    tops = "() => ['.mantine-ScrollArea-root', '#root', 'html'].map((one) => document.querySelector(one).scrollTop)"
    explorer.page.wait_for_function(f"({tops})().every((top) => top === 0)")


@pytest.mark.slow
def test_no_message_of_a_busy_page_is_lost(explorer: ExplorerPage) -> None:
    # Each message leaves a mark in the address.
    explorer.page.evaluate("""() => {
        lpn.send("task", "satellite-to-drone");
        lpn.send("part", 2);
        lpn.send("dark");
        lpn.send("region", [1]);
        for (const end = performance.now() + 500; performance.now() < end; );
    }""")
    for key, value in (("task", "satellite-to-drone"), ("part", "3"), ("theme", "light"), ("region", "1")):
        wait_address(explorer, key, value)


@pytest.mark.slow
def test_a_phone_held_sideways_whose_resized_stage_is_framed_again(
    app: RunningApp, contexts: Callable[..., BrowserContext]
) -> None:
    context = contexts(viewport={"width": 844, "height": 390}, has_touch=True, is_mobile=True)
    explorer = ExplorerPage(context.new_page())
    explorer.open(app.url)
    explorer.page.wait_for_function("document.querySelector('canvas[data-engine]').clientWidth > 400")

    def fits() -> None:
        assert box(explorer.verdict)["y"] < 320
        assert box(explorer.rows.nth(1))["height"] < 60, "its styles went with the folded panel"

    explorer.eventually(fits)
    explorer.expect_filled(0, 0.85)
    explorer.rows.nth(1).tap()
    expect(explorer.rows.nth(1)).to_have_class(re.compile("chosen"))
    explorer.expect_filled(0, 0.85)
    explorer.page.evaluate("""() => {
        const viser = window.__viserMutable, send = viser.sendCamera;
        viser.sendCamera = () => { window.reports = (window.reports || 0) + 1; send(); };
    }""")
    explorer.page.set_viewport_size({"width": 844, "height": 420})
    explorer.page.wait_for_function("window.reports > 0")
    explorer.expect_filled(0, 0.85)


@pytest.mark.slow
def test_a_slow_answer_is_said_to_be_on_its_way(
    app: RunningApp, new_page: Callable[[], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    answer = StateAnalyser.analyse
    go_on = threading.Event()

    def slowly(analyser: StateAnalyser, state: SessionState, k: int) -> StateAnalysis:
        if state.angle == 33:
            assert go_on.wait(PATIENCE)
        if state.angle == 44:
            raise RuntimeError("on purpose")
        return answer(analyser, state, k)

    monkeypatch.setattr(StateAnalyser, "analyse", slowly)
    monkeypatch.setenv("LPN_CACHE", str(app.model.parent / "cache"))
    served = App(open_model(app.data, app.model), "127.0.0.1", free_port())
    try:
        explorer = ExplorerPage(new_page())
        explorer.open(classic(f"http://127.0.0.1:{served.server.get_port()}"))
        explorer.fill("Rotate", "33")
        expect(explorer.status).to_contain_text("computing")
        assert explorer.status.get_attribute("data-angle") == "0"
        go_on.set()
        explorer.expect_status("angle", "33")
        expect(explorer.status).not_to_contain_text("computing")
        explorer.fill("Rotate", "44")
        expect(explorer.page.locator(".mantine-Notification-root", has_text="No answer")).to_contain_text("log has")
        expect(explorer.status).not_to_contain_text("computing")
    finally:
        served.close()


# Opens websockets to a server that is gone, so many that Chromium delays each further one by up to 5 s.
FAIL_OFTEN = """() => Promise.all(Array.from({length: 36}, () => new Promise((done) => {
  new WebSocket(location.origin.replace("http", "ws")).onclose = done;
})))"""


@pytest.mark.slow
def test_a_page_says_that_its_server_is_gone_and_finds_it_after_a_long_outage(
    app: RunningApp, contexts: Callable[..., BrowserContext]
) -> None:
    explorer, port = ExplorerPage(contexts().new_page()), free_port()
    with started(app.data, app.model, app.model.parent / "cache", port=port) as running:
        explorer.open(running.url)
        expect(explorer.page.locator("#lpn-notice")).to_have_count(0)
    expect(explorer.page.locator("#lpn-notice.shown")).to_contain_text("Start it again")
    explorer.page.evaluate(FAIL_OFTEN)
    with started(app.data, app.model, app.model.parent / "cache", port=port):
        expect(explorer.page.locator("#lpn-notice.shown")).to_contain_text("The server answers again")
        explorer.fill("Rotate", "10")
        explorer.expect_status("angle", "10")


@pytest.mark.slow
def test_the_glossary_is_searched_and_closed_by_button_key_and_back(explorer: ExplorerPage) -> None:
    link = explorer.page.locator("#lpn-header").get_by_text("Glossary", exact=True)
    term = explorer.page.get_by_role("cell", name="hardest negative is the negative of the highest score", exact=False)
    for close in (
        lambda: explorer.page.get_by_role("button", name="Close", exact=True).click(),
        lambda: explorer.page.keyboard.press("Escape"),
    ):
        link.click()
        expect(term).to_be_visible()
        close()
        expect(term).to_have_count(0)
    link.focus()
    explorer.page.keyboard.press("Enter")
    bar = explorer.page.locator("#lpn-glossary")
    box, count = bar.get_by_label("Search"), bar.get_by_role("status")
    expect(box).to_be_focused()
    box.fill("d2 squared")
    expect(count).to_have_text("1 term")
    expect(explorer.page.locator(".mantine-Modal-content tbody tr:visible")).to_contain_text("d²")
    box.fill("xyzzy")
    expect(count).to_have_text("No term matches.")
    query = explorer.status.get_attribute("data-query") or ""
    explorer.page.go_back()
    expect(bar).to_have_count(0)
    expect(link).to_be_focused()
    explorer.expect_status("query", query)


@pytest.mark.slow
def test_a_turned_stage_is_straightened(explorer: ExplorerPage) -> None:
    button, box = explorer.page.locator("#lpn-straighten"), explorer.canvas.bounding_box()
    assert box is not None
    expect(button).to_have_count(0)
    angle = "() => window.__viserMutable.camera.quaternion.toArray().map(Math.abs)"
    straight = explorer.page.evaluate(angle)
    explorer.page.mouse.move(box["x"] + box["width"] / 2, box["y"] + 20)
    explorer.page.mouse.down()
    explorer.page.mouse.move(box["x"] + box["width"] / 2 + 120, box["y"] + 160, steps=6)
    explorer.page.mouse.up()
    button.click()
    expect(button).to_have_count(0)
    explorer.eventually(lambda: np.testing.assert_allclose(explorer.page.evaluate(angle), straight, atol=0.01))


@pytest.mark.slow
def test_a_tab_stays_open_where_the_page_becomes_narrow(explorer: ExplorerPage) -> None:
    explorer.explain()
    explorer.tab("Heatmaps")
    heatmaps = explorer.page.locator("#lpn-heatmaps")
    expect(heatmaps).to_be_visible()
    for width in (500, 1280):
        explorer.page.set_viewport_size({"width": width, "height": 800})
        explorer.page.wait_for_timeout(600)  # viser draws the first tab at once
        expect(heatmaps).to_be_visible()


@pytest.mark.slow
def test_the_focus_follows_windows(explorer: ExplorerPage) -> None:
    opener = explorer.page.locator("#lpn-header").get_by_text("Glossary", exact=True)
    opener.focus()
    explorer.page.keyboard.press("b")
    expect(explorer.page.locator("#lpn-lab-rows")).to_be_focused()
    explorer.page.locator("#lpn-lab-table th [role=button]").first.focus()
    explorer.page.keyboard.press("Enter")
    head = explorer.page.locator("#lpn-lab-table th[aria-sort=ascending] [role=button]")
    expect(head).to_contain_text("name")
    expect(head).to_be_focused()
    tab = explorer.page.locator(".lab-bar .seg a", has_text="Breakdown")
    tab.focus()
    explorer.page.keyboard.press("Enter")
    expect(explorer.page.locator("#lpn-lab-breakdown")).to_be_visible()
    expect(tab).to_be_focused()
    views = explorer.page.locator(".lab-summary a", has_text="Views")
    views.focus()
    explorer.page.keyboard.press("Enter")
    name = explorer.page.locator("#lpn-lab-view-name")
    expect(name).to_be_focused()
    explorer.page.keyboard.type("tops")  # no letter is a command
    expect(name).to_have_value("tops")
    explorer.page.keyboard.press("Escape")
    expect(name).to_have_count(0)
    expect(views).to_be_focused()
    tab.focus()
    explorer.page.keyboard.press("b")
    expect(tab).to_have_count(0)
    expect(opener).to_be_focused()
    explorer.explain()
    close = explorer.page.locator(".close >> visible=true")
    close.click()
    expect(close).to_have_count(0)
    expect(opener).to_be_focused()
    explorer.explain()
    explorer.key("m")  # this data set has no map
    expect(close).to_have_count(1)
    explorer.key("Escape")
    expect(close).to_have_count(0)


@pytest.mark.slow
def test_a_panel_that_is_unfolded_repeats_no_call(
    explorer: ExplorerPage, data: Path, request: pytest.FixtureRequest
) -> None:
    page = explorer.page
    request.addfinalizer(lambda: (data / "stories.json").unlink(missing_ok=True))
    page.evaluate("() => { window.said = []; lpn.say = (text) => said.push(text); }")
    page.keyboard.press("s")
    page.wait_for_function("said.length === 1")
    handle = box(page.locator("[data-dock-region-collapse=right]"))
    x, y = handle["x"] + handle["width"] / 2, handle["y"] + handle["height"] / 2
    page.mouse.click(x, y)
    page.wait_for_function("!lpn.viser.field(lpn.bridge)")
    page.mouse.click(x, y)
    page.wait_for_function("lpn.viser.field(lpn.bridge)")
    page.keyboard.press("s")
    page.wait_for_function("said.length > 1")
    first, second = page.evaluate("said")
    assert first.startswith("Step 1 ")
    assert second.startswith("Step 2 ")


@pytest.mark.slow
def test_titles_of_the_bars_are_whole_on_a_narrow_stage(explorer: ExplorerPage) -> None:
    explorer.page.set_viewport_size({"width": 1024, "height": 768})
    titles = explorer.page.locator("#lpn-bars .head > span", has=explorer.page.locator(".term"))

    def are_whole() -> None:
        assert titles.count() == 2
        for title in titles.all():
            assert title.evaluate(
                "title => title.scrollWidth <= title.clientWidth && getComputedStyle(title).textOverflow === 'clip'"
            )
        below = explorer.page.locator("#lpn-bars .part").first.evaluate("part => part.getBoundingClientRect().top")
        room = explorer.page.locator("#lpn-bars").evaluate("bars => [bars.scrollHeight, bars.clientHeight]")
        assert all(title.evaluate("title => title.getBoundingClientRect().bottom") <= below for title in titles.all())
        assert room[0] <= room[1]

    explorer.eventually(are_whole)
