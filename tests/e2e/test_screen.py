"""The screen at `/`, used as a person would, beside the analysis that it shows."""

from __future__ import annotations

import re
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest
from playwright.sync_api import Locator, Page, expect

from explorer.workspace import WorkspaceAnalyser
from tests.e2e.conftest import Contexts, NewPage, Running, RunningApp, Screen, box, expect_accessible, started
from tools.fixtures import panorama_model, small_worlds

# The words of the page's text that are in sight; numbers are none.
WORDS = """() => {
  const words = [], walker = document.createTreeWalker(document.body, NodeFilter.SHOW_TEXT), range = document.createRange();
  for (let node = walker.nextNode(); node; node = walker.nextNode()) {
    if (!node.parentElement.checkVisibility({ opacityProperty: true, visibilityProperty: true })) continue;
    range.selectNodeContents(node);
    const place = range.getBoundingClientRect();
    if (place.width && place.top < innerHeight && place.bottom > 0 && place.left < innerWidth && place.right > 0)
      words.push(...(node.textContent.match(/[A-Za-z]{2,}/g) ?? []));
  }
  return words;
}"""
SIZES = [(1280, 720), (1920, 1080)]


@pytest.fixture
def panorama_app(tmp_path: Path) -> Iterator[RunningApp]:
    """The app on panoramas and tiles, with an untrained SAFA + LPN."""
    pairs = small_worlds.make_cvusa(tmp_path / "pairs", 12)
    with started(pairs, panorama_model.write(tmp_path), tmp_path / "cache") as running:
        yield running


def scrolls(page: Page) -> tuple[int, int]:
    """Return the pixels by which the page is larger than the window."""
    across, down = page.evaluate(
        "[document.documentElement.scrollWidth - innerWidth, document.documentElement.scrollHeight - innerHeight]"
    )
    return int(across), int(down)


def hides(outer: Locator) -> int:
    """Return the pixels of its content that an element hides."""
    return int(
        outer.evaluate("one => Math.max(one.scrollHeight - one.clientHeight, one.scrollWidth - one.clientWidth)")
    )


@pytest.mark.parametrize("size", SIZES)
def test_the_first_screen_has_all_without_scrolling_and_in_sixty_words(
    running: Running, contexts: Contexts, size: tuple[int, int]
) -> None:
    page = contexts(viewport={"width": size[0], "height": size[1]}).new_page()
    screen = Screen(page, running.url).open()
    words = page.evaluate(WORDS)
    assert 30 < len(words) <= 60, words
    assert scrolls(page) == (0, 0)
    assert box(screen.photo)["width"] >= 340
    assert box(screen.photo)["height"] == pytest.approx(box(screen.photo)["width"])
    for part in (screen.tiles.last, page.locator("#curve .plot"), screen.rows.last, page.locator("#headline p")):
        place = box(part)
        assert place["x"] + place["width"] <= size[0] + 1
        assert place["y"] + place["height"] <= size[1] + 1
    assert hides(page.locator("#headline p")) <= 0
    assert not screen.complaints


def test_a_phone_shows_pictures_rows_and_three_matches_without_scrolling(running: Running, contexts: Contexts) -> None:
    page = contexts(viewport={"width": 390, "height": 664}, has_touch=True, is_mobile=True).new_page()
    screen = Screen(page, running.url).open()
    assert scrolls(page)[0] == 0
    for part in (
        screen.photo,
        page.locator("#tile .frame"),
        screen.rows.last,
        page.locator("#rows .head span:last-child i"),
        page.locator("#curve .plot"),
        screen.tiles.nth(2),
    ):
        place = box(part)
        assert place["y"] + place["height"] <= 664
        assert place["x"] + place["width"] <= 390
    expect(page.locator("#about")).to_contain_text("Which tile shows the photo's place?")
    key = page.locator("#photo .key")
    expect(key).to_have_text(re.compile("response.*weak.*strong"))
    key.tap()
    expect(page.locator("#headline p")).to_contain_text("Exact evidence")
    expect(key).to_have_text(re.compile("evidence.*against.*for"))
    screen.rest()
    place = box(screen.photo)
    screen.photo.tap(position={"x": place["width"] / 2, "y": place["height"] / 2})
    expect(screen.rows.first).to_have_class(re.compile("on"))
    page.locator("#rows .head .term").nth(1).tap()
    expect(page.locator("#tip")).to_contain_text("share of the squared distance")
    page.locator("#strip").evaluate("one => (one.scrollLeft = 60)")
    screen.page.get_by_role("button", name="Next").click()
    expect(page).to_have_url(re.compile("query=0003"))
    page.wait_for_function("document.querySelector('#strip').scrollLeft === 0")
    page.get_by_role("button", name="Search").click()
    expect(page.get_by_role("dialog")).to_be_visible()
    assert not screen.complaints


