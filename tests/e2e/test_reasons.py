"""The window of reasons in a real browser."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import BrowserContext, Locator, expect

from lpn import datasets, explain, load, retrieval
from lpn.core import images
from lpn.explain import sweeps
from tests.e2e.conftest import Explorer, Running
from tests.e2e.test_explorer import assert_shows, expected


def open_window(explorer: Explorer) -> Locator:
    """Press Y and wait for the evidence."""
    explorer.key("y")
    found = explorer.page.locator("#lpn-why .lpn-map")
    expect(found).to_have_count(2)
    explorer.page.wait_for_timeout(300)
    return found


def middle(box: Locator, across: float, down: float) -> tuple[float, float]:
    """A point of an element in shares of its size."""
    found = box.bounding_box()
    assert found is not None
    return found["x"] + across * found["width"], found["y"] + down * found["height"]


def test_evidence_of_the_compared_pair_is_exact_and_its_cursor_linked(explorer: Explorer, app: Running) -> None:
    maps = open_window(explorer)
    model, dataset = load(app.model), datasets.open_dataset(app.data)
    ranking = expected(app, "0007")
    query = next(entry for entry in dataset.queries("drone") if entry.name == "0007")
    tile = dataset.gallery("satellite")[ranking.match(0).index]
    one = retrieval.describe_picture(model, images.load_picture(query.path), "drone")
    other = retrieval.describe_picture(model, images.load_picture(tile.path), "satellite")
    assert one.trace is not None
    assert other.trace is not None
    found = explain.evidence(one.trace, other.trace)
    for shown, side in zip(maps.all(), (found.query, found.tile), strict=True):
        cells = json.loads(shown.get_attribute("data-cells") or "[]")
        np.testing.assert_allclose(cells, side.total(found.weights).reshape(-1), atol=1e-4)
    correspondences, _ = explain.counterparts(one.trace, other.trace, found.weights)
    read = explorer.page.locator(".lpn-read")
    explorer.page.mouse.move(*middle(maps.first, 0.3, 0.6))  # row 3, column 2 of 4 x 4
    expect(read).to_contain_text("query, row 3, column 2")
    correspondence = int(correspondences.cells[2 * 4 + 1])
    expect(read).to_contain_text(f"tile’s row {correspondence // 4 + 1}, column {correspondence % 4 + 1}")
    expect(maps.last.locator(".there")).to_be_visible()
    explorer.page.mouse.click(*middle(maps.first, 0.3, 0.6))
    explorer.page.mouse.move(*middle(maps.first, 0.9, 0.9))
    expect(read).to_contain_text("query, row 3, column 2")
    explorer.key("y")
    expect(explorer.page.locator("#lpn-why .lpn-map").first).to_be_hidden()


def test_evidence_follows_the_chosen_tile_and_part(explorer: Explorer) -> None:
    maps = open_window(explorer)
    before = maps.first.get_attribute("data-cells")
    explorer.page.locator("#lpn-why .chips a").nth(3).click()
    expect(maps.first).not_to_have_attribute("data-cells", before or "")
    expect(explorer.page.locator("#lpn-why .chips a.chosen")).to_have_text("3")
    part = maps.first.get_attribute("data-cells")
    explorer.rows.nth(2).click()
    expect(maps.first).not_to_have_attribute("data-cells", part or "")


@pytest.mark.slow
def test_the_stage_shows_evidence_in_place_of_activation(explorer: Explorer) -> None:
    before = explorer.stage()
    explorer.key("v")
    explorer.page.wait_for_timeout(600)
    assert explorer.stage() != before
    expect(explorer.page.get_by_label("Shows", exact=True)).to_have_value("Evidence")


def test_true_against_wrong_offers_weights_that_put_the_truth_first(explorer: Explorer) -> None:
    explorer.page.get_by_role("button", name="Failure", exact=True).click()
    expect(explorer.verdict).to_contain_text("Wrong")
    open_window(explorer)
    explorer.page.get_by_role("tab", name="True or wrong").click()
    versus = explorer.page.locator("#lpn-versus")
    expect(versus.locator("tr.total")).to_be_visible()
    change = explorer.page.locator("#lpn-change")
    tried = 0
    while "The smallest change" not in change.inner_text() and tried < 12:
        explorer.key("f")
        explorer.page.wait_for_timeout(500)
        tried += 1
    explorer.page.locator("#lpn-effect a").click()
    expect(explorer.page.locator("#lpn-effect")).to_contain_text(re.compile("it (helps|harms|neither)"), timeout=20_000)
    versus.locator(".chips a").click()
    expect(explorer.verdict).to_contain_text("Found", timeout=10_000)


def test_a_profile_is_computed_and_a_point_taken(explorer: Explorer, app: Running) -> None:
    open_window(explorer)
    explorer.page.get_by_role("tab", name="Turn, shift, zoom").click()
    explorer.page.locator("#lpn-profile .chips a", has_text="Turn").click()
    profile = explorer.page.locator("#lpn-profile")
    expect(profile).to_have_attribute("data-done", str(len(sweeps.changes_over("rotation"))), timeout=30_000)
    expect(profile).to_contain_text("Best for the true tile")
    points = profile.locator("svg").first.locator(".point")
    expect(points).to_have_count(24)
    points.nth(20).click()  # from -165 in steps of 15
    explorer.expect_status("angle", "135")
    assert_shows(explorer, app, expected(app, "0007", 135))
    # Another query has no profile yet.
    explorer.key("n")
    explorer.expect_status("name", "0008")
    expect(profile).to_contain_text("Choose what to change")


def test_a_painted_region_is_searched_by_alone(explorer: Explorer) -> None:
    open_window(explorer)
    explorer.page.get_by_role("tab", name="Search by a region").click()
    canvas = explorer.page.locator(".lpn-map.canvas")
    expect(canvas).to_be_visible()
    explorer.page.wait_for_timeout(300)
    before = explorer.rows.evaluate_all("rows => rows.map(row => row.dataset.index)")
    x, y = middle(canvas, 0.1, 0.1)
    end, _ = middle(canvas, 0.6, 0.1)
    mouse = explorer.page.mouse
    mouse.move(x, y)
    mouse.down()
    for step in range(1, 11):
        mouse.move(x + (end - x) * step / 10, y)
    mouse.up()
    region = explorer.page.locator("#lpn-region")
    expect(region).to_have_attribute("data-painted", "3")
    expect(region).to_contain_text("3 of 16 cells")
    expect(explorer.page.locator("#lpn-parts")).to_contain_text("+0.000")
    region.locator(".chips a").click()
    expect(region).to_have_attribute("data-painted", "0")
    assert explorer.rows.evaluate_all("rows => rows.map(row => row.dataset.index)") == before


@pytest.mark.parametrize(
    "message", ['{"kind": "region", "value": [999999]}', '{"kind": "take", "value": "x"}', "{", "[1]"]
)
@pytest.mark.slow
def test_nonsense_from_a_page_changes_nothing(explorer: Explorer, message: str) -> None:
    before = explorer.sequence()
    explorer.page.evaluate(
        "text => { const found = JSON.parse(text); lpn.send(found.kind, found.value); }", message
    ) if (message.startswith('{"')) else explorer.page.evaluate("() => lpn.send(undefined, undefined)")
    explorer.page.wait_for_timeout(400)
    assert explorer.sequence() == before
    explorer.key("n")
    explorer.expect_status("name", "0008")


def test_a_report_of_the_pair_is_saved(
    explorer: Explorer, contexts: Callable[[], BrowserContext], tmp_path: Path
) -> None:
    open_window(explorer)
    with explorer.page.expect_download(timeout=30_000) as download:
        explorer.page.locator("#lpn-why a", has_text="Save as a report").click()
    assert download.value.suggested_filename == "0007.html"
    download.value.save_as(tmp_path / "report.html")
    page = contexts().new_page()
    page.goto((tmp_path / "report.html").as_uri())
    expect(page.locator("body")).to_contain_text("Query 0007")
    expect(page.locator("body")).to_contain_text("model.onnx")


@pytest.mark.slow
def test_two_models_answer_the_same_query(two_models: Running, contexts: Callable[[], BrowserContext]) -> None:
    explorer = Explorer(contexts().new_page())
    explorer.open(two_models.url)
    open_window(explorer)
    explorer.page.get_by_role("tab", name="Two models").click()
    shown = explorer.page.locator("#lpn-beside")
    for said in ("model.onnx", "whole.onnx", "n = 4", "n = 1", "alone finds"):
        expect(shown).to_contain_text(said)
    row = shown.locator(".row").first
    query = row.get_attribute("data-query")
    row.click()
    explorer.expect_status("query", query or "")


@pytest.mark.slow
def test_a_profile_asked_for_twice_is_computed_to_the_end(explorer: Explorer) -> None:
    open_window(explorer)
    explorer.page.get_by_role("tab", name="Turn, shift, zoom").click()
    turn = explorer.page.locator("#lpn-profile .chips a", has_text="Turn")
    turn.click()
    explorer.page.wait_for_timeout(250)
    turn.click()
    expect(explorer.page.locator("#lpn-profile")).to_have_attribute("data-done", "24", timeout=30_000)


@pytest.mark.slow
def test_a_window_opened_by_a_link_keeps_to_the_stage(app: Running, contexts: Callable[..., BrowserContext]) -> None:
    explorer = Explorer(contexts(viewport={"width": 1280, "height": 720}).new_page())
    explorer.open(f"{app.url}/?why=1")
    expect(explorer.page.locator("#lpn-why .lpn-map")).to_have_count(2)
    explorer.page.wait_for_timeout(1200)
    window, canvas = explorer.page.locator("#lpn-why").bounding_box(), explorer.canvas.bounding_box()
    assert window is not None
    assert canvas is not None
    assert window["x"] + window["width"] <= canvas["x"] + canvas["width"]


@pytest.mark.slow
def test_chips_answer_to_the_keyboard(explorer: Explorer) -> None:
    open_window(explorer)
    chip = explorer.page.locator("#lpn-why .chips a").nth(2)
    chip.focus()
    explorer.page.keyboard.press("Enter")
    expect(explorer.page.locator("#lpn-why .chips a.chosen")).to_have_text("2")
