"""The flight panel as a person uses it, and the page of a flight that goes on."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
from playwright.sync_api import Locator, Page, expect

import lpn
from explorer.app import App
from explorer.compute.ranking_job import RankingJob
from explorer.flight.live import LiveApp, LiveRecord
from explorer.server.auth import make_authenticator
from explorer.workspace import Workspace
from lpn.flight.files import Flight, Frame
from lpn.flight.live.run import LiveFix, live_answer
from lpn.flight.locate.audit import TagAudit
from lpn.flight.locate.corrections import NAME, read_corrections
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.locate.task import flight_task
from lpn.flight.maps import open_map
from tests.e2e.conftest import Contexts, NewPage, box, expect_accessible
from tests.explorer.flight.conftest import flight as flight
from tests.lpn.flight.locate.scenery import ground_to_photo
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff
from tools.fixtures.processes import free_port
from tools.fixtures.waiting import wait_until

SIZE = (96, 72)
WIDTH, HEIGHT = 60.0, 45.0
# Metres east and north of the map's middle, which is 200 m wide.
PLACES = [(x, 0.0) for x in (-60.0, -40.0, -20.0, 0.0, 20.0, 40.0)]
# The frame whose registration is refused, and its place, away from all others.
REFUSED, GUESS = 4, (20.0, 60.0)
# The photos are red, the map is not.
RED = (200, 30, 40)


@dataclass(frozen=True)
class RunningFlight:
    """A running app on a flight, and the flight's folder."""

    url: str
    folder: Path
    flight: LocatedFlight