def test_each_number_is_that_of_the_analysis_and_without_webgl_there_is_no_scene(
    running: Running, screen: Screen
) -> None:
    screen.open()
    expect(screen.page.locator("#scene")).to_be_hidden()
    expect(screen.page.locator("iframe")).to_have_count(0)
    for query in range(3):
        screen.page.locator(f'#list [data-query="{query}"]').click()
        expect(screen.page.locator(f'#list [data-query="{query}"]')).to_have_attribute("aria-current", "true")
        screen.rest()
        screen.expect_numbers(running.analysis(query=query))
    screen.key("j")
    screen.rest("15")
    screen.expect_numbers(running.analysis(query=2, angle=15.0))
    screen.key("l")
    screen.key("l")
    screen.rest("-15")
    screen.expect_numbers(running.analysis(query=2, angle=-15.0))
    screen.key("0")
    screen.rest("0")
    expect(screen.page).to_have_url(re.compile(r"query=0004$"))
    assert not screen.complaints


def test_the_photo_follows_the_hand_and_one_result_the_photo(running: Running, screen: Screen) -> None:
    screen.open("?query=0005")
    page, place = screen.page, box(screen.photo)
    middle = place["x"] + place["width"] / 2, place["y"] + place["height"] / 2
    page.mouse.move(middle[0] + 100, middle[1])
    page.mouse.down()
    for step in range(1, 31):  # a quarter turn counter-clockwise
        page.mouse.move(middle[0] + 100 - step * 100 / 30, middle[1] - step * 100 / 30)
    shown = page.locator("#photo .picture").evaluate("one => one.style.transform")
    assert shown == "rotate(-90deg) scale(1)", "at once, before any result"
    page.mouse.up()
    screen.rest("90")
    screen.expect_numbers(running.analysis(query=3, angle=90.0))
    page.mouse.wheel(0, 100)
    screen.rest("75")
    screen.expect_numbers(running.analysis(query=3, angle=75.0))
    plot = page.locator("#curve .plot")
    plot.hover(position={"x": box(plot)["width"] / 4, "y": 10})
    expect(plot.locator(".value")).to_have_text(re.compile(r"^↻ 90°: rank \d$"))
    plot.click(position={"x": 0, "y": 10})
    screen.rest("-180")
    assert not screen.complaints


def test_numbers_of_another_angle_are_faded_until_their_result_is_there(
    screen: Screen, monkeypatch: pytest.MonkeyPatch
) -> None:
    screen.open()
    may_answer, analyse = threading.Event(), WorkspaceAnalyser.analyse
    monkeypatch.setattr(WorkspaceAnalyser, "analyse", lambda *given: may_answer.wait(60) and analyse(*given))
    screen.key("j")
    expect(screen.page.locator("body")).to_have_class(re.compile("turning"))
    may_answer.set()
    screen.rest("15")


