"""The flight window as a person uses it."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from msgspec.structs import replace as replace_record
from playwright.sync_api import BrowserContext, Locator, Page, Route, expect

import lpn
from explorer.app import App
from explorer.compute.ranking_job import RankingJob
from explorer.opening import open_model
from explorer.workspace import LazyWorkspace, Workspace
from lpn.drawing import theme
from lpn.flights import Flight, Frame
from lpn.locate.audit import TagAudit
from lpn.locate.camera_pose import CameraPose
from lpn.locate.corrections import read_corrections
from lpn.locate.located import StageRecord
from lpn.locate.options import LocateOptions
from lpn.locate.pipeline import locate
from lpn.locate.task import flight_task
from lpn.maps import LocalFrame, open_map
from tests.e2e.conftest import ExplorerPage, box, classic, deny_storage, expect_accessible, outlast
from tests.lpn.locate.scenery import ground_to_photo
from tests.lpn.maps.small_maps import smooth, write_geotiff
from tools.fixtures.processes import free_port

SIZE = (96, 72)
WIDTH = 60.0
# Metres east and north of the map's middle, which is 200 m wide.
PLACES = [(x, 0.0) for x in (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0)]
# The frame whose registration is refused.
REFUSED = 4
# Where its refused place lies, away from all others.
GUESS = (20.0, 60.0)
# The photos are red, the map is not.
RED = (200, 30, 40)


@dataclass(frozen=True)
class RunningFlight:
    """A running app, its workspace, the flight's folder, and the origin of the map's frame in degrees."""

    url: str
    workspace: Workspace
    folder: Path
    origin: tuple[float, float]


@pytest.fixture(scope="module")
def flight_app(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningFlight]:
    """The app on six red photos over a map; five of them are registered where they are."""
    pytest.importorskip("rasterio")
    folder = tmp_path_factory.mktemp("flight")
    ground = smooth(400, 400)
    ground[..., 0] = 60
    town = open_map(write_geotiff(folder / "town.tif", ground))
    frames = []
    for i, (latitude, longitude) in enumerate(town.frame.degrees(PLACES).tolist()):
        file = folder / f"photo{i}.png"
        cv2.imwrite(str(file), np.full((SIZE[1], SIZE[0], 3), RED[::-1], np.uint8))
        known = {"heading": 0.0, "heading_source": "gimbal", "pitch": -90.0, "roll": 0.0, "fov": 90.0}
        frames.append(Frame(file.name, file, *SIZE, 5.0 * i, latitude, longitude, WIDTH / 2, **known))  # type: ignore[arg-type]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        model = lpn.load(model_file)
        located = locate(town, Flight("monday", tuple(frames)), model, LocateOptions(register=False, overlap=0.5))
        for i, (frame, place) in enumerate(zip(located.frames, PLACES, strict=True)):
            matrix = np.linalg.inv(ground_to_photo(place, 0.0, WIDTH, SIZE)).ravel().tolist()
            accepted = StageRecord("accepted", "Matches agree.", *place, True, 1.5, 0.0, 0.0, WIDTH, 50, matrix)
            frame.stages["registration"] = StageRecord("refused", "Too few.", *GUESS) if i == REFUSED else accepted
        located.audit = TagAudit(5, 0.0, 0.0)
        task = flight_task(model, "a.onnx", located, folder)
        ranking = RankingJob(task)
        ranking.start()
        workspace = Workspace(
            "a.onnx", "monday", [ranking], task.contract, dict(task.map_sizes), task.model, None, folder
        )
        workspace.flight = located
        app = App(workspace, "127.0.0.1", free_port())
        origin = town.frame.latitude, town.frame.longitude
        yield RunningFlight(classic(f"http://127.0.0.1:{app.server.get_port()}"), workspace, folder, origin)
        app.close()


class FlightPage(ExplorerPage):
    """A page of the app with the flight window open."""

    def enter(self, app: RunningFlight) -> None:
        """Load the page, open the window, and wait for its tiles."""
        self.folder, self.origin = app.folder, app.origin
        self.open(app.url)
        self.key("w")
        expect(self.verdict_of_frame).to_have_attribute("data-frame", "0")
        expect(self.map).to_have_attribute("data-missing", "0")

    @property
    def map(self) -> Locator:
        """The map with all its layers."""
        return self.page.locator("#lpn-flight .view")

    @property
    def timeline(self) -> Locator:
        """The timeline, a slider."""
        return self.page.get_by_role("slider", name="frame")

    @property
    def verdict_of_frame(self) -> Locator:
        """The verdict on the chosen frame."""
        return self.page.locator("#lpn-flight-verdict")

    def expect_frame(self, frame: int) -> None:
        """Wait until stage and window show a frame."""
        self.expect_status("query", str(frame))
        expect(self.verdict_of_frame).to_have_attribute("data-frame", str(frame))

    def at(self, x: float, y: float) -> tuple[float, float]:
        """Where metres of the map's frame lie in the page."""
        box(self.map)  # it is laid out; map and place are read at once, as the window may still take another size
        left, top = self.page.evaluate(
            """(at) => {
              const [left, top] = lpn.flight.pixels(at);
              const map = document.querySelector("#lpn-flight .view").getBoundingClientRect();
              return [map.left + left, map.top + top];
            }""",
            [x, y],
        )
        return left, top


