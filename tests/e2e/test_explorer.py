"""Tests of a person's actions in the app, and of the page after each."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
from playwright.sync_api import BrowserContext, FloatRect, Page, expect

import lpn
from explorer.layout import layout_for
from lpn import datasets, descriptors, retrieval
from lpn.core import images
from lpn.core.demo import DEMO_QUERY
from lpn.datasets import geo
from lpn.descriptors.transforms import Change
from lpn.retrieval import Ranking, scoring
from lpn.tasks.opening import scored_tasks, shipped_calibration
from tests.e2e.conftest import ExplorerPage, RunningApp, box, difference
from tools.fixtures import small_worlds

READ_ROWS = """rows => rows.map(row => ({
  index: row.dataset.index,
  text: row.innerText,
  widths: [...row.querySelectorAll(".shares rect:not(.track)")].map(bar => parseFloat(bar.getAttribute("width"))),
}))"""


def expected(app: RunningApp, name: str, angle: float = 0.0, weights: tuple[float, ...] = (1, 1, 1, 1)) -> Ranking:
    """The ranking of a drone query, computed without the app."""
    model, dataset = lpn.load(app.model), datasets.open_dataset(app.data)
    query = next(entry for entry in dataset.queries("drone") if entry.name == name)
    gallery = dataset.gallery("satellite")
    tiles = descriptors.shipped_or_cached(model, gallery, "satellite", dataset.root, "gallery").descriptors
    described = retrieval.describe_picture(model, images.load_picture(query.path), "drone", angle)
    cosines = scoring.part_cosines(described.descriptor, tiles)
    labels = np.array([entry.label for entry in gallery])
    return retrieval.rank(cosines, scoring.part_weights(4, weights), labels, query.label)


def expected_calibrated(app: RunningApp, name: str) -> Ranking:
    """The ranking of a drone query by the shipped calibration."""
    model, dataset = lpn.load(app.model), datasets.open_dataset(app.data)
    calibration = shipped_calibration(model, dataset)
    assert calibration is not None
    task = scored_tasks(model, "", dataset, calibration, ["drone-to-satellite"])[0]
    query = task.query_names.index(name)
    assert task.model is not None
    zoom = Change().for_picture(task.queries[query], task.queries[query].zoom)
    described = retrieval.describe_picture(task.model, images.load_picture(task.queries[query].path), "drone", zoom)
    return task.start_search(query, described.descriptor)(scoring.part_weights(4))


def assert_shows(explorer: ExplorerPage, app: RunningApp, ranking: Ranking) -> None:
    """Wait until the rows are the expected tiles, in order, with sign, distance, and bars that add up to it."""
    names = [entry.name for entry in datasets.open_dataset(app.data).gallery("satellite")]
    matches, truth = ranking.top(10), ranking.positive()
    if truth is not None and truth.rank > 10:
        matches.append(truth)
    full = max(match.distance2 for match in matches)

    def check() -> None:
        rows = explorer.rows.evaluate_all(READ_ROWS)
        assert len(rows) == len(matches)
        for row, match in zip(rows, matches, strict=True):
            assert row["index"] == str(match.index)
            assert names[match.index] in row["text"]
            assert ("✓" if match.true else "✗") in row["text"]
            shown = float(re.search(r"\d\.\d{3}", row["text"])[0])  # type: ignore[index]
            assert shown == pytest.approx(match.distance2, abs=1.1e-3)
            assert sum(row["widths"]) == pytest.approx(100 * match.distance2 / full, abs=0.1)

    explorer.eventually(check)


def test_page_says_what_is_shown_and_compares_a_match_chosen_by_its_row_or_its_tile(
    explorer: ExplorerPage, app: RunningApp
) -> None:
    header = explorer.page.locator("#lpn-header")
    for text in ("model.onnx", "places", "n = 4", "drone → satellite", "14 queries", "14 tiles", "R@1"):
        expect(header).to_contain_text(text)
    expect(explorer.status).to_have_text("")
    expect(explorer.page.get_by_role("button", name="All pictures in a table")).to_be_visible()
    # There is no second model.
    expect(explorer.page.get_by_role("button", name="Compare with the baseline")).to_have_count(0)
    before = explorer.stage(lambda picture: len(np.unique(picture.reshape(-1, 3), axis=0)) > 2000)
    ranking = expected(app, "0007")
    assert_shows(explorer, app, ranking)
    match = ranking.match(2)
    explorer.rows.nth(2).click()
    explorer.expect_status("chosen", str(match.index))
    expect(explorer.rows.nth(2)).to_have_class(re.compile("chosen"))
    parts = explorer.page.locator("#lpn-parts")
    expect(parts).to_contain_text("rank 3")
    expect(parts).to_contain_text(f"{match.distance2:.3f}")
    explorer.stage(lambda picture: difference(before, picture) > 0.02)
    stage = box(explorer.canvas)
    layout = layout_for((256, 256), 4, (round(stage["width"]), round(stage["height"])))
    x, y = (side * layout.unit for side in layout.card_centre(3))
    explorer.page.mouse.click(stage["x"] + stage["width"] / 2 + x, stage["y"] + stage["height"] / 2 - y)
    explorer.expect_status("chosen", str(ranking.match(3).index))


def test_query_is_chosen_by_name_thumbnail_and_key(explorer: ExplorerPage, app: RunningApp) -> None:
    before = explorer.stage()
    explorer.fill("Find name", "0011")
    explorer.expect_status("name", "0011")
    assert_shows(explorer, app, expected(app, "0011"))
    explorer.stage(lambda picture: difference(before, picture) > 0.05)
    explorer.fill("Find name", "")
    explorer.page.locator(".thumb[data-query='2']").click()
    explorer.expect_status("name", "0009")
    explorer.key("n")
    explorer.expect_status("name", "0010")
    explorer.page.get_by_role("button", name="‹ Previous").click()
    explorer.expect_status("name", "0009")


@pytest.mark.slow
def test_rotation_by_field_key_handle_and_slider_changes_picture_and_ranking(
    explorer: ExplorerPage, app: RunningApp
) -> None:
    before = explorer.stage()
    explorer.fill("Rotate", "90")
    explorer.expect_status("angle", "90")
    assert_shows(explorer, app, expected(app, "0007", 90))
    explorer.stage(lambda picture: difference(before, picture) > 0.02)
    explorer.key("j")
    explorer.expect_status("angle", "95")
    expect(explorer.field("Rotate")).to_have_value("95")
    explorer.key("k")
    explorer.expect_status("angle", "0")
    assert_shows(explorer, app, expected(app, "0007"))
    # The handle on the picture.
    explorer.stage()
    knob, picture = box(explorer.page.locator("#lpn-turn")), box(explorer.page.locator("#lpn-stage-query"))
    mouse = explorer.page.mouse
    mouse.move(knob["x"] + knob["width"] / 2, knob["y"] + knob["height"] / 2)
    mouse.down()
    mouse.move(picture["x"] + 5, picture["y"] + picture["height"] / 2, steps=8)
    mouse.up()
    explorer.expect_status("angle", "90")
    expect(explorer.field("Rotate")).to_have_value("90")
    explorer.page.locator("#lpn-turn").press("Home")
    explorer.expect_status("angle", "0")
    # Dragging ends on the last value, without a queue.
    expect(explorer.field("Rotate")).to_have_value("0")
    thumb = box(explorer.page.get_by_role("slider", name="Rotate"))
    x, y = thumb["x"] + thumb["width"] / 2, thumb["y"] + thumb["height"] / 2
    mouse.move(x, y)
    mouse.down()
    for step in range(60):
        mouse.move(x + 0.7 * step, y)
    mouse.up()
    explorer.settle()
    shown = float(explorer.field("Rotate").input_value())
    assert shown > 30
    explorer.expect_status("angle", f"{shown:g}")
    explorer.expect_answers(explorer.sequence() + 1)


@pytest.mark.slow
def test_switching_a_part_off_reranks_exactly(explorer: ExplorerPage, app: RunningApp) -> None:
    explorer.tab("Parts")
    first = explorer.sequence()
    explorer.tick("Part 4 outer", False)
    expect(explorer.status).not_to_have_attribute("data-seq", str(first))
    expect(explorer.page.locator("#lpn-parts")).to_contain_text("33 %")
    assert_shows(explorer, app, expected(app, "0007", weights=(1, 1, 1, 0)))
    explorer.fill("Weight 1 centre", "2")
    expect(explorer.page.locator("#lpn-parts")).to_contain_text("50 %")
    assert_shows(explorer, app, expected(app, "0007", weights=(2, 1, 1, 0)))
    explorer.page.get_by_role("button", name="All parts equal").click()
    expect(explorer.page.locator("#lpn-parts")).not_to_contain_text("50 %")
    assert_shows(explorer, app, expected(app, "0007"))


@pytest.mark.slow
def test_heatmap_and_rings_can_be_hidden_and_rings_taken_apart_and_without_positions_there_is_no_map(
    explorer: ExplorerPage,
) -> None:
    shown = explorer.stage()
    explorer.key("m")
    explorer.stage(lambda picture: difference(shown, picture) < 0.005)
    expect(explorer.field("Map")).to_have_count(0)
    explorer.key("h")
    without_heat = explorer.stage(lambda picture: difference(shown, picture) > 0.01)
    expect(explorer.field("Heatmap")).not_to_be_checked()
    explorer.key("g")
    explorer.stage(lambda picture: difference(without_heat, picture) > 0.01)
    explorer.key("x")
    explorer.stage(lambda picture: difference(without_heat, picture) > 0.05)


@pytest.mark.slow
def test_cards_are_seen_from_a_side_too(explorer: ExplorerPage) -> None:
    stage = box(explorer.canvas)
    top = round(box(explorer.page.locator("#lpn-stage-cards"))["y"] - stage["y"])

    def seen(picture: np.ndarray) -> float:
        """Return the share of the cards' room that is not the ground."""
        return float((picture[top:] > 60).any(axis=2).mean())

    before = explorer.stage(lambda picture: seen(picture) > 0.1)
    mouse = explorer.page.mouse
    mouse.move(stage["x"] + stage["width"] / 2, stage["y"] + 10)
    mouse.down()
    mouse.move(stage["x"] + stage["width"] / 2 - 120, stage["y"] + 10, steps=6)
    mouse.up()
    explorer.stage(lambda picture: difference(before, picture) > 0.02 and seen(picture) > 0.6 * seen(before))


