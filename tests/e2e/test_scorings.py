"""The switch between plain, calibrated, and CSLS in a browser."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from playwright.sync_api import BrowserContext, expect

from tests.e2e.conftest import ExplorerPage, RunningApp, started
from tests.explorer.test_scorings import write_places


@pytest.fixture
def scored_app(model_file: Path, tmp_path: Path) -> Iterator[RunningApp]:
    """The app on places that are calibrated before the page opens."""
    write_places(tmp_path / "places", 22)
    with started(tmp_path / "places", model_file, tmp_path / "cache", options=("--calibrate",)) as running:
        yield running


@pytest.mark.slow
def test_the_switch_ranks_anew_and_a_link_remembers_it(
    scored_app: RunningApp, contexts: Callable[..., BrowserContext]
) -> None:
    explorer = ExplorerPage(contexts().new_page())
    explorer.open(f"{scored_app.url}?query=0003/0003&why=1")
    switch = explorer.page.locator("#lpn-scorings a")
    expect(switch).to_have_count(3)
    expect(switch.nth(0)).to_have_class("chosen")  # a link without a choice
    plain = explorer.rows.all_inner_texts()
    shown = {}
    for position, name in ((2, "CSLS"), (1, "calibrated")):
        switch.nth(position).click()
        expect(switch.nth(position)).to_have_class("chosen")
        number = switch.nth(position).locator(".num").inner_text().strip()
        expect(explorer.page.locator("#lpn-header .big")).to_contain_text(number)
        explorer.eventually(lambda: _differs(explorer.rows.all_inner_texts(), plain, *shown.values()))
        shown[name] = explorer.rows.all_inner_texts()
        expect(explorer.page.locator("#lpn-parts tr", has_text="half the tile's")).to_have_count(int(name == "CSLS"))
    explorer.eventually(lambda: _contains(explorer.page.url, "scoring=calibrated"))
    other = ExplorerPage(contexts().new_page())
    other.open(explorer.page.url)
    expect(other.page.locator("#lpn-scorings a.chosen")).to_contain_text("calibrated")
    other.eventually(lambda: _equals(other.rows.all_inner_texts(), shown["calibrated"]))


def _differs(rows: list[str], *others: list[str]) -> None:
    assert rows
    assert all(rows != other for other in others)


def _contains(text: str, part: str) -> None:
    assert part in text


def _equals(one: object, other: object) -> None:
    assert one == other
