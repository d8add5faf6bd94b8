"""Exploring a saved result: everything that descriptors tell, nothing that needs the network."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import lpn
from lpn import datasets, retrieval
from lpn.descriptors import cached_descriptors
from lpn.retrieval import scoring
from tests.e2e.conftest import ExplorerPage, RunningApp


@pytest.mark.slow
def test_a_saved_result_is_explored_without_its_network(
    saved_app: RunningApp, app: RunningApp, new_page: Callable[[], Page]
) -> None:
    explorer = ExplorerPage(new_page())
    explorer.open(saved_app.url)
    header = explorer.page.locator("#lpn-header")
    for text in (
        "pytorch_result.mat",
        "saved descriptors, n = 4, no network",
        "drone → satellite",
        "14 queries",
        "R@1",
    ):
        expect(header).to_contain_text(text)
    expect(explorer.page.locator("#lpn-saved")).to_contain_text("no heatmaps")
    expect(explorer.field("Rings")).to_be_visible()
    for label in ("Rotate", "Heatmap", "Opacity", "Heat of"):
        expect(explorer.page.locator(f'label:text-is("{label}")')).to_have_count(0)
    expect(explorer.page.get_by_text("Use my own picture")).to_have_count(0)

    model, dataset = lpn.load(app.model), datasets.open_dataset(app.data)
    query = next(entry for entry in dataset.queries("drone") if entry.name == "0011")
    gallery = dataset.gallery("satellite")[::-1]  # the order of the file
    cosines = scoring.part_cosines(
        cached_descriptors(model, [query], "drone")[0], cached_descriptors(model, gallery, "satellite")
    )

    def shows(weights: tuple[float, ...]) -> None:
        labels = np.array([entry.label for entry in gallery])
        ranking = retrieval.rank(cosines, scoring.part_weights(4, weights), labels, query.label)
        rows = explorer.rows.evaluate_all("rows => rows.map(row => [row.dataset.index, row.innerText])")
        assert len(rows) >= 10
        for (index, text), match in zip(rows, ranking.top(10), strict=False):
            assert index == str(match.index)
            assert gallery[match.index].name in text
            assert ("✓" if match.true else "✗") in text
            assert f"{match.distance2:.3f}" in text

    explorer.fill("Find name", "0011")
    explorer.expect_status("name", "0011")
    explorer.eventually(lambda: shows((1, 1, 1, 1)))
    answers = explorer.sequence()
    for key in ("j", "h"):
        explorer.key(key)
    explorer.tab("Parts")
    explorer.tick("Part 1 centre", False)
    expect(explorer.status).to_have_attribute("data-seq", str(answers + 1))  # the keys changed nothing
    explorer.eventually(lambda: shows((0, 1, 1, 1)))
