"""Figures of the whole task under part weights, in a real browser."""

from __future__ import annotations

from pathlib import Path

import pytest
from playwright.sync_api import expect

from lpn import datasets, load
from lpn.analysis.part_weights import WeightedTask, part_combinations, weights_of
from lpn.tasks.opening import describe_task
from tests.e2e.conftest import ExplorerPage, RunningApp


def test_a_part_switched_off_shows_both_figures_and_their_difference(explorer: ExplorerPage, app: RunningApp) -> None:
    page = explorer.page
    page.get_by_role("tab", name="Parts").click()
    panel = page.locator("#lpn-weights")
    expect(panel).to_contain_text("All parts count equally")
    page.get_by_role("checkbox", name="Part 2", exact=True).click()
    figures = panel.get_by_role("table", name="The whole task under these weights").locator("tr")
    expect(figures).to_have_count(3)
    task = describe_task(load(app.model), "lpn", datasets.open_dataset(app.data), "drone-to-satellite")
    effect = WeightedTask(task).effect(weights_of((1, 3, 4), 4))
    expect(figures.nth(1)).to_contain_text(
        f"{effect.recall:.1f}{effect.equal_recall:.1f}{effect.recall_difference.value:+.1f}"
    )
    expect(figures.nth(2)).to_contain_text(f"{effect.ap:.1f}{effect.equal_ap:.1f}{effect.ap_difference.value:+.1f}")
    expect(panel).to_contain_text(f"{effect.gained} won and {effect.lost} lost of {effect.queries} queries")


@pytest.mark.slow
def test_all_combinations_are_tried_sorted_saved_and_taken(
    explorer: ExplorerPage, app: RunningApp, tmp_path: Path
) -> None:
    page = explorer.page
    page.get_by_role("tab", name="Parts").click()
    panel = page.locator("#lpn-weights")
    panel.get_by_role("button", name="Try all combinations").click()
    rows = panel.locator(".choice")
    expect(rows).to_have_count(15)
    expect(panel).not_to_contain_text("…")
    tasks = ["drone-to-satellite", "satellite-to-drone"]
    opened = [describe_task(load(app.model), "lpn", datasets.open_dataset(app.data), name) for name in tasks]
    measured = [WeightedTask(task) for task in opened]
    effects = {parts: [one.effect(weights_of(parts, 4)) for one in measured] for parts in part_combinations(4)}
    for row, (parts, (first, second)) in zip(rows.all(), effects.items(), strict=True):
        assert row.get_attribute("aria-label") == f"Only part{'s' * (len(parts) > 1)} {', '.join(map(str, parts))}"
        figures = [f"{value:.1f}" for one in (first, second) for value in (one.recall, one.ap)]
        assert row.locator("td").all_inner_texts()[1:] == figures
    with page.expect_download() as saving:
        panel.get_by_role("button", name="Save as CSV").click()
    saving.value.save_as(tmp_path / "parts.csv")
    lines = (tmp_path / "parts.csv").read_text().splitlines()
    assert len(lines) == 16
    assert float(lines[-1].split(",")[1]) == pytest.approx(effects[1, 2, 3, 4][0].recall)
    panel.get_by_role("button", name="AP").first.click()
    best = max(effects, key=lambda parts: effects[parts][0].ap)
    expect(rows.first.locator("td").nth(2)).to_have_text(f"{effects[best][0].ap:.1f}")
    rows.filter(has_text="1 · 3 ·").click()
    expect(page.get_by_role("checkbox", name="Part 2", exact=True)).not_to_be_checked()
    expect(page.get_by_role("checkbox", name="Part 3", exact=True)).to_be_checked()
    expect(panel.locator(".choice.chosen")).to_have_attribute("aria-label", "Only parts 1, 3")