@pytest.fixture
def window(flight_app: RunningFlight, new_page: Callable[[], Page]) -> FlightPage:
    page = FlightPage(new_page())
    page.enter(flight_app)
    return page


def test_map_timeline_and_stage_choose_the_same_frame(window: FlightPage) -> None:
    window.timeline.focus()
    window.page.keyboard.press("End")
    window.expect_frame(5)
    window.page.keyboard.press("ArrowLeft")
    window.expect_frame(REFUSED)
    expect(window.verdict_of_frame).to_contain_text("Registration: refused. Too few.")
    window.page.mouse.move(*window.at(*GUESS))
    expect(window.page.locator("#lpn-flight .view .why")).to_have_text("photo4.png. Registration: refused. Too few.")
    line, tip = box(window.timeline), window.page.locator("#lpn-flight .time .why")
    window.page.mouse.move(line["x"] + 44 + 0.8 * (line["width"] - 56), line["y"] + line["height"] - 8)
    expect(tip).to_have_text("photo4.png. Registration: refused. Too few.")
    below = box(tip)
    assert below["y"] + below["height"] <= line["y"] + line["height"] - 8, "a long one would lie below the window"
    window.page.mouse.move(5, 5)
    expect(tip).to_be_empty()
    cross = window.page.locator("#lpn-flight .legend .term").last
    cross.scroll_into_view_if_needed()  # a scroll hides a tip
    window.page.mouse.move(5, 5)
    cross.click()
    expect(window.page.get_by_role("tooltip")).to_have_text("Registration: refused. Too few.")
    expect(window.page.locator("#lpn-flight .view .why")).to_be_empty()
    window.key("n")
    window.expect_frame(5)
    window.page.mouse.click(*window.at(*PLACES[2]))
    window.expect_frame(2)
    expect(window.verdict_of_frame).to_contain_text("Placed by its details, ± 1.5 m on this map")
    shown = box(window.timeline)
    window.timeline.click(position={"x": shown["width"] - 12, "y": 30})
    window.expect_frame(5)
    window.page.locator(".entry", has_text="Too few.").click()
    window.expect_frame(REFUSED)
    window.page.get_by_role("button", name="previous photo").click()
    window.expect_frame(REFUSED - 1)
    window.page.get_by_role("button", name="next photo").click()
    window.expect_frame(REFUSED)
    # A mark at its middle, and where the dot of an accepted answer ends.
    marks = """(at) => new Promise((done) => {
      lpn.flight.data.signs[1] = at.doubted ? null : true;
      lpn.flight.draw();
      requestAnimationFrame(() => requestAnimationFrame(() => {
        const canvas = document.querySelector("#lpn-flight .over"), ratio = canvas.width / canvas.clientWidth;
        const [left, top] = lpn.flight.pixels(at.place), pen = canvas.getContext("2d");
        const pixel = (down) => [...pen.getImageData(left * ratio, (top + down) * ratio, 1, 1).data.slice(0, 3)];
        done([pixel(0), pixel(5)]);
      }));
    })"""
    for doubted, name in ((False, "registration"), (True, "contradicted")):
        middle, below = window.page.evaluate(marks, {"doubted": doubted, "place": PLACES[1]})
        assert tuple(middle) == theme.COLOURS[name]
        assert (below[0] > 200) == doubted, "a diamond is larger, so that it differs by its shape, too"
    # A frame of a longer flight may come before that flight itself.
    window.page.evaluate(
        "lpn.flight.follow({ address: 'another', frame: { frame: 99, card: '' }, answer: null, scores: null, sequence: 99 })"
    )
    expect(window.verdict_of_frame).to_contain_text("Too few.")


