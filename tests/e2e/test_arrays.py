"""Exploring plain arrays: rankings, the laboratory, and the map, without any model."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

from tests.e2e.conftest import ExplorerPage, started
from tools.fixtures import layouts, small_worlds


@pytest.mark.slow
def test_plain_arrays_are_explored_without_a_model(tmp_path: Path, new_page: Callable[[], Page]) -> None:
    rng = np.random.default_rng(2)
    places = rng.standard_normal((8, 2, 6))
    query = places[:5] + 1.2 * rng.standard_normal((5, 2, 6))
    np.save(tmp_path / "q.npy", query)
    np.save(tmp_path / "g.npy", places)
    lines = ["file,side,label,latitude,longitude"]
    # Names leave out the folder that all pictures of a side share.
    lines += [
        f"test/q/{'street' if row % 3 == 0 else 'park'}/{row}.png,query,{row},46.000{row},7.0" for row in range(5)
    ]
    lines += [f"test/g/{row}.png,gallery,{row},46.000{row},7.0" for row in range(8)]
    (tmp_path / "paths.csv").write_text("\n".join(lines) + "\n")
    for row in range(0, 8, 2):  # the others are placeholders
        small_worlds.write(tmp_path / "test" / "g" / f"{row}.png", layouts.small(row))
    options = (
        str(tmp_path / "q.npy"),
        "--gallery",
        str(tmp_path / "g.npy"),
        "--paths",
        str(tmp_path / "paths.csv"),
    )
    with started(tmp_path, tmp_path, tmp_path / "cache", default=True, options=options) as running:
        explorer = ExplorerPage(new_page())
        explorer.open(running.url)
        header = explorer.page.locator("#lpn-header")
        for text in ("q.npy", "n = 2, no network", "5 queries", "8 tiles"):
            expect(header).to_contain_text(text)
        expect(explorer.page.locator("#lpn-saved")).to_contain_text("do not say where a part lies")
        for label in ("Parts", "Take apart", "Heatmap"):
            expect(explorer.page.locator(f'label:text-is("{label}")')).to_have_count(0)
        unit = [side / np.linalg.norm(side, axis=2, keepdims=True) for side in (query, places)]
        order = np.argsort(-np.einsum("nd,gnd->g", unit[0][3], unit[1]), kind="stable")
        explorer.fill("Find name", "street/3")
        explorer.expect_status("name", "street/3")

        def shows_the_order() -> None:
            rows = explorer.rows.evaluate_all("rows => rows.map(row => row.dataset.index)")
            assert rows[:8] == [str(tile) for tile in order]

        explorer.eventually(shows_the_order)
        explorer.key("b")
        expect(explorer.page.locator("#lpn-lab-table")).to_contain_text("street/0")
