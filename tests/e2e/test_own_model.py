"""A registered model in a real browser: regions of each picture, and the reason where a model gives no cells."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest
from playwright.sync_api import Page, expect

from tests.e2e.conftest import ExplorerPage, difference, started

CODE = """
from tools.fixtures.small_contracts import PartsModel, RegionModel

def parts():
    return PartsModel(RegionModel())
"""


@pytest.mark.slow
def test_a_registered_model_shows_its_own_parts_and_names_its_level(
    data: Path, tmp_path: Path, new_page: Callable[[], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "own" / "own_models-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-models\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[lpn.models]\nregions = tools.fixtures.small_contracts:RegionModel\nparts = own_models:parts\n"
    )
    (info.parent / "own_models.py").write_text(CODE)
    root = Path(__file__).parents[2]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (info.parent, root))))
    with started(data, Path("regions"), tmp_path / "cache") as app:
        explorer = ExplorerPage(new_page())
        explorer.open(app.url)
        expect(explorer.page.locator("#lpn-header")).to_contain_text("Regions of brightness, n = 4")
        expect(explorer.page.locator("#lpn-keys")).to_contain_text("G parts")
        shown = explorer.stage()
        explorer.key("g")
        explorer.stage(lambda picture: difference(shown, picture) > 0.003)
        explorer.explain()
        why = explorer.page.locator("#lpn-why")
        expect(why).to_contain_text("Exact, with the regions of each picture held")
        expect(why).to_contain_text("No cell belongs to part 4 whole picture")
    with started(data, Path("parts"), tmp_path / "cache") as app:
        explorer = ExplorerPage(new_page())
        explorer.open(app.url)
        expect(explorer.page.locator("#lpn-without-cells")).to_contain_text("no cells (parts only")
        expect(explorer.field("Heatmap")).to_be_hidden()
        explorer.explain()
        expect(explorer.page.locator("#lpn-why")).to_contain_text(
            "its score cannot be split into places of the picture"
        )