def test_a_picture_of_ones_own(explorer: ExplorerPage, tmp_path: Path) -> None:
    own = tmp_path / "<b>mine.png"
    small_worlds.write(own, small_worlds.place(77))
    explorer.upload(own)
    explorer.expect_status("name", own.name)
    expect(explorer.verdict).to_contain_text("Best match")
    expect(explorer.rows.first).to_contain_text("?")
    broken = tmp_path / "broken.png"
    broken.write_bytes(b"not a picture")
    explorer.upload(broken)
    expect(explorer.page.get_by_text("broken.png is not a picture that can be read")).to_be_visible()
    explorer.expect_status("name", own.name)


@pytest.mark.slow
def test_a_second_browser_is_not_disturbed(
    explorer: ExplorerPage, app: RunningApp, contexts: Callable[[], BrowserContext]
) -> None:
    other = ExplorerPage(contexts().new_page())
    other.open(app.url)
    before = (other.sequence(), other.verdict.inner_text(), other.rows.all_inner_texts())
    explorer.fill("Rotate", "-60")
    explorer.expect_status("angle", "-60")
    explorer.rows.nth(1).click()
    explorer.page.get_by_role("button", name="Next ›").click()
    explorer.expect_status("name", "0008")
    assert (other.sequence(), other.verdict.inner_text(), other.rows.all_inner_texts()) == before
    expect(other.field("Rotate")).to_have_value("0")
    other.expect_answers(before[0] + 1)