@pytest.fixture(scope="module")
def running(model_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[RunningFlight]:
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
        frames.append(Frame(file.name, file, *SIZE, 5.0 * i, latitude, longitude, WIDTH / 2, **known))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("LPN_CACHE", str(folder / "cache"))
        model = lpn.load(model_file)
        located = locate(town, Flight("monday", tuple(frames)), model, LocateOptions(register=False, overlap=0.5))
        for i, (frame, place) in enumerate(zip(located.frames, PLACES, strict=True)):
            matrix = np.linalg.inv(ground_to_photo(place, 0.0, WIDTH, SIZE)).ravel().tolist()
            accepted = StageRecord("accepted", "Matches agree.", *place, True, 1.5, 0.0, 0.0, WIDTH, 50, matrix)
            frame.stages["registration"] = (
                StageRecord("refused", "Too few <b>details</b>.", *GUESS) if i == REFUSED else accepted
            )
        located.audit = TagAudit(5, 0.0, 0.0)
        task = flight_task(model, "a.onnx", located, folder)
        ranking = RankingJob(task)
        ranking.start()
        views = dict(task.map_sizes)
        workspace = Workspace("a.onnx", "monday", [ranking], task.contract, views, task.model, folder)
        workspace.flight = located
        app = App(workspace, "127.0.0.1", free_port())
        yield RunningFlight(f"http://127.0.0.1:{app.server.get_port()}/", folder, located)
        app.close()


class FlightPage:
    """A page with the flight panel."""

    def __init__(self, page: Page, url: str) -> None:
        self.page, self.url = page, url
        self.complaints: list[str] = []
        page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.root, self.map = page.locator(".flight"), page.locator(".flight .view")
        self.timeline = page.get_by_role("slider", name="Photo", exact=True)

    def open(self, search: str = "") -> FlightPage:
        self.page.goto(f"{self.url}?panel=flight{search}")
        expect(self.root).to_have_attribute("data-frame", re.compile(r"\d"))
        expect(self.map).to_have_attribute("data-loaded", "true")
        return self

    def expect_frame(self, frame: int) -> None:
        expect(self.root).to_have_attribute("data-frame", str(frame))
        expect(self.page).to_have_url(re.compile(rf"query=photo{frame}\.png") if frame else re.compile("panel=flight"))

    def button(self, name: str) -> Locator:
        return self.root.get_by_role("button", name=name, exact=True)

    def scale(self) -> Callable[[tuple[float, float]], tuple[float, float]]:
        """Return where metres of the map's frame lie in the page, by the tie points of a photo that lies at its place."""
        frame = int(self.root.get_attribute("data-frame") or "")
        self.button("Correct").click()
        first, third = (box(self.root.locator(f"[data-tie='{tie}']")) for tie in (0, 2))
        before = box(self.map)  # it is lower than without the line above it, and keeps its middle
        self.button("Cancel").click()
        expect(self.root.locator(".ties")).to_be_hidden()
        after = box(self.map)
        down = after["y"] - before["y"] + (after["height"] - before["height"]) / 2
        across = (third["x"] - first["x"]) / WIDTH
        left = first["x"] + first["width"] / 2 - across * (PLACES[frame][0] - WIDTH / 2)
        top = down + first["y"] + first["height"] / 2 + across * (PLACES[frame][1] + HEIGHT / 2)
        return lambda at: (left + across * at[0], top - across * at[1])

    def redness(self, at: tuple[float, float]) -> int:
        """Return the red of a pixel of the page."""
        clip = {"x": at[0] - 1, "y": at[1] - 1, "width": 3, "height": 3}
        shot = np.frombuffer(self.page.screenshot(clip=clip), np.uint8)
        return int(np.median(cv2.imdecode(shot, cv2.IMREAD_COLOR)[..., 2]))


@pytest.fixture
def panel(running: RunningFlight, new_page: NewPage) -> FlightPage:
    return FlightPage(new_page(), running.url)


def test_map_timeline_list_and_keys_choose_the_same_photo(panel: FlightPage) -> None:
    page = panel.open("&flight_tracks=tag.registration&flight_view=0,20,260").page
    at = panel.scale()
    panel.timeline.focus()
    page.keyboard.press("End")
    panel.expect_frame(5)
    page.keyboard.press("ArrowLeft")
    panel.expect_frame(REFUSED)
    expect(panel.root.locator(".lines")).to_contain_text("Too few <b>details</b>.")
    page.mouse.move(*at(GUESS))
    expect(panel.root.locator(".leaflet-tooltip")).to_have_text("photo4.png: not placed. Too few <b>details</b>.")
    expect(panel.root.locator(".view .read")).to_contain_text("m E")
    # Leaflet leaves out what the mouse does within 32 ms of the last look at what lies under it.
    page.evaluate("() => new Promise((done) => setTimeout(done, 50))")
    page.mouse.move(*at((-10.0, 40.0)))
    expect(panel.root.locator(".leaflet-tooltip")).to_have_count(0)
    page.mouse.click(*at(PLACES[2]))
    panel.expect_frame(2)
    expect(panel.root.locator(".verdict")).to_contain_text("✓ Placed by its details, ± 1.5 m on this map")
    page.keyboard.press("n")
    panel.expect_frame(3)
    line = box(panel.timeline)
    panel.timeline.click(position={"x": line["width"] - 10, "y": 30})
    panel.expect_frame(5)
    panel.root.locator(".entry", has_text="Too few <b>").click()
    panel.expect_frame(REFUSED)
    page.keyboard.down("Shift")
    page.mouse.click(*at((-80.0, 10.0)))
    page.keyboard.up("Shift")
    expect(panel.root.locator(".listed")).to_contain_text("1 of 6 photos show")
    panel.button("Clear the spot").click()
    expect(panel.root.locator(".listed")).not_to_contain_text("photos show")
    assert not panel.complaints


def test_a_photo_is_laid_where_the_map_has_it_and_the_slider_uncovers_it(panel: FlightPage) -> None:
    panel.open("&query=photo3.png")
    at = panel.scale()
    assert panel.redness(at((PLACES[3][0] + 20, 15))) < 150, "the map alone"
    panel.button("Photo").click()
    at = panel.scale()  # the photo has been brought near
    panel.button("Photo").click()
    right, left, beside = (at((PLACES[3][0] + x, 15.0)) for x in (20.0, -20.0, 40.0))
    wait_until(lambda: panel.redness(right) > 150, lambda: "the photo is not laid")
    assert panel.redness(left) < 150, "left of the slider lies the map"
    assert panel.redness(beside) < 150
    slider = panel.root.get_by_role("slider", name=re.compile("Swipe"))
    slider.fill("0")
    wait_until(lambda: panel.redness(left) > 150, lambda: "the slider uncovers nothing")
    expect(panel.page).to_have_url(re.compile("flight_over=swipe"))
    panel.page.keyboard.press("Escape")
    expect(panel.root).to_have_count(0)
    assert not panel.complaints


def test_a_place_is_corrected_by_tie_points_and_the_correction_forgotten(
    panel: FlightPage, running: RunningFlight
) -> None:
    page = panel.open("&query=photo2.png").page
    panel.button("Correct").click()
    tie = panel.root.locator("[data-tie='all']")
    before = box(tie)
    page.mouse.move(before["x"] + 11, before["y"] + 11)
    page.mouse.down()
    page.mouse.move(before["x"] + 71, before["y"] + 11, steps=4)
    page.mouse.up()
    assert box(tie)["x"] == pytest.approx(before["x"] + 60, abs=2)
    panel.button("Save").click()
    expect(panel.root.locator(".lines")).to_contain_text("✎ By hand")
    assert list(read_corrections(running.folder / NAME)) == ["photo2.png"]
    expect(panel.root.get_by_role("switch", name="By hand")).to_be_visible()
    panel.button("Correct").click()
    panel.button("Forget the saved place").click()
    expect(panel.root.locator(".lines")).not_to_contain_text("By hand")
    assert not read_corrections(running.folder / NAME)
    assert not panel.complaints


def test_switches_and_the_view_are_in_the_address(panel: FlightPage) -> None:
    page = panel.open().page
    switch = panel.root.get_by_role("switch", name="Sequence")
    expect(switch).to_have_attribute("aria-checked", "false")
    switch.click()
    expect(switch).to_have_attribute("aria-checked", "true")
    panel.root.get_by_label("Scores painted over the map").select_option("all")
    expect(panel.root.locator(".scores span")).to_contain_text("score")
    page.get_by_role("button", name="Zoom in").click()
    expect(page).to_have_url(re.compile("flight_view="))
    told = page.url
    page.reload()
    expect(panel.root).to_have_attribute("data-frame", "0")
    expect(switch).to_have_attribute("aria-checked", "true")
    expect(panel.root.locator(".scores span")).to_contain_text("score")
    assert page.url == told
    assert not panel.complaints


@pytest.mark.parametrize(("width", "theme"), [(1280, "dark"), (390, "light")])
def test_the_panel_is_accessible_and_fits(running: RunningFlight, contexts: Contexts, width: int, theme: str) -> None:
    page = contexts(viewport={"width": width, "height": 720}).new_page()
    panel = FlightPage(page, running.url).open(f"&theme={theme}&query=photo4.png")
    expect(panel.root.locator(".accuracy tr")).to_have_count(3)
    expect_accessible(page)
    place = box(panel.map)
    assert place["width"] > 0.6 * min(width, 800)
    assert place["height"] > 280
    assert page.evaluate("document.querySelector('#panel .content').scrollWidth <= innerWidth")
    if width > 760:
        foot = box(panel.timeline)
        assert foot["y"] + foot["height"] <= 720, "map and timeline are in sight at once"


def test_the_page_of_a_flight_that_goes_on_follows_the_newest_frame(flight: LocatedFlight, new_page: NewPage) -> None:
    def fix(located: LocatedFrame) -> LiveFix:
        pixels = np.full((60, 80, 3), RED, np.uint8)
        return LiveFix(located, live_answer(located), 47.0, 8.0, 1e9, 0.25, 2, None, pixels)

    record, port = LiveRecord("live", flight.basemap), free_port()
    app = LiveApp(record, "127.0.0.1", port, make_authenticator("127.0.0.1", None, False, ()))
    try:
        panel = FlightPage(new_page(), app.link)
        panel.page.goto(app.link)
        expect(panel.root.locator(".verdict")).to_contain_text("No frame has come yet")
        record.send(fix(flight.frames[0]))
        expect(panel.root.locator(".verdict")).to_contain_text("photo0.png")
        expect(panel.root.locator(".laid img")).to_be_visible()
        expect(panel.root.locator(".status")).to_have_text("Answered in 0.25 s, 2 frames dropped")
        record.send(fix(flight.frames[2]))
        expect(panel.root.locator(".verdict")).to_contain_text("<b>photo2</b>.png")
        panel.page.keyboard.press("p")
        expect(panel.root).to_have_attribute("data-frame", "0")
        expect(panel.page.get_by_role("button", name="Close")).to_have_count(0)
        assert not panel.complaints
    finally:
        app.close()
        record.forget()
