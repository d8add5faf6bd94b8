"""The window of reasons in a real browser."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import BrowserContext, Locator, Page, expect

from lpn import datasets, explain, load, retrieval
from lpn.core import images
from lpn.explain import sweeps
from lpn.explain.counterfactual import smallest_change
from lpn.tasks.changes import turned
from lpn.tasks.opening import describe_task
from tests.e2e.conftest import ExplorerPage, RunningApp, difference
from tests.e2e.test_explorer import assert_shows, expected


def open_window(explorer: ExplorerPage) -> Locator:
    """Open the evidence and wait for it."""
    explorer.explain()
    found = explorer.page.locator("#lpn-why .lpn-map")
    expect(found).to_have_count(2)
    explorer.settle()
    return found


def middle(box: Locator, across: float, down: float) -> tuple[float, float]:
    """A point of an element in shares of its size, once its pictures are there and it moves no more."""
    box.evaluate("one => Promise.all([...one.querySelectorAll('img')].map(image => image.decode().catch(() => 0)))")
    box.hover(trial=True)
    found = box.bounding_box()
    assert found is not None
    return found["x"] + across * found["width"], found["y"] + down * found["height"]


def test_evidence_of_the_compared_pair_is_exact_and_follows_cursor_part_and_tile(
    explorer: ExplorerPage, app: RunningApp
) -> None:
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
        np.testing.assert_allclose(cells, side.score_map(found.weights).reshape(-1), atol=1e-4)
    correspondences, _ = explain.correspondences(one.trace, other.trace, found.weights)
    read = explorer.page.locator(".lpn-read")
    explorer.page.mouse.move(*middle(maps.first, 0.3, 0.6))  # row 3, column 2 of 4 x 4
    expect(read).to_contain_text("query, row 3, column 2")
    correspondence = int(correspondences.cells[2 * 4 + 1])
    expect(read).to_contain_text(f"tile’s row {correspondence // 4 + 1}, column {correspondence % 4 + 1}")
    expect(maps.last.locator(".there")).to_be_visible()
    explorer.page.mouse.click(*middle(maps.first, 0.3, 0.6))
    explorer.page.mouse.move(*middle(maps.first, 0.9, 0.9))
    expect(read).to_contain_text("query, row 3, column 2")
    before = maps.first.get_attribute("data-cells")
    explorer.page.locator("#lpn-why .chips a").nth(3).click()
    expect(maps.first).not_to_have_attribute("data-cells", before or "")
    expect(explorer.page.locator("#lpn-why .chips a.chosen")).to_have_text("3")
    part = maps.first.get_attribute("data-cells")
    explorer.rows.nth(2).click()
    expect(maps.first).not_to_have_attribute("data-cells", part or "")
    explorer.key("y")
    expect(explorer.page.locator("#lpn-why .lpn-map").first).to_be_hidden()


@pytest.mark.slow
def test_each_part_has_a_heatmap_of_query_and_tile_and_both_may_share_a_scale(explorer: ExplorerPage) -> None:
    open_window(explorer)
    explorer.tab("Heatmaps")
    page = explorer.page.locator("#lpn-heatmaps")
    cells, sides = page.locator("img.cells"), ("query", "tile", "true tile")
    expect(cells).to_have_count(3 * 4)  # the answer is wrong: the true tile is below it

    def scales(side: str) -> list[list[str]]:
        bars = page.locator(f'figure[data-side="{side}"] svg:has(image)')
        return bars.evaluate_all(
            "bars => bars.map(bar => [...bar.querySelectorAll('text')].map(text => text.textContent))"
        )

    for side in sides:
        assert [len(labels) for labels in scales(side)] == [3] * 4
        for low, middle, high in scales(side):
            assert float(low) < float(middle) < float(high)
    own = [scales(side) for side in sides]
    assert own[0] != own[1]
    box = page.get_by_role("checkbox", name="Same scale for query and tile")
    box.click()
    explorer.eventually(lambda: _assert_equal(scales("query"), scales("tile")))
    expect(box).to_be_checked()
    for part, (low, _, high) in enumerate(scales("tile")):
        # The labels are rounded, and the shared scale may be too long for a digit after the point.
        assert float(low) == pytest.approx(min(float(side[part][0]) for side in own), abs=0.6)
        assert float(high) == pytest.approx(max(float(side[part][2]) for side in own), abs=0.6)
    cells.first.hover()
    expect(page.locator(".lpn-value")).to_have_text(
        re.compile(r"query, activation, part 1 centre, row \d, column \d: ")
    )
    box.click()
    explorer.eventually(lambda: _assert_equal([scales(side) for side in sides], own))


def _assert_equal(found: object, expected: object) -> None:
    assert found == expected


def swappable(app: RunningApp) -> str:
    """The name of a query that is answered wrongly, and rightly under other part weights."""
    for query in datasets.open_dataset(app.data).queries("drone"):
        ranking = expected(app, query.name)
        truth = ranking.positive()
        if truth is not None and truth.rank > 1 and smallest_change(ranking) is not None:
            return query.name
    raise AssertionError("no wrong answer is put right by other weights")


@pytest.mark.slow
def test_true_against_wrong_offers_weights_that_put_the_truth_first(explorer: ExplorerPage, app: RunningApp) -> None:
    explorer.page.get_by_role("button", name="Failure", exact=True).click()
    expect(explorer.verdict).to_contain_text("✗")
    open_window(explorer)
    explorer.page.get_by_role("tab", name="True or wrong").click()
    versus = explorer.page.locator("#lpn-counterfactual")
    expect(versus.locator("tr.total")).to_be_visible()
    name = swappable(app)
    explorer.fill("Find name", name)
    explorer.expect_status("name", name)
    expect(versus.locator(".facts")).to_contain_text(name)
    expect(explorer.page.locator("#lpn-change")).to_contain_text("The smallest change")
    explorer.page.locator("#lpn-effect a").click()
    expect(explorer.page.locator("#lpn-effect")).to_contain_text(re.compile("it (helps|harms|neither)"))
    versus.locator(".chips a").click()
    expect(explorer.verdict).to_contain_text("✓")


@pytest.mark.slow
def test_a_profile_is_computed_to_the_end_and_the_whole_task_is_measured_with_turned_queries(
    explorer: ExplorerPage, app: RunningApp
) -> None:
    open_window(explorer)
    explorer.page.get_by_role("tab", name="Turn, shift, zoom").click()
    turn = explorer.page.locator("#lpn-profile .chips a", has_text="Turn")
    turn.click()
    profile = explorer.page.locator("#lpn-profile")
    expect(profile).to_have_attribute("data-done", re.compile("[1-9]"))
    turn.click()
    expect(profile).to_have_attribute("data-done", str(len(sweeps.changes_over("rotation"))))
    expect(profile).to_contain_text("Best for the true tile")
    points = profile.locator(".point")
    expect(points).to_have_count(2 * 25)
    points.nth(21).click()  # of the ranks, from -180 in steps of 15
    explorer.expect_status("angle", "135")
    assert_shows(explorer, app, expected(app, "0007", 135))
    # Another query has no profile yet.
    explorer.key("n")
    explorer.expect_status("name", "0008")
    expect(profile).to_contain_text("Choose what to change")
    # The whole task with turned queries.
    explorer.fill("Rotate", "90")
    explorer.expect_status("angle", "90")
    section = explorer.page.locator("#lpn-turned")
    section.get_by_role("button", name="As this query (90°)").click()
    expect(section).to_have_attribute("data-known", "2")
    task = describe_task(load(app.model), "lpn", datasets.open_dataset(app.data), "drone-to-satellite")
    figures = explorer.page.locator("#lpn-turned-figures .figure")
    expected_figures = [
        f"{one.change.rotate:g}° {one.metrics['recall@1']:.1f} ({one.metrics['ap']:.1f})"
        for one in (task, turned(task, 90))
    ]
    expect(figures).to_have_text(expected_figures)
    # The sweep of the one query began as well, and its chart has a point for each turn.
    expect(profile).to_contain_text("R@1 of the whole task, %")
    expect(profile.locator(".task-point")).to_have_count(2)
    section.get_by_role("button", name="As in Table IV").click()
    expect(section).to_have_attribute("data-known", "5")
    expect(profile.locator(".task-point")).to_have_count(6)  # 180° is at both ends


@pytest.mark.slow
def test_a_painted_region_is_searched_by_alone_and_chips_answer_to_the_keyboard(explorer: ExplorerPage) -> None:
    open_window(explorer)
    explorer.page.get_by_role("tab", name="Search by a region").click()
    canvas = explorer.page.locator(".lpn-map.canvas")
    expect(canvas).to_be_visible()
    explorer.settle()
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

    def restored() -> None:
        assert explorer.rows.evaluate_all("rows => rows.map(row => row.dataset.index)") == before

    explorer.eventually(restored)
    # The chips of the evidence answer to the keyboard.
    explorer.tab("Why")
    chip = explorer.page.locator("#lpn-why .chips a").nth(2)
    chip.focus()
    explorer.page.keyboard.press("Enter")
    expect(explorer.page.locator("#lpn-why .chips a.chosen")).to_have_text("2")


@pytest.mark.slow
def test_nonsense_from_a_page_changes_nothing_and_the_stage_shows_evidence_in_place_of_activation(
    explorer: ExplorerPage,
) -> None:
    before = explorer.sequence()
    for arguments in ('"region", [999999]', '"take", "x"', "undefined, undefined", "[1], {}"):
        explorer.page.evaluate(f"() => lpn.send({arguments})")
    explorer.expect_answers(before + 1)
    explorer.key("n")
    explorer.expect_status("name", "0008")
    before = explorer.stage()
    explorer.key("v")
    explorer.stage(lambda picture: difference(before, picture) > 0.01)
    expect(explorer.page.get_by_label("Heat type", exact=True)).to_have_value("Evidence")


@pytest.mark.slow
def test_a_report_of_the_pair_is_saved(
    explorer: ExplorerPage, contexts: Callable[[], BrowserContext], tmp_path: Path
) -> None:
    open_window(explorer)
    with explorer.page.expect_download() as download:
        explorer.page.locator("#lpn-why").get_by_role("button", name="Save this answer").click()
    assert download.value.suggested_filename == "0007.html"
    download.value.save_as(tmp_path / "report.html")
    page = contexts().new_page()
    page.goto((tmp_path / "report.html").as_uri())
    expect(page.locator("body")).to_contain_text("Query 0007")
    expect(page.locator("body")).to_contain_text("model.onnx")


@pytest.mark.slow
def test_a_link_opens_both_models_on_query_and_tile_and_the_chart_chooses_another(
    three_models: RunningApp, contexts: Callable[[], BrowserContext]
) -> None:
    explorer = ExplorerPage(contexts().new_page())
    explorer.open(f"{three_models.url}/?why=1&reason=models")
    shown = explorer.page.locator("#lpn-model-comparison")
    pictures = shown.locator("[data-model] .map img")
    expect(pictures).to_have_count(4)  # without another click
    for i in range(4):
        expect(pictures.nth(i)).to_be_visible()
    expect(shown.locator(".share")).to_have_count(4)
    before = [picture.get_attribute("src") for picture in pictures.all()]
    shown.get_by_role("button", name="Evidence").click()
    expect(shown.locator(".chips a.chosen").first).to_have_text("Evidence")
    expect(pictures.first).not_to_have_attribute("src", before[0] or "")
    explorer.eventually(lambda: _expect_address(explorer, ("shows=evidence", "reason=models")))
    shown.get_by_label("One scale for all pictures").click()
    expect(shown.get_by_label("One scale for all pictures")).to_be_checked()
    scales = shown.locator("svg.colours")
    expect(scales).to_have_count(4)

    def have_one_scale() -> None:  # the box is ticked before the server has drawn the scales anew
        labels = scales.evaluate_all("scales => scales.map(scale => scale.getAttribute('aria-label'))")
        assert len(labels) == 4
        assert len(set(labels)) == 1

    explorer.eventually(have_one_scale)
    chart = shown.get_by_role("group", name="R@1 of the whole task, % by number of parts n")
    expect(chart.locator(".model")).to_have_count(3)
    expect(chart.locator(".model.compared")).to_have_attribute("aria-label", re.compile(r"^whole\.onnx: 1, "))
    chart.get_by_role("button", name="two.onnx: 2").click()
    expect(chart.locator(".model.compared")).to_have_attribute("aria-label", re.compile(r"^two\.onnx: 2, "))
    expect(shown.locator("[data-model=B] h2")).to_contain_text("two.onnx")
    expect(shown.locator("[data-model=B]")).to_contain_text("n = 2, 96 x 96")
    expect(pictures).to_have_count(4)
    explorer.eventually(lambda: _expect_address(explorer, ("beside=two.onnx",)))
    again = ExplorerPage(contexts().new_page())
    again.open(explorer.page.url)
    expect(again.page.locator("#lpn-model-comparison [data-model=B] h2")).to_contain_text("two.onnx")
    here = explorer.status.get_attribute("data-query")
    row = shown.locator(f".row:not([data-query='{here}'])").first
    query = row.get_attribute("data-query")
    row.click()
    explorer.expect_status("query", query or "")


def _expect_address(explorer: ExplorerPage, pieces: Sequence[str]) -> None:
    for piece in pieces:
        assert piece in explorer.page.url


@pytest.mark.slow
def test_one_click_compares_with_the_baseline_and_one_turns_the_task_around(
    baseline_app: RunningApp, new_page: Callable[[], Page]
) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(baseline_app.url)
    explorer.expect_status("name", "0007")
    explorer.page.get_by_role("button", name="Compare with the baseline (n = 1)").click()
    shown = explorer.page.locator("#lpn-model-comparison")
    expect(shown).to_be_visible()  # without another click
    for said in ("lpn.onnx", "baseline.onnx", "n = 4", "n = 1", "alone finds"):
        expect(shown).to_contain_text(said)
    explorer.key("y")
    explorer.page.locator("#lpn-tasks a", has_text="satellite → drone").click()
    expect(explorer.page.locator("#lpn-tasks a.chosen")).to_have_text("satellite → drone")
    explorer.expect_status("name", "0007")  # the same place


@pytest.mark.slow
def test_a_window_opened_by_a_link_keeps_to_the_stage(app: RunningApp, contexts: Callable[..., BrowserContext]) -> None:
    explorer = ExplorerPage(contexts(viewport={"width": 1280, "height": 720}).new_page())
    explorer.open(f"{app.url}/?why=1")
    expect(explorer.page.locator("#lpn-why .lpn-map")).to_have_count(2)

    def fits() -> None:
        window, canvas = explorer.page.locator("#lpn-why").bounding_box(), explorer.canvas.bounding_box()
        assert window is not None
        assert canvas is not None
        assert window["x"] + window["width"] <= canvas["x"] + canvas["width"]

    explorer.eventually(fits)