# Where the ground below an object of the stage is seen, in fractions of the stage: viser's own scene, projected by its camera.
FOOT = """name => {
  const { camera, nodeRefFromName } = window.__viserMutable, node = nodeRefFromName[name];
  const place = camera.position.clone().setFromMatrixPosition(node.matrixWorld);
  place.y = 0;
  place.project(camera);
  return [(1 + place.x) / 2, (1 - place.y) / 2];
}"""

# Length of the drawn scale bar: its lowest line of white pixels, to the right of the arrow.
BAR_WIDTH = """() => {
  const canvas = document.querySelector("#lpn-stage-map canvas"), ratio = canvas.width / canvas.clientWidth;
  const row = canvas.getContext("2d").getImageData(0, Math.round(32 * ratio), canvas.width, 1).data;
  let end = Math.round(60 * ratio);
  while (row[4 * end] > 200 && row[4 * end + 3] > 200) end++;
  return end / ratio - 52;
}"""


CONTROLS = "window.__viserMutable.cameraControl"


def check_moves_of_a_map(explorer: ExplorerPage, box: FloatRect) -> None:
    """Drag the map by both buttons: the ground goes along, and the camera stays above it."""
    page = explorer.page
    read = page.locator("#lpn-stage-map .read")

    def drag(button: Literal["left", "right"], right: float, down: float) -> None:
        page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        page.mouse.down(button=button)
        page.mouse.move(box["x"] + box["width"] / 2 + right, box["y"] + box["height"] / 2 + down, steps=6)
        page.mouse.up(button=button)

    before = read.inner_text()
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
    expect(read).not_to_have_text(before)
    start = float(read.inner_text().split(", ")[1])
    drag("left", 60, 0)
    page.mouse.move(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)

    def shows_what_lies_further_west() -> None:
        assert float(read.inner_text().split(", ")[1]) < start

    explorer.eventually(shows_what_lies_further_west)
    oblique = page.evaluate(f"{CONTROLS}.polarAngle")
    drag("right", 0, -0.9 * box["height"] / 2)
    page.wait_for_function(f"{CONTROLS}.polarAngle > {oblique} + 0.1")
    assert page.evaluate(f"{CONTROLS}._sphericalEnd.phi") <= math.pi / 2  # where the turn ends