def test_a_tile_is_compared_by_a_click_and_released(running: Running, screen: Screen) -> None:
    screen.open()
    analysis = running.analysis()
    third = analysis.matches[2]
    name = analysis.task.gallery[third.index].title
    screen.tiles.nth(2).click()
    caption = screen.page.locator("#tile figcaption")
    expect(caption).to_contain_text(f"Pinned ✗ {name}".replace("✗ ", "✗"), use_inner_text=False)
    expect(screen.page.locator("#sum .total b").last).to_have_text(f"{third.distance2:.3f}")
    expect(screen.headline.locator("p")).to_contain_text(analysis.verdict.headline)
    expect(screen.page).to_have_url(re.compile(f"with={name}"))
    screen.key("Escape")
    expect(caption).to_contain_text("Answer")
    screen.expect_numbers(analysis)
    screen.tiles.nth(3).click()
    expect(caption).to_contain_text("Pinned")
    screen.tiles.nth(3).click()
    expect(caption).to_contain_text("Answer")


def test_one_ring_is_lit_wherever_it_is_drawn(screen: Screen) -> None:
    screen.open()
    screen.rows.nth(2).click()
    screen.page.mouse.move(0, 0)
    for place in ("#photo svg rect", "#tile svg rect", "#rows .row", "#strip .tile:first-child .stack i"):
        lit = screen.page.locator(f"{place}.on")
        assert {one.get_attribute("data-part") for one in lit.all()} == {"2"}, place
    screen.key("Escape")
    expect(screen.page.locator("#rows .on")).to_have_count(0)
    screen.key("3")
    expect(screen.rows.nth(2)).to_have_class(re.compile("on"))
    screen.key("3")
    expect(screen.page.locator("#rows .on")).to_have_count(0)
    screen.rows.nth(1).hover()
    expect(screen.rows.nth(1)).to_have_class(re.compile("on"))
    middle = box(screen.photo)
    screen.page.mouse.move(middle["x"] + middle["width"] / 2, middle["y"] + middle["height"] / 2)
    expect(screen.rows.nth(0)).to_have_class(re.compile("on"))


def test_a_part_is_weighed_at_the_head_of_its_row(running: Running, screen: Screen) -> None:
    screen.open()
    head = screen.page.get_by_role("slider", name="Weight of part 2")
    head.focus()
    screen.key("ArrowRight")
    expect(screen.page).to_have_url(re.compile(r"weights=1,1\.1,1,1"))
    screen.rest("0")
    screen.expect_numbers(running.analysis(weights=[1.0, 1.1, 1.0, 1.0]))
    place = box(head)
    screen.page.mouse.move(place["x"] + 5, place["y"] + 5)
    screen.page.mouse.down()
    screen.page.mouse.move(place["x"] + 5 - 66, place["y"] + 5)
    screen.page.mouse.up()
    expect(head).to_have_attribute("aria-valuenow", "0")
    screen.rest("0")
    screen.expect_numbers(running.analysis(weights=[1.0, 0.0, 1.0, 1.0]))
    screen.page.get_by_role("button", name="equal weights").click()
    expect(screen.page).not_to_have_url(re.compile("weights"))
    screen.rest("0")
    screen.expect_numbers(running.analysis())


def test_evidence_and_occlusion_take_the_place_of_activation(screen: Screen) -> None:
    screen.open()
    painted = "() => document.querySelector('#photo .heat').toDataURL()"
    differs = f"others => !others.includes(({painted})())"
    before, key = screen.page.evaluate(painted), screen.page.locator("#photo .key")
    screen.key("e")
    expect(key).to_have_text(re.compile("against.*for"))
    screen.page.wait_for_function(differs, arg=[before])
    expect(screen.page).to_have_url(re.compile("shows=evidence"))
    screen.rest()
    exact = screen.page.evaluate(painted)
    screen.key("e")
    expect(screen.page).to_have_url(re.compile("shows=occlusion"))
    expect(key).to_have_text(re.compile("against.*for"))
    screen.page.wait_for_function(differs, arg=[before, exact])
    screen.key("e")
    expect(key).to_have_text(re.compile("weak.*strong"))
    screen.page.wait_for_function(f"before => ({painted})() === before", arg=before)
    assert not screen.complaints