@pytest.mark.slow
def test_the_view_through_a_photo_s_camera_has_a_swipe_follows_the_flight_and_ends_with_a_drag(
    flight_app: RunningFlight, new_page: Callable[[], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    workspace = flight_app.workspace
    assert workspace.flight is not None
    monkeypatch.setattr(workspace, "basemap", workspace.flight.basemap)
    for located, (x, y) in zip(workspace.flight.frames[:2], PLACES[:2], strict=True):
        pose = CameraPose(x, y, 30.0, 30.0, 0.0, -90.0, 0.0, 90.0, "told", True, 50, np.eye(6).ravel().tolist())
        answer = replace_record(located.stages["registration"], pose=pose)
        monkeypatch.setitem(located.stages, "registration", answer)
    explorer = ExplorerPage(new_page())
    explorer.open(f"{flight_app.url}?map=1&screen=all&query=photo0.png")
    through, laid = explorer.page.get_by_role("button", name="Look through"), explorer.page.locator("#lpn-stage-photo")
    expect(laid).to_have_count(0)
    through.click()
    expect(laid).to_be_visible()
    shown = box(laid)
    assert shown["width"] / shown["height"] == pytest.approx(SIZE[0] / SIZE[1], rel=0.02)
    laid.get_by_role("slider").fill("20")
    expect(laid.locator("img")).to_have_css("clip-path", "inset(0px 80% 0px 0px)")
    explorer.key("z")
    expect(laid.get_by_role("slider")).to_have_value("0")
    # On a slow machine the flight to the next camera is drawn before and after the page hears that the photo has gone.
    processor = explorer.page.context.new_cdp_session(explorer.page)
    processor.send("Emulation.setCPUThrottlingRate", {"rate": 10})
    explorer.key("n")
    explorer.expect_status("query", "1")
    explorer.page.wait_for_timeout(2000)
    expect(laid.locator("img")).to_be_attached()
    processor.send("Emulation.setCPUThrottlingRate", {"rate": 1})
    canvas = box(explorer.canvas)
    middle = canvas["x"] + canvas["width"] / 2, canvas["y"] + canvas["height"] / 2
    explorer.page.mouse.move(*middle)
    explorer.page.mouse.down()
    explorer.page.mouse.move(middle[0] + 60, middle[1] + 30, steps=4)
    explorer.page.mouse.up()
    expect(laid).to_have_count(0)
    for move in (lambda: explorer.page.mouse.wheel(0, 100), lambda: explorer.key("ArrowLeft")):
        through.click()
        expect(laid).to_be_visible()
        explorer.page.mouse.move(middle[0], middle[1] + canvas["height"] / 3)
        move()
        expect(laid).to_have_count(0)


@pytest.mark.slow
def test_the_map_is_zoomed_about_a_place_and_playing_shows_every_frame_as_one_thing(window: FlightPage) -> None:
    place = (25.0, 15.0)  # away from all frames
    where, mouse = window.at(*place), window.page.mouse

    def span() -> float:
        return window.at(20.0, 0.0)[0] - window.at(-20.0, 0.0)[0]

    def expect_span(least: float, most: float) -> None:
        def check() -> None:
            assert least <= span() / whole <= most

        window.eventually(check)
        assert window.at(*place) == pytest.approx(where, abs=2)  # the mouse has whole pixels

    whole = span()
    mouse.move(*where)
    mouse.wheel(0, -100)
    expect_span(1.2, 1.4)
    mouse.dblclick(*where)
    expect_span(2.4, 2.8)
    window.map.press("ArrowRight")
    assert window.at(*place)[0] == pytest.approx(where[0] - box(window.map)["width"] / 6, abs=2)
    window.map.press("0")
    expect_span(1, 1)
    window.page.locator("[data-act=in]").dblclick()  # two presses of the button, and no double click on the map
    assert span() / whole == pytest.approx(1.5**2)
    expect(window.verdict_of_frame).to_have_attribute("data-frame", "0")
    window.page.evaluate(
        """() => {
          window.seen = [];
          new MutationObserver(() => {
            const flight = document.getElementById("lpn-flight"), find = (what) => flight.querySelector(what);
            const shown = [
              Number(find(".verdict").dataset.frame) + 1, parseInt(find(".facts .dim").textContent),
              parseInt(find(".now").textContent), Number(find(".time canvas").getAttribute("aria-valuenow")),
            ];
            requestAnimationFrame(() => requestAnimationFrame(() => window.seen.push([...new Set(shown)])));
          }).observe(document.querySelector("#lpn-flight .now"), { childList: true, subtree: true });
        }"""
    )
    window.page.get_by_label("frames a second").select_option("10")
    window.timeline.focus()
    window.page.keyboard.press("Space")
    window.expect_frame(5)
    expect(window.page.locator("[data-act=play]")).to_have_text("▶")
    window.settle()  # the last frame is noted two frames of the screen later
    seen = window.page.evaluate("window.seen")
    assert all(len(frames) == 1 for frames in seen), "card, facts, counter, and timeline show one frame"
    assert list(dict.fromkeys(frames[0] for frames in seen)) in ([1, 2, 3, 4, 5, 6], [2, 3, 4, 5, 6])


@pytest.mark.slow
def test_axe_finds_nothing_serious_in_the_flight_window_and_a_spot_lists_the_frames_that_show_it(
    window: FlightPage,
) -> None:
    expect(window.page.locator(".entry").first).to_be_visible()
    expect_accessible(window.page)
    window.page.keyboard.down("Shift")
    window.page.mouse.click(*window.at(25.0, 15.0))
    window.page.keyboard.up("Shift")
    listed = window.page.locator("#lpn-flight .listed")
    # Pictures are 60 m wide, and 45 m high.
    expect(listed).to_contain_text("3 of 6 photos show")
    expect(listed.locator(".entry")).to_have_count(3)
    assert [one.get_attribute("data-frame") for one in listed.locator(".entry").all()] == ["3", "4", "5"]


@pytest.mark.slow
def test_pictures_that_the_server_is_too_busy_for_are_asked_for_again(
    flight_app: RunningFlight, new_page: Callable[[], Page]
) -> None:
    window, asked = FlightPage(new_page()), list[str]()

    def busy_at_first(route: Route) -> None:
        asked.append(route.request.url)
        route.fulfill(status=503) if asked.count(asked[-1]) == 1 else route.continue_()

    window.page.route("**/pictures/**", busy_at_first)
    window.enter(flight_app)

    def shown() -> None:
        sizes = window.page.locator("#lpn-flight figure img").evaluate_all("all => all.map((one) => one.naturalWidth)")
        assert len(sizes) == 2
        assert min(sizes) > 0

    window.eventually(shown)

    def each_again() -> None:
        assert {asked.count(url) for url in asked} == {2}

    window.eventually(each_again)  # others than those of the card may come later


@pytest.mark.slow
def test_a_frame_is_shown_when_all_of_its_pictures_are_there(window: FlightPage) -> None:
    held: list[Route] = []
    outlast(window.page, 5000)  # after which a frame is shown without its pictures
    window.page.route(re.compile(r"/pictures/.*/(pair|photo)/1$"), lambda route: held.append(route))
    window.page.get_by_role("button", name="Swipe").click()
    window.page.evaluate(
        """() => {
          window.early = [];
          new MutationObserver(() => {
            const card = document.querySelector("#lpn-flight .about"), frame = card.querySelector(".verdict").dataset.frame;
            const pictures = [...card.querySelectorAll("img"), document.querySelector("#lpn-flight .laid img")];
            if (frame === "1" && !pictures.every((one) => one.complete && one.naturalWidth)) window.early.push(frame);
          }).observe(document.querySelector("#lpn-flight .about"), { childList: true });
        }"""
    )
    window.timeline.focus()
    window.page.keyboard.press("ArrowRight")

    def expect_held() -> None:
        assert len(held) == 2

    window.eventually(expect_held)
    window.page.wait_for_timeout(700)
    expect(window.verdict_of_frame).to_have_attribute("data-frame", "0")
    expect(window.page.locator("#lpn-flight .now")).to_contain_text("is coming")
    for route in held:
        route.continue_()
    window.expect_frame(1)
    assert window.page.evaluate("window.early") == []
    assert "/photo/1" in window.page.locator("#lpn-flight .laid img").get_attribute("src")


@pytest.mark.slow
def test_a_registered_photo_is_swiped_over_its_place_and_scores_are_painted_over_the_map(
    window: FlightPage, flight_app: RunningFlight
) -> None:
    def red(x: float, y: float) -> bool:
        """Return whether the page is as red as the photos at a place of the map."""
        left, top = window.at(x, y)
        shot = window.page.screenshot(clip={"x": left - 2, "y": top - 2, "width": 4, "height": 4})
        blue, green, strength = cv2.imdecode(np.frombuffer(shot, np.uint8), cv2.IMREAD_COLOR).mean(axis=(0, 1))
        return bool(strength > 150 and green < 80 and blue < 90)

    def check(*expected: bool) -> Callable[[], None]:
        """Return a check of five spots: inside at the left and right, and outside beyond left, right, and top."""
        spots = [(-45.0, -12.0), (5.0, -12.0), (-54.0, -12.0), (14.0, -12.0), (-20.0, 27.0)]

        def look() -> None:
            assert [red(*spot) for spot in spots] == list(expected)

        return look

    window.page.mouse.click(*window.at(*PLACES[2]))
    window.expect_frame(2)
    window.eventually(check(False, False, False, False, False))
    window.page.locator("[data-photo=swipe]").click()
    slider = window.page.get_by_label("swipe")
    window.eventually(check(False, True, False, False, False))  # it opens in the photo's middle
    slider.fill("0")
    window.eventually(check(True, True, False, False, False))
    # A link has Swipe and the view.
    window.page.keyboard.press("+")
    link = window.page.evaluate("lpn.flight.link()")
    linked = window.page.context.new_page()
    linked.goto(f"{flight_app.url}/?flight=1&query=photo2.png&words=expert{link}")
    expect(linked.get_by_label("swipe")).to_have_value("0")
    expect(linked.locator("[data-photo=swipe]")).to_have_attribute("aria-pressed", "true")
    linked.wait_for_function("link => lpn.flight.link() === link", arg=link)
    window.page.context.grant_permissions(["clipboard-read", "clipboard-write"])
    window.page.evaluate("lpn.copy()")
    expect(window.page.locator("#lpn-notice")).to_have_text(
        "Link copied: it opens this photo, and the map, the methods, and the lists as you see them, with Swipe, on this computer "
        "only, as its address is 127.0.0.1."
    )
    assert link in window.page.evaluate("navigator.clipboard.readText()")
    assert "look=" not in linked.evaluate("location.search")
    linked.close()
    window.page.locator("[data-act=fit]").click()
    left = window.at(-20.0, 0.0)[0] - box(slider)["x"]
    slider.fill(str(round(100 * left / box(slider)["width"])))
    window.eventually(check(False, True, False, False, False))
    window.page.locator("[data-photo=off]").click()
    window.eventually(check(False, False, False, False, False))
    for track in window.page.locator("#lpn-flight [data-track]").all():
        track.click()
    plain = window.at_rest(window.map)
    scores = window.page.locator("#lpn-flight .scores")
    expect(scores).to_be_hidden()
    window.page.locator("[data-part=all]").click()
    expect(scores).to_contain_text("score")
    whole = window.at_rest(window.map, lambda picture: (np.abs(picture - plain).max(axis=2) > 20).mean() > 0.3)
    window.page.locator('#lpn-flight [data-part="0"]').click()
    expect(scores).to_contain_text("cosine of 1 centre")
    window.at_rest(window.map, lambda picture: (np.abs(picture - whole).max(axis=2) > 8).mean() > 0.05)
    window.page.locator("[data-part=off]").click()
    expect(scores).to_be_hidden()


@pytest.mark.slow
def test_a_link_has_the_methods_the_plot_and_the_list_and_says_what_of_it_is_damaged(
    window: FlightPage, flight_app: RunningFlight
) -> None:
    page = window.page
    for name in ("tag", "retrieval"):
        page.locator(f"[data-track={name}]").click()
    for choice in ("[data-plot=radius]", "[data-list=worst]"):
        page.locator(choice).click()
    window.expect_frame(0)
    link = page.evaluate("lpn.flight.link()")
    assert link.endswith(",sequence.registration,radius,worst")

    def opened(look: str) -> Page:
        other = page.context.new_page()
        other.goto(f"{flight_app.url}/?flight=1&query=photo2.png&words=expert{look}")
        expect(other.locator("#lpn-flight-verdict")).to_have_attribute("data-frame", "2")
        return other

    def expect_choices(other: Page, tracks: list[str], plot: str, named: str) -> None:
        expect(other.locator(f"[data-plot={plot}]")).to_have_attribute("aria-pressed", "true")
        expect(other.locator(f"[data-list={named}]")).to_have_attribute("aria-pressed", "true")
        switched = other.locator("[data-track][aria-checked=true]").evaluate_all(
            "all => all.map((a) => a.dataset.track)"
        )
        assert switched == tracks

    other = opened(link)
    expect_choices(other, ["sequence", "registration"], "radius", "worst")
    expect(other.locator(".listed .entry")).to_have_count(6)
    other.close()
    # Each damaged value is told, and the others are shown; a link of an older version has the view alone.
    notice = "#lpn-notice"
    other = opened("&look=swipe,50,1.0,2.0,100.0,tag.nothing,constructor,audit")
    expect_choices(other, ["tag", "retrieval", "sequence", "registration"], "error", "audit")
    expect(other.locator("[data-photo=swipe]")).to_have_attribute("aria-pressed", "true")
    expect(other.locator(notice)).to_have_text(
        "Not all of the link can be shown. look=swipe,50,1.0,2.0,100.0,tag.nothing,constructor,audit: expected methods such as "
        "tag.retrieval.sequence.registration; then a plot among error, radius, height, all. Take the link from the flight again."
    )
    # No notice lies over the controls and the timeline.
    assert (
        box(other.locator(notice))["y"] + box(other.locator(notice))["height"]
        <= box(other.locator(".flight .time"))["y"]
    )
    other.close()
    other = opened("&look=swipe,50,x,2.0,0")
    expect(other.locator(notice)).to_contain_text("expected off, swipe, or blink with four numbers. Take the link")
    expect(other.locator("[data-photo=off]")).to_have_attribute("aria-pressed", "true")
    other.close()
    other = opened("&look=off,50,1.0,2.0,100.0,,error,spot,25.0,15.0")
    expect_choices(other, [], "error", "spot")
    expect(other.locator(".listed")).to_contain_text("3 of 6 photos show")
    assert other.evaluate("lpn.flight.link()").endswith(",,error,spot,25.0,15.0")
    assert not other.locator(notice).is_visible() or "Not all" not in other.locator(notice).inner_text()
    other.close()


@pytest.mark.slow
def test_a_link_that_is_taken_while_the_next_photo_is_coming_is_of_that_photo(window: FlightPage) -> None:
    window.expect_frame(0)
    copied = window.page.evaluate(
        """async () => {
          const texts = [];
          navigator.clipboard.writeText = async (text) => void texts.push(text);
          lpn.send = () => {}; // the server is slow
          lpn.flight.choose(3);
          await lpn.copy();
          return texts;
        }"""
    )
    assert len(copied) == 1
    assert "query=~3" in copied[0].replace("%7E", "~")


@pytest.mark.slow
def test_a_method_that_is_switched_on_has_a_tick_and_a_card_in_other_words_its_own_folding(window: FlightPage) -> None:
    page, track = window.page, window.page.locator("[data-track=tag]")

    def tick() -> str:
        text: str = track.evaluate("one => getComputedStyle(one.querySelector('.check'), '::before').content")
        return text

    assert track.get_attribute("aria-checked") == "true"
    assert tick() == '"✓"'
    track.click()
    expect(track).to_have_attribute("aria-checked", "false")
    assert tick() == "none"
    tall = page.locator("#lpn-flight-tall")
    expect(tall).to_have_text("⤡ Smaller")
    tall.click()
    expect(tall).to_have_text("⤢ Larger")
    card = """([words, open, card]) => {
      const details = `<details data-words="${words}"${open ? " open" : ""}><summary>More of it</summary>${card}</details>`;
      const frame = { ...lpn.flight.followed, card: details };
      lpn.flight.follow({ address: lpn.flight.of, frame, answer: null, scores: null, sequence: 0 });
      return document.querySelector("#lpn-flight .about details").open;
    }"""
    assert page.evaluate(card, ["expert", True, 1])
    assert not page.evaluate(card, ["plain", False, 2]), "in plain words it is folded at first"
    assert not page.evaluate(card, ["plain", True, 3]), "and stays so from photo to photo"
    assert page.evaluate(card, ["expert", True, 4])


@pytest.mark.slow
def test_a_flight_without_heights_has_no_plot_of_them(window: FlightPage) -> None:
    page, plot = window.page, window.page.locator("[data-plot=height]")
    expect(plot).to_be_visible()
    page.evaluate("() => lpn.flight.show({ ...lpn.flight.data, heights: lpn.flight.data.heights.map(() => null) })")
    expect(plot).to_be_hidden()
    page.locator("[data-plot=all]").click()
    window.expect_frame(0)


@pytest.mark.slow
def test_a_photo_is_dragged_to_its_place_and_the_correction_is_kept_beside_the_flight(window: FlightPage) -> None:
    page = window.page
    whole, corner = page.locator('[data-tie="all"]'), page.locator('[data-tie="1"]')

    def correct() -> None:
        expect(whole).to_be_hidden()  # a saved correction ends the mode
        page.locator("[data-photo=correct]").click()
        expect(whole).to_be_visible()
        window.settle()  # the map is resized

    correct()

    def lies_at_its_place() -> None:
        shown = box(whole)
        assert shown["x"] + shown["width"] / 2 == pytest.approx(window.at(*PLACES[0])[0], abs=2)

    window.eventually(lies_at_its_place)
    start, end = window.at(*PLACES[0]), window.at(PLACES[0][0] + 12, PLACES[0][1] - 8)
    page.mouse.move(*start)
    page.mouse.down()
    page.mouse.move(*end, steps=4)
    page.mouse.up()
    page.locator("[data-act=save]").click()
    expect(page.locator("#lpn-flight-corrected")).to_contain_text("14.4 m from it")
    expect(page.locator("#lpn-flight .legend")).to_contain_text("By hand1 of 6")
    expect(page.locator("#lpn-flight .status")).to_contain_text("Saved in corrections.csv")
    file = window.folder / "corrections.csv"
    town = LocalFrame(*window.origin)
    kept = read_corrections(file)["photo0.png"]
    np.testing.assert_allclose(town.xy(*kept.middle[:, None])[0], (-48.0, -8.0), atol=0.8)
    # A corner alone is moved by arrows: it bends the photo.
    before = town.xy(*kept.corners.T)
    correct()
    corner.focus()
    for _ in range(3):
        page.keyboard.press("Shift+ArrowUp")
    page.locator("[data-act=save]").click()

    def bent() -> None:
        after = town.xy(*read_corrections(file)["photo0.png"].corners.T)
        moved = after - before
        assert moved[1, 1] > 4
        assert np.abs(moved[[0, 2, 3]]).max() < 0.1

    window.eventually(bent)
    correct()
    page.locator("[data-act=forget]").click()
    expect(page.locator("#lpn-flight-corrected")).to_have_count(0)
    assert read_corrections(file) == {}
    correct()
    # A photo that is turned over is refused; its tie points stay where they are when the frame's card changes.
    left, right = box(page.locator('[data-tie="0"]')), box(corner)
    page.mouse.move(right["x"] + 10, right["y"] + 10)
    page.mouse.down()
    page.mouse.move(left["x"] - 60, left["y"] + 10, steps=4)
    page.mouse.up()
    folded = box(corner)["x"]
    page.locator("[data-act=save]").click()
    expect(page.locator("#lpn-flight .status")).to_contain_text("Not saved. The tie points turn the photo over")
    page.evaluate(
        "() => lpn.flight.follow({ address: lpn.flight.of, frame: { ...lpn.flight.followed, card: 'another' }, "
        "answer: null, scores: null, sequence: 0 })"
    )
    expect(page.locator("#lpn-flight .about")).to_have_text("another")
    assert box(corner)["x"] == pytest.approx(folded, abs=2)
    assert read_corrections(file) == {}


@pytest.mark.slow
def test_tie_points_that_are_not_saved_outlast_another_photo_the_window_and_the_page(window: FlightPage) -> None:
    page = window.page
    corner, correct = page.locator('[data-tie="1"]'), page.locator("[data-photo=correct]")
    unsaved, told = (
        page.locator("#lpn-flight .how .unsaved"),
        page.get_by_text("The tie points are kept, and not saved"),
    )

    def place() -> list[float]:
        expect(corner).to_be_visible()
        window.settle()
        left, top = (float(corner.evaluate(f"(one) => parseFloat(one.style.{side})")) for side in ("left", "top"))
        # Metres, as the map may be seen from elsewhere.
        found: list[float] = page.evaluate(
            """([left, top]) => {
              const { x, y, scale } = lpn.flight.map.view(), [width, height] = lpn.flight.map.size();
              return [x + (left - width / 2) / scale, y - (top - height / 2) / scale];
            }""",
            [left, top],
        )
        return found

    def put_away(leave: Callable[[], None]) -> None:
        leave()
        expect(told.last).to_be_visible()
        expect(correct).to_have_class(re.compile("unsaved"))

    correct.click()
    start = place()
    expect(unsaved).to_be_hidden()
    corner.focus()
    page.keyboard.press("Shift+ArrowUp")
    expect(unsaved).to_be_visible()
    moved = place()
    assert moved[1] > start[1] + 1

    def close() -> None:
        page.get_by_label("Close the flight").click()
        expect(page.locator("#lpn-flight")).to_be_hidden()
        window.key("w")

    put_away(close)
    correct.click()
    assert place() == pytest.approx(moved, abs=0.1)
    window.key("n")
    window.expect_frame(1)
    expect(correct).not_to_have_class(re.compile("unsaved"))
    page.locator("[data-photo=off]").click()
    window.key("p")
    window.expect_frame(0)
    page.reload()
    window.expect_frame(0)
    expect(correct).to_have_class(re.compile("unsaved"))
    correct.click()
    assert place() == pytest.approx(moved, abs=0.1)
    page.locator("[data-act=cancel]").click()
    expect(correct).not_to_have_class(re.compile("unsaved"))
    correct.click()
    assert place() == pytest.approx(start, abs=0.1)
    corner.focus()
    page.keyboard.press("Shift+ArrowUp")
    page.locator("[data-act=save]").click()
    expect(corner).to_be_hidden()
    expect(correct).not_to_have_class(re.compile("unsaved"))
    # The saved place is forgotten, and the tie points that are not saved are not.
    correct.click()
    corner.focus()
    page.keyboard.press("Shift+ArrowUp")
    page.keyboard.press("Shift+ArrowUp")
    moved = place()
    page.locator("[data-act=forget]").click()
    expect(page.locator("#lpn-flight-corrected")).to_have_count(0)
    expect(corner).to_be_hidden()
    expect(correct).to_have_class(re.compile("unsaved"))
    correct.click()
    assert place() == pytest.approx(moved, abs=0.1)
    page.locator("[data-act=cancel]").click()


@pytest.mark.slow
def test_tie_points_that_are_not_saved_outlast_another_photo_where_storage_is_denied(window: FlightPage) -> None:
    page = window.page
    deny_storage(page)
    corner, correct = page.locator('[data-tie="1"]'), page.locator("[data-photo=correct]")
    correct.click()
    corner.focus()
    page.keyboard.press("Shift+ArrowUp")
    expect(correct).to_have_class(re.compile("unsaved"))
    window.key("n")
    window.expect_frame(1)
    expect(correct).not_to_have_class(re.compile("unsaved"))
    window.key("p")
    window.expect_frame(0)
    expect(correct).to_have_class(re.compile("unsaved"))
    page.locator("[data-act=cancel]").click()
    expect(correct).not_to_have_class(re.compile("unsaved"))


@pytest.mark.slow
def test_the_chip_of_a_flight_opens_its_window_as_large_as_the_stage(
    flight_app: RunningFlight, data: Path, model_file: Path, contexts: Callable[..., BrowserContext]
) -> None:
    workspace = flight_app.workspace
    before = workspace.key, workspace.choices
    others = {"flight": LazyWorkspace("a flight over its map", lambda: workspace)}
    app = App(open_model(data, model_file), "127.0.0.1", free_port(), None, "pairs", others)
    explorer = ExplorerPage(contexts(viewport={"width": 1024, "height": 600}).new_page())
    try:
        explorer.open(classic(f"http://127.0.0.1:{app.server.get_port()}"))
        explorer.page.locator("#lpn-workspaces a", has_text="a flight over its map").click()
        flight = explorer.page.locator("#lpn-flight")
        expect(flight).to_be_visible()

        def inside() -> None:
            window, stage = box(flight), box(explorer.canvas)
            assert window["x"] + window["width"] <= stage["x"] + stage["width"]
            assert window["y"] + window["height"] <= stage["y"] + stage["height"]

        explorer.eventually(inside)
    finally:
        app.close()
        workspace.key, workspace.choices = before


@pytest.mark.slow
def test_a_phone_has_the_map_the_timeline_and_the_legend_first_and_a_tip_leaves_the_zoom_free(
    flight_app: RunningFlight, contexts: Callable[..., BrowserContext]
) -> None:
    page = contexts(viewport={"width": 390, "height": 844}, has_touch=True, is_mobile=True).new_page()
    page.goto(f"{flight_app.url}/?flight=1&words=plain")
    view, tip = page.locator("#lpn-flight .view"), page.locator("#lpn-flight .view .why")
    expect(view).to_have_attribute("data-missing", "0")

    def in_order() -> None:
        tops = [
            box(page.locator(one))["y"] for one in ("#lpn-flight .view", "#lpn-flight .time", "#lpn-flight .legend")
        ]
        assert tops == sorted(tops)
        assert tops[-1] < box(page.locator("#lpn-header"))["y"], "the panels of the workbench come after the window"

    ExplorerPage(page).eventually(in_order)
    legend = page.locator("#lpn-flight .legend")
    checked = {
        one.get_attribute("data-track"): one.get_attribute("aria-checked")
        for one in legend.locator("[data-track]").all()
    }
    assert checked == {"tag": "true", "retrieval": "false", "sequence": "false", "registration": "true"}
    expect(legend).to_contain_text("Thin dashed line: the GPS tags.")
    expect(legend).to_contain_text(
        "Circle around its place: if errors are as estimated, the true place of 99 of 100 photos lies"
    )
    assert legend.locator("p:not(.marks) .key").all_inner_texts() == [
        "placed",
        "in doubt",
        "by its neighbours only, a guess, or not placed",
    ]
    page.evaluate(
        "document.querySelector('#lpn-flight .legend').style.width = '300px'"
    )  # beside a map and a scroll bar
    assert legend.evaluate("(legend) => legend.scrollWidth <= legend.clientWidth")
    page.evaluate("document.querySelector('#lpn-flight .legend').style.width = ''")
    view.scroll_into_view_if_needed()
    page.evaluate("([x, y]) => lpn.flight.map.show([x - 30, y], 100)", list(GUESS))  # the dot lies beside the buttons
    left, top = page.evaluate("(at) => lpn.flight.pixels(at)", list(GUESS))
    view.tap(position={"x": left, "y": top})
    expect(tip).to_contain_text("photo4.png. By its details: refused. Too few.")
    assert box(tip)["x"] + box(tip)["width"] <= box(page.locator("#lpn-flight .zoom"))["x"]
    position = page.locator("#lpn-flight .view .read")
    expect(position).to_be_empty()
    view.dispatch_event("pointermove", {"pointerType": "touch", "pointerId": 7, "clientX": 100, "clientY": 200})
    expect(position).to_contain_text(" m N")
    view.dispatch_event("pointercancel", {"pointerType": "touch", "pointerId": 7})
    expect(position).to_be_empty()
    line, told = page.locator("#lpn-flight .time canvas"), page.locator("#lpn-flight .time .why")
    for leave in (
        lambda: page.locator("#lpn-flight [data-act=next]").tap(),
        lambda: page.locator("#lpn-flight .sentence").first.tap(),
    ):
        line.tap(position={"x": 44 + 0.8 * (box(line)["width"] - 56), "y": 40})  # not on its mark
        expect(told).to_contain_text("photo4.png. By its details: refused. Too few.")
        assert box(told)["y"] >= box(line)["y"] + box(line)["height"], "the buttons above the timeline stay free"
        leave()
        expect(told).to_be_empty()
    # The place of a photo that is chosen by a tap comes into sight.
    for low in (844, 500):
        page.set_viewport_size({"width": 390, "height": low})
        line.evaluate("(line) => line.scrollIntoView({ block: 'start' })")
        expect(view).not_to_be_in_viewport(ratio=0.5)
        line.tap(position={"x": 44, "y": 40})
        expect(view).to_be_in_viewport(ratio=0.9)


# The share of the map's width or height that the flight takes, whatever the map's size; null while that changes.
SHARE = """() => {
  const { map, data } = lpn.flight;
  if (!map.view()) return null;
  const points = Object.entries(data.tracks).filter(([name]) => name !== "retrieval").flatMap(([, { x, y, state }]) =>
    x.map((_, i) => map.toPixels([x[i], y[i]])).filter((_, i) => x[i] !== null && state[i] < 2));
  const shares = map.size().map((side, axis) => {
    const [low, high] = lpn.flight.range(points.map((point) => point[axis]));
    return (high - low) / side;
  });
  return Math.max(...shares);
}"""


@pytest.mark.slow
def test_the_window_opens_again_with_the_whole_flight_and_a_new_flight_waits_for_no_picture(
    flight_app: RunningFlight, new_page: Callable[[], Page]
) -> None:
    page = new_page()
    page.goto(f"{flight_app.url}/?flight=1&words=plain")
    swipe = page.locator("[data-photo=swipe]")
    expect(page.locator("#lpn-flight .view")).to_have_attribute("data-missing", "0")

    def expect_share(holds: Callable[[float], bool]) -> None:
        ExplorerPage(page).eventually(lambda: check((share := page.evaluate(SHARE)) is not None and holds(share)))

    expect_share(whole := lambda share: share == pytest.approx(0.72, abs=0.01))
    for close in (page.get_by_label("Close the flight").click, lambda: page.keyboard.press("w")):
        swipe.click()
        expect(swipe).to_have_attribute("aria-pressed", "true")
        expect_share(lambda share: share > 1)
        close()
        expect(page.locator("#lpn-flight")).to_be_hidden()
        page.keyboard.press("w")
        expect(page.locator("[data-photo=off]")).to_have_attribute("aria-pressed", "true")
        expect_share(whole)
    # A person's own picture lies over its map each time.
    laid = """() => {
      const frame = { ...lpn.flight.followed, homography: [1, 0, 0, 0, 1, 0, 0, 0, 1], own: { key: "mine" } };
      lpn.flight.followed = frame;
      lpn.flight.photo.use("blink");
      lpn.flight.leave();
      lpn.flight.followed = { ...frame, own: null };
      return lpn.flight.photo.mode;
    }"""
    assert page.evaluate(laid) == "swipe"
    # A picture that never comes keeps back the next photo of a flight for a while, and no photo of another flight.
    page.route("**/never", lambda _: None)
    arrived = """(address) => {
      const frame = { ...lpn.flight.followed, card: '<b class="new">new</b><img src="never">' };
      if (address) lpn.flight.show({ ...lpn.flight.data, address });
      lpn.flight.follow({ address: address || lpn.flight.of, frame, answer: null, scores: null, sequence: 0 });
      return !!document.querySelector("#lpn-flight .about .new");
    }"""
    assert not page.evaluate(arrived, "")
    assert page.evaluate(arrived, "another")


def check(holds: bool) -> None:
    assert holds