@pytest.mark.slow
def test_the_map_says_how_far_off_the_answer_is_and_has_a_scale_bar_north_and_the_position_under_the_cursor(
    mapped_app: RunningApp, new_page: Callable[[], Page]
) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(mapped_app.url)
    laid = geo.Positions(mapped_app.data)
    dataset = datasets.open_dataset(mapped_app.data)
    ranking = expected(mapped_app, "0007")
    truth = laid.of(dataset.queries("drone")[:1])
    tiles = laid.of(dataset.gallery("satellite"))
    for slot in (0, 4):
        metres = geo.metres(truth, [tiles[ranking.match(slot).index]])[0]
        expect(explorer.rows.nth(slot)).to_contain_text(f"{metres:,.0f} m")
    expect(explorer.page.locator("#lpn-header")).to_contain_text("median error")
    pair = explorer.stage()
    explorer.key("m")
    expect(explorer.field("Map")).to_be_checked()
    expect(explorer.field("City")).to_have_count(0)  # this data set has none
    shown = explorer.stage(lambda picture: difference(pair, picture) > 0.2)
    explorer.rows.nth(4).click()
    explorer.expect_status("chosen", str(ranking.match(4).index))
    explorer.stage(lambda picture: difference(shown, picture) > 0.005)
    explorer.key("m")
    expect(explorer.field("Map")).not_to_be_checked()
    explorer.stage(lambda picture: difference(pair, picture) < difference(pair, shown) / 2)
    marks = explorer.page.locator("#lpn-stage-map")
    expect(marks).to_have_count(0)
    explorer.key("m")
    expect(marks).to_have_attribute("data-metres", re.compile("^[125]0*$"))
    expect(marks).to_have_attribute("data-turn", re.compile(r"^-?0\.00"))  # the view is from the south
    explorer.settle()
    box = explorer.page.locator("canvas[data-engine]").bounding_box()
    assert box is not None
    tiles = geo.Positions(mapped_app.data).of(datasets.open_dataset(mapped_app.data).gallery("satellite"))
    for slot in (0, 4):
        place = tiles[int(explorer.rows.nth(slot).get_attribute("data-index") or -1)]

        def check(slot: int = slot, place: geo.Position = place) -> None:
            left, top = explorer.page.evaluate(FOOT, f"/map/tile{slot}")  # again: the camera may still be on its way
            explorer.page.mouse.move(box["x"] + left * box["width"], box["y"] + top * box["height"])
            expect(marks.locator(".read")).not_to_be_empty()
            read = [float(value) for value in marks.locator(".read").inner_text().split(", ")]
            assert read == pytest.approx([place.latitude, place.longitude], abs=3e-5)

        explorer.eventually(check)
    # The bar lies where its two ends are as far apart as it says.
    canvas = marks.locator("canvas").bounding_box()
    assert canvas is not None
    bar = explorer.page.evaluate(BAR_WIDTH)
    ends = []
    for right in (0.0, bar):
        before = marks.locator(".read").inner_text()
        explorer.page.mouse.move(canvas["x"] + 52 + right, canvas["y"] + 32)
        expect(marks.locator(".read")).not_to_have_text(before)
        ends.append([float(value) for value in marks.locator(".read").inner_text().split(", ")])
    metres = (ends[1][1] - ends[0][1]) * geo.metres_per_degree(ends[0][0])[1]
    assert metres == pytest.approx(float(marks.get_attribute("data-metres") or 0), rel=0.03)
    explorer.key("b")
    expect(marks).to_be_hidden()
    explorer.key("b")
    expect(marks).to_be_visible()
    check_moves_of_a_map(explorer, box)
    marks.get_by_role("button", name="Close the map").click()
    expect(marks).to_have_count(0)
    assert explorer.page.evaluate(f"{CONTROLS}.mouseButtons.left === {CONTROLS}.constructor.ACTION.ROTATE")
    assert explorer.page.evaluate(f"{CONTROLS}.maxPolarAngle") == pytest.approx(math.pi)
    explorer.key("m")
    expect(marks).to_be_visible()
    explorer.page.keyboard.press("Control+k")
    search = explorer.page.get_by_placeholder("Search commands")
    expect(search).to_be_focused()  # before that, the key goes to the page
    explorer.page.keyboard.press("Escape")  # the palette takes it
    expect(search).to_have_count(0)
    expect(marks).to_be_visible()
    explorer.key("Escape")
    expect(marks).to_have_count(0)


