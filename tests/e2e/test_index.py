"""The app on an index of tiles."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import BrowserContext, Page, expect

import lpn
from lpn import datasets, retrieval
from lpn.cli.main import main
from lpn.descriptors import cached_descriptors
from lpn.retrieval import scoring
from tests.e2e.conftest import ExplorerPage, RunningApp, started


def _shown(explorer: ExplorerPage) -> list[tuple[str, str]]:
    """Name and distance of each ranked tile."""
    rows = explorer.page.locator("#lpn-matches .row .line")
    return [(line.split()[2], line.split()[3]) for line in rows.all_inner_texts()]


@pytest.mark.slow
def test_an_index_is_explored_as_its_data_set_is(
    app: RunningApp, new_page: Callable[[], Page], contexts: Callable[..., BrowserContext], tmp_path: Path
) -> None:
    tiles, store = app.data / "test" / "gallery_satellite", tmp_path / "store"
    for command in (
        ("describe", "--model", app.model, "--images", tiles, "--view", "satellite", "--out", store),
        ("index", "--descriptors", store, "--out", tmp_path / "index"),
    ):
        assert main([str(part) for part in command]) == 0
    model, dataset = lpn.load(app.model), datasets.open_dataset(app.data)
    gallery = dataset.gallery("satellite")
    query = next(one for one in dataset.queries("drone") if one.name == "0011")
    cosines = scoring.part_cosines(
        cached_descriptors(model, [query], "drone")[0], cached_descriptors(model, gallery, "satellite")
    )

    def expected(weights: tuple[float, ...]) -> list[tuple[str, str]]:
        ranking = retrieval.rank(cosines, scoring.part_weights(4, weights))
        return [(gallery[match.index].name, f"{match.distance2:.3f}") for match in ranking.top(10)]

    source = (str(tmp_path / "index"), "--data", app.data, "--model", app.model)
    with started(app.data, app.model, tmp_path / "cache", default=True, options=tuple(map(str, source))) as running:
        explorer = ExplorerPage(new_page())
        explorer.open(running.url)
        explorer.fill("Find name", "0011")
        explorer.expect_status("name", "0011")
        expect(explorer.page.locator("#lpn-gallery")).to_have_text("14 tiles")
        explorer.eventually(lambda: _check(_shown(explorer)[:10], expected((1, 1, 1, 1))))
        explorer.tab("Parts")
        explorer.tick("Part 1 centre", False)
        explorer.eventually(lambda: _check(_shown(explorer)[:10], expected((0, 1, 1, 1))))
        explorer.rows.nth(3).click()
        explorer.expect_status("chosen", str(explorer.rows.nth(3).get_attribute("data-index")))
        name = _shown(explorer)[3][0]
        explorer.eventually(lambda: _check(f"with={name}" in explorer.page.url, True))
        # The link opens in another browser.
        other = ExplorerPage(contexts().new_page())
        other.open(explorer.page.url)
        other.expect_status("name", "0011")
        expect(other.page.locator("#lpn-matches .row.chosen")).to_contain_text(name)
        explorer.key("b")
        expect(explorer.page.locator("#lpn-lab-table")).to_contain_text("0011")


def _check(found: object, wanted: object) -> None:
    assert found == wanted
