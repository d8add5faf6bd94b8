"""A data set whose queries are still being ranked when the page opens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from explorer.app import App
from explorer.compute import ranking_job
from explorer.opening import open_model
from tests.e2e.conftest import PATIENCE, ExplorerPage, classic
from tools.fixtures import small_worlds


@pytest.mark.slow
def test_a_page_works_before_all_queries_are_ranked_and_says_when_they_are(
    tmp_path: Path, model_file: Path, new_page: Callable[[], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("LPN_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(ranking_job, "QUICK_COST", 0)
    workspace = open_model(small_worlds.make_dataset(tmp_path / "places"), model_file)
    ranking = workspace.rankings["drone-to-satellite"]
    app = App(workspace, "127.0.0.1", 0)
    try:
        explorer = ExplorerPage(new_page())
        header, picker = explorer.page.locator("#lpn-header"), explorer.page.locator("#lpn-picker")
        with ranking._rank_lock:  # no ranking begins meanwhile
            explorer.open(classic(f"http://127.0.0.1:{app.server.get_port()}"))
            expect(header).to_contain_text("Results: ranking 0 of 14 queries")
            expect(picker.locator(".thumb b")).to_have_count(0)
            explorer.key("n")
            explorer.expect_status("query", "1")
            explorer.key("f")
            expect(explorer.page.get_by_text("All queries are still being ranked")).to_be_visible()
            explorer.key("b")
            expect(explorer.page.locator("#lpn-lab-waiting")).to_contain_text("Ranking 14 queries")
        assert ranking.join("test").wait(PATIENCE)
        expect(header).to_contain_text(f"{ranking.results['recall@1']:.1f} %")
        expect(picker.locator(".thumb b")).to_have_count(14)
        expect(explorer.page.locator("#lpn-lab-table")).to_be_visible()
        explorer.expect_status("query", "1")
    finally:
        app.close()