def crimson(picture: np.ndarray) -> float:
    """The share of pixels in the colours of the drawn city, which nothing else on the page has."""
    blue, green, red = picture.transpose(2, 0, 1)
    return float(((red > 120) & (green < 0.5 * red) & (blue < 0.8 * red)).mean())


@pytest.mark.slow
def test_the_city_stands_on_the_map_until_it_is_switched_off(
    city_app: RunningApp, new_page: Callable[[], Page]
) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(city_app.url)
    expect(explorer.field("City")).to_have_count(0)
    explorer.stage(lambda picture: crimson(picture) < 0.05)
    explorer.key("m")
    expect(explorer.field("City")).to_be_checked()
    with_city = crimson(explorer.stage(lambda picture: crimson(picture) > 0.3))
    explorer.key("c")
    expect(explorer.field("City")).not_to_be_checked()
    explorer.stage(lambda picture: crimson(picture) < 0.05)
    explorer.tick("City", True)
    explorer.stage(lambda picture: abs(crimson(picture) - with_city) < 0.05)
    explorer.key("m")
    expect(explorer.field("City")).to_have_count(0)


def test_the_demo_opens_without_being_told_anything(
    demo_app: RunningApp, new_page: Callable[[], Page], tmp_path: Path
) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(demo_app.url)
    expect(explorer.page.locator("#lpn-workspaces a.chosen")).to_have_text("a real flight")
    expect(explorer.page.locator("#lpn-header")).to_contain_text("caliterra-even")
    explorer.open(f"{demo_app.url}/?task=drone-to-satellite")  # links without a place are those of the city
    expect(explorer.page.locator("#lpn-workspaces a.chosen")).to_have_text("a computer-generated city")
    expect(explorer.page.locator("#lpn-header")).to_contain_text("demo")
    expect(explorer.page.locator("#lpn-header")).to_contain_text("within 50 m")
    # A link that names a state without a scoring means the plain one; one that names the place alone, the one that ships.
    expect(explorer.page.locator("#lpn-scorings a.chosen")).to_contain_text("plain")
    explorer.open(f"{demo_app.url}/?show=data")
    expect(explorer.page.locator("#lpn-scorings a.chosen")).to_have_text("calibrated 84.7 %")
    assert_shows(explorer, demo_app, expected_calibrated(demo_app, DEMO_QUERY))
    explorer.key("m")
    expect(explorer.field("Map")).to_be_checked()
    explorer.stage(lambda picture: len(np.unique(picture.sum(axis=2))) > 100)
    assert not (tmp_path / "cache").exists()  # what is shown was described before