def test_the_missed_queries_are_listed_worst_first(running: Running, screen: Screen) -> None:
    screen.open()
    ranks = running.workspace.rankings["drone-to-satellite"].ranks + 1
    screen.key("y")
    expect(screen.page.locator("#panel")).to_be_visible()
    screen.key("m")
    marks = screen.page.locator("#list .query b")
    expect(marks).to_have_text([str(rank) for rank in sorted(ranks[ranks > 1], reverse=True)])
    expect(marks.first.locator("xpath=..")).to_have_attribute("aria-current", "true")
    expect(screen.page.locator("#panel")).to_be_hidden()
    screen.rest()
    expect(screen.headline.locator("h1")).to_contain_text(f"Missed, truth is {ranks.max()}")
    expect(screen.page.locator("#rows .head")).to_contain_text("truth")
    screen.page.keyboard.down("t")
    expect(screen.page.locator("#tile figcaption")).to_contain_text("Truth")
    screen.page.keyboard.up("t")
    expect(screen.page.locator("#tile figcaption")).to_contain_text("Answer")
    screen.key("Escape")
    expect(screen.page.locator("#list .query")).to_have_count(8)


def test_photos_and_commands_are_found_in_one_dialog(screen: Screen) -> None:
    page, sent = screen.page, list[str]()
    page.on("websocket", lambda socket: socket.on("framesent", lambda frame: sent.append(str(frame))))
    screen.open()
    screen.key("/")
    page.keyboard.type("0007")
    expect(page.locator("dialog .photos button")).to_have_count(1)
    screen.key("Enter")
    expect(page).to_have_url(re.compile("query=0007"))
    expect(page.locator("dialog")).to_be_hidden()
    expect(page.locator("#list .query")).to_have_count(8)
    screen.rest()
    page.keyboard.press("Control+k")
    expect(page.get_by_role("dialog")).to_be_visible()
    sent.clear()
    page.keyboard.type("baseline")
    screen.key("Enter")
    expect(screen.rows).to_have_count(1)
    assert sent
    assert not [frame for frame in sent if '"find"' in frame], "commands are not searched among the photos"
    expect(page.locator("#about")).to_contain_text("one part")
    page.keyboard.press("Shift+?")
    expect(page.locator("dialog .actions button", has_text="Turn left")).to_contain_text("J")
    screen.key("Escape")
    assert not screen.complaints


def test_own_photos_are_listed_and_a_file_that_cannot_be_read_is_named(running: Running, screen: Screen) -> None:
    page = screen.open().page
    queries = running.workspace.tasks["drone-to-satellite"].queries
    page.set_input_files("#file", [queries[4].path, queries[6].path])
    yours = page.locator("#yours .query")
    expect(yours).to_have_count(2)
    expect(yours.first).to_have_attribute("aria-current", "true")
    expect(screen.headline.locator("h1")).to_contain_text("Nearest of 8")
    expect(screen.headline.locator("p")).to_contain_text("No truth is known.")
    yours.last.click()
    expect(yours.last).to_have_attribute("aria-current", "true")
    screen.rest()
    total = page.locator("#sum .total b").first
    expect(total).to_have_text(f"{running.analysis(query=6).ranking.match(0).distance2:.3f}")
    page.evaluate("() => { File.prototype.slice = () => { throw new Error('gone') } }")
    page.set_input_files("#file", queries[5].path)
    expect(screen.headline.locator("h1")).to_contain_text("cannot be read; choose it again.")
    screen.key("Escape")
    expect(screen.headline.locator("h1")).to_contain_text("Nearest of 8")
    page.evaluate("() => { delete File.prototype.slice }")
    page.set_input_files("#file", queries[5].path)
    expect(yours).to_have_count(3)
    expect(total).to_have_text(f"{running.analysis(query=5).ranking.match(0).distance2:.3f}")
    screen.rest()
    expect_accessible(page)
    screen.key("n")
    screen.rest()
    expect(screen.headline.locator("h1")).to_contain_text(re.compile("Found|Missed"))


