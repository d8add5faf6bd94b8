"""What `lpn explore` opens, on the screen, beside the direct computation: arrays, an index, and registered models."""

from __future__ import annotations

import os
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from playwright.sync_api import Page, expect

import lpn
from lpn import datasets, retrieval
from lpn.cli.main import main
from lpn.core.arrays import Float32Array
from lpn.descriptors import cached_descriptors
from lpn.retrieval import scoring
from tests.e2e.conftest import RunningApp, Screen, started
from tools.fixtures import layouts, small_worlds

pytestmark = pytest.mark.slow

PARTS = """
from tools.fixtures.small_contracts import PartsModel, RegionModel

def parts():
    return PartsModel(RegionModel())
"""


def cosines_of(app: RunningApp, query: str) -> tuple[Float32Array, list[str]]:
    """The cosines of each part between a query and the satellite tiles, and the names of these."""
    model, dataset = lpn.load(app.model), datasets.open_dataset(app.data)
    gallery = dataset.gallery("satellite")
    photo = next(one for one in dataset.queries("drone") if one.name == query)
    described = (cached_descriptors(model, side, view) for side, view in (([photo], "drone"), (gallery, "satellite")))
    one, all_tiles = described
    return scoring.part_cosines(one[0], all_tiles), [tile.name for tile in gallery]


def expect_ranking(screen: Screen, cosines: Float32Array, names: list[str], weights: tuple[float, ...]) -> None:
    """Check names and distances of the first five tiles in the strip."""
    ranking = retrieval.rank(cosines, scoring.part_weights(cosines.shape[1], weights))
    for place, match in enumerate(ranking.top(5)):
        named = re.compile(f"{re.escape(names[match.index])}, distance {match.distance2:.3f}")
        expect(screen.tiles.nth(place)).to_have_attribute("aria-label", named)


def test_an_index_is_explored_as_its_data_set_is(app: RunningApp, new_page: Callable[[], Page], tmp_path: Path) -> None:
    tiles, store = app.data / "test" / "gallery_satellite", tmp_path / "store"
    for command in (
        ("describe", "--model", app.model, "--images", tiles, "--view", "satellite", "--out", store),
        ("index", "--descriptors", store, "--out", tmp_path / "index"),
    ):
        assert main([str(part) for part in command]) == 0
    cosines, names = cosines_of(app, "0011")
    source = (str(tmp_path / "index"), "--data", str(app.data), "--model", str(app.model))
    with started(app.data, app.model, tmp_path / "cache", default=True, options=source) as running:
        screen = Screen(new_page(), running.url).open("?query=0011")
        expect_ranking(screen, cosines, names, (1, 1, 1, 1))
        screen.open("?query=0011&weights=0,1,1,1")
        expect_ranking(screen, cosines, names, (0, 1, 1, 1))
        expect(screen.rows).to_have_count(4)


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
    options = [str(tmp_path / "q.npy"), "--gallery", str(tmp_path / "g.npy"), "--paths", str(tmp_path / "paths.csv")]
    unit = [side / np.linalg.norm(side, axis=2, keepdims=True) for side in (query, places)]
    cosines = np.einsum("nd,gnd->gn", unit[0][3], unit[1]).astype(np.float32)
    with started(tmp_path, tmp_path, tmp_path / "cache", default=True, options=options) as running:
        screen = Screen(new_page(), running.url).open("?query=street/3")
        expect(screen.rows).to_have_count(2)
        expect(screen.page.locator("#photo .key")).to_be_hidden()
        expect_ranking(screen, cosines, [str(row) for row in range(8)], (1, 1))
        assert not [one for one in screen.complaints if "404" not in one]


def test_a_registered_model_shows_its_own_parts_or_none(
    data: Path, tmp_path: Path, new_page: Callable[[], Page], monkeypatch: pytest.MonkeyPatch
) -> None:
    info = tmp_path / "own" / "own_models-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: own-models\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(
        "[lpn.models]\nregions = tools.fixtures.small_contracts:RegionModel\nparts = own_models:parts\n"
    )
    (info.parent / "own_models.py").write_text(PARTS)
    root = Path(__file__).parents[2]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (info.parent, root))))
    with started(data, Path("regions"), tmp_path / "cache") as app:
        screen = Screen(new_page(), app.url).open("?shows=evidence")
        expect(screen.page.locator("#about")).to_contain_text("cut into parts")
        expect(screen.rows).to_have_count(4)
        expect(screen.page.locator("#photo .key")).to_have_text(re.compile("against.*for"))
    with started(data, Path("parts"), tmp_path / "cache") as app:
        screen = Screen(new_page(), app.url).open()
        expect(screen.rows).to_have_count(4)
        expect(screen.page.locator("#photo .key")).to_be_hidden()
        assert not screen.complaints