@pytest.mark.slow
def test_the_main_job_on_real_pictures(real_app: RunningApp, new_page: Callable[[], Page]) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(real_app.url)
    expect(explorer.page.locator("#lpn-header")).to_contain_text("80 queries")
    explorer.fill("Find name", "0083")
    explorer.expect_status("name", "0083")
    upright = explorer.stage()
    explorer.fill("Rotate", "-120")
    explorer.expect_status("angle", "-120")
    assert_shows(explorer, real_app, expected(real_app, "0083", -120))
    explorer.stage(lambda picture: difference(upright, picture) > 0.05)
    explorer.tab("Parts")
    explorer.tick("Part 1 centre", False)
    expect(explorer.page.locator("#lpn-parts")).to_contain_text("33 %")
    ranking = expected(real_app, "0083", -120, (0, 1, 1, 1))
    assert_shows(explorer, real_app, ranking)
    explorer.rows.nth(4).click()
    explorer.expect_status("chosen", str(ranking.match(4).index))
    expect(explorer.page.locator("#lpn-parts")).to_contain_text(f"{ranking.match(4).distance2:.3f}")


@pytest.mark.slow
def test_panoramas_and_unrolled_tiles_are_shown_wide(panorama_app: RunningApp, new_page: Callable[[], Page]) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(panorama_app.url)
    expect(explorer.page.locator("#lpn-header")).to_contain_text("SAFA + LPN")
    model, dataset = lpn.load(panorama_app.model), datasets.open_dataset(panorama_app.data)
    query, gallery = dataset.queries("street")[0], dataset.gallery("satellite")
    found, *tiles = (
        model.descriptors(model.prepare(images.load_picture(entry.path), view)[None], view)[0]
        for entry, view in [(query, "street"), *((entry, "satellite") for entry in gallery)]
    )
    best = int(np.argmax(scoring.part_cosines(found, np.stack(tiles)).mean(axis=1)))
    expect(explorer.rows.first).to_have_attribute("data-index", str(best))
    flat = explorer.stage()
    explorer.key("x")
    expect(explorer.field("Take apart")).to_be_checked()
    explorer.stage(lambda picture: difference(flat, picture) > 0.02)