def test_a_folder_gives_the_photos_in_it(running: Running, screen: Screen, tmp_path: Path) -> None:
    page = screen.page
    page.on("filechooser", lambda _: None)  # choosers are intercepted from now on, and not only just before the key
    screen.open()
    queries = running.workspace.tasks["drone-to-satellite"].queries
    (tmp_path / "flight" / "deeper").mkdir(parents=True)
    for name, query in {"a.png": 1, "deeper/b.png": 5}.items():
        (tmp_path / "flight" / name).write_bytes(queries[query].path.read_bytes())
    (tmp_path / "flight" / "notes.txt").write_text("words")
    page.keyboard.press("Control+k")
    page.keyboard.type("folder")
    with page.expect_file_chooser() as chosen:
        screen.key("Enter")
    chosen.value.set_files(tmp_path / "flight")
    yours = page.locator("#yours .query")
    expect(yours).to_have_count(2)
    assert {one.get_attribute("title") for one in yours.all()} == {"a.png", "b.png"}
    expect(screen.headline.locator("h1")).to_contain_text("Nearest of 8")
    page.reload()
    screen.rest()
    expect(page.locator("#yours")).to_be_hidden()


@pytest.mark.parametrize("theme", ["dark", "light"])
def test_the_screen_is_accessible_in_both_themes(running: Running, contexts: Contexts, theme: str) -> None:
    page = contexts(color_scheme=theme, viewport={"width": 1440, "height": 900}).new_page()
    screen = Screen(page, running.url).open()
    expect(page.locator("html")).to_have_class(theme)
    expect_accessible(page)
    screen.key("d")
    expect(page.locator("html")).to_have_class({"dark": "light", "light": "dark"}[theme])
    page.reload()
    screen.rest()
    expect(page.locator("html")).to_have_class({"dark": "light", "light": "dark"}[theme])
    screen.key("/")
    expect_accessible(page)


@pytest.mark.slow
def test_the_scene_shows_the_place_and_the_rings_apart(running: Running, contexts: Contexts) -> None:
    screen = Screen(contexts().new_page(), running.url).open("?query=0005")
    page = screen.page
    tab = page.evaluate("document.documentElement.dataset.tab")
    expect(page.locator("#scene.ready iframe")).to_be_visible()
    session = running.app._channel.sessions[tab]

    def until_drawn(node: str) -> None:
        for _ in range(600):
            if session.scene.drawn is not None and node in session.scene.drawn.nodes:
                return
            page.wait_for_timeout(100)
        raise AssertionError(f"the scene has no {node}")

    until_drawn(f"/city/tile{running.analysis(query=3).ranking.match(0).index}")
    expect(page.frame_locator("#scene iframe").locator("canvas[data-engine]")).to_be_visible()
    screen.key("x")
    expect(page.locator("#scene [data-view=apart]")).to_have_attribute("aria-pressed", "true")
    expect(page).to_have_url(re.compile("view=apart"))
    until_drawn("/apart/ribbon/3")
    screen.key("g")
    assert box(page.locator("#scene"))["height"] > 340
    screen.key("Escape")
    assert box(page.locator("#scene"))["height"] < 340
    assert not [one for one in screen.complaints if "WebGL" not in one]


@pytest.mark.slow
def test_a_panorama_is_rolled_and_its_parts_stand_side_by_side(panorama_app: RunningApp, new_page: NewPage) -> None:
    screen = Screen(new_page(), panorama_app.url).open()
    page = screen.page
    expect(page.locator("#photo .hint")).to_have_text("drag to roll")
    expect(screen.rows).to_have_count(4)
    expect(page.locator("#about")).to_contain_text("cut into parts")
    whole, seen = box(page.locator("#photo .pan")), box(screen.photo)
    assert whole["width"] > 2 * seen["width"], "a square window shows a piece of it"
    page.mouse.move(seen["x"] + 300, seen["y"] + 200)
    page.mouse.down()
    page.mouse.move(seen["x"] + 300 - whole["width"] / 8, seen["y"] + 200)
    page.mouse.up()
    screen.rest("45")
    shift = page.locator("#photo .picture").evaluate(
        "one => parseFloat(one.style.backgroundPositionX) / one.clientWidth"
    )
    assert shift == pytest.approx(-45 / 360, abs=0.002)
    assert scrolls(page) == (0, 0)
    assert not screen.complaints
