"""The parts that are drawn on the ranked tiles: those of each tile, found in the background."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from explorer.compute.request_context import RequestContext
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.stage.cards import Cards
from explorer.workspace import StateAnalyser, StateAnalysis, Workspace
from lpn import retrieval
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.views import View
from lpn.drawing import overlays, theme
from lpn.drawing.part_areas import PartAreas
from lpn.models.contract import ForwardPass
from tools.fixtures import small_worlds
from tools.fixtures.small_contracts import RegionModel
from tools.fixtures.waiting import wait_until

TASK = "drone-to-satellite"
# Width of the frame around a card, which borders of parts may lie under.
_FRAME = 8


class CountingModel(RegionModel):
    """Counts the tiles and mirror images of tiles that it describes."""

    tiles = 0

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        self.tiles += len(images) * (view == "satellite")
        return super().run(images, view)


class Scene:
    """Keeps the newest picture of each plane."""

    def __init__(self) -> None:
        self.planes: dict[str, SimpleNamespace] = {}

    def add_image(self, name: str, image: UInt8Array, *_: Any, **__: Any) -> SimpleNamespace:
        self.planes[name] = SimpleNamespace(image=image, visible=True, position=(0, 0, 0), on_click=lambda _: None)
        return self.planes[name]

    def add_line_segments(self, _: str, points: Float32Array, colors: UInt8Array, **__: Any) -> SimpleNamespace:
        assert points.shape == colors.shape
        return SimpleNamespace(points=points, colors=colors, visible=True, position=(0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.make_dataset(tmp_path_factory.mktemp("cards") / "places", train=1, test=6)


@pytest.fixture
def workspace(data: Path) -> Workspace:
    return open_model(data, CountingModel())


@pytest.fixture
def shown(workspace: Workspace) -> Iterator[tuple[Cards, Scene]]:
    scene = Scene()
    model = RequestContext(workspace.inference).queued(workspace.model, background=True)
    cards = Cards(scene, workspace, lambda *_: None, model)  # type: ignore[arg-type]
    cards.place(workspace.layout)
    yield cards, scene
    cards.leave()


def analysed(workspace: Workspace, **changes: Any) -> StateAnalysis:
    state = SessionState(TASK, workspace.contract.n_parts)
    return StateAnalyser(workspace).analyse(replace(state, **changes), 10)


def photo(workspace: Workspace, scene: Scene, slot: int) -> UInt8Array:
    """Return a card's photo as it is drawn, without its frame."""
    layout = workspace.layout
    row = scene.planes[f"/cards{slot // layout.columns}/photos"].image
    width, height = layout.card_pixels
    left = round(slot % layout.columns * width * layout.step[0] / layout.card[0])
    return row[:height, left : left + width][_FRAME:-_FRAME, _FRAME:-_FRAME]


def expected(workspace: Workspace, analysis: StateAnalysis, slot: int, areas: PartAreas | None) -> UInt8Array:
    match = analysis.matches[slot]
    drawn = overlays.with_parts(workspace.card(analysis.task, match.index), areas, 1)
    return overlays.framed(drawn, theme.verdict_colour(match.true), _FRAME)[_FRAME:-_FRAME, _FRAME:-_FRAME]


def test_each_card_has_the_parts_of_its_own_tile(workspace: Workspace, shown: tuple[Cards, Scene]) -> None:
    cards, scene = shown
    analysis = analysed(workspace)
    cards.show(analysis)
    of_tiles = [
        retrieval.describe_picture(RegionModel(), analysis.task.gallery[match.index].load_cropped(), "satellite")
        for match in analysis.matches
    ]
    areas = [workspace.areas("satellite", tile) for tile in of_tiles]
    assert len(areas) == 6
    drawn = [expected(workspace, analysis, slot, one) for slot, one in enumerate(areas)]
    swapped = expected(workspace, analysis, 0, areas[1])
    assert (swapped != drawn[0]).any()  # areas differ from tile to tile
    wait_until(lambda: all((photo(workspace, scene, slot) == drawn[slot]).all() for slot in range(6)))


def test_tiles_are_described_once_and_only_where_parts_are_shown(
    workspace: Workspace, shown: tuple[Cards, Scene]
) -> None:
    cards, scene = shown
    analysis = analysed(workspace, rings=False)
    assert workspace.model is not None
    counting = workspace.model.model
    assert isinstance(counting, CountingModel)
    before = counting.tiles
    cards.show(analysis)
    plain = expected(workspace, analysis, 1, None)
    np.testing.assert_array_equal(photo(workspace, scene, 1), plain)
    assert counting.tiles == before
    ringed = analysed(workspace)
    cards.show(ringed)
    wait_until(lambda: all(workspace.known_tile_areas(ringed.task, match.index) for match in ringed.matches))
    # Each takes two passes, one of its mirror image. The compared tile was described for the pair.
    assert counting.tiles == before + 2 * 5
    cards.show(analysed(workspace, weights=(1.0, 1.0, 1.0, 0.5)))
    cards.show(analysis)
    wait_until(lambda: bool((photo(workspace, scene, 1) == plain).all()))
    assert counting.tiles == before + 2 * 5


def test_a_damaged_tile_has_no_parts_and_the_others_have_theirs(
    workspace: Workspace, shown: tuple[Cards, Scene], caplog: pytest.LogCaptureFixture
) -> None:
    cards, scene = shown
    analysis = analysed(workspace)
    damaged = analysis.matches[1].index
    gallery = list(analysis.task.gallery)
    gallery[damaged] = replace(gallery[damaged], path=Path("gone.png"))
    broken = replace(analysis, task=replace(analysis.task, gallery=gallery))
    cards.show(broken)
    others = [match.index for match in analysis.matches if match.index != damaged]
    wait_until(lambda: all(workspace.known_tile_areas(analysis.task, index) for index in others))
    assert workspace.known_tile_areas(analysis.task, damaged) is None
    last = len(analysis.matches) - 1
    areas = workspace.known_tile_areas(analysis.task, analysis.matches[last].index)
    wait_until(lambda: bool((photo(workspace, scene, last) == expected(workspace, broken, last, areas)).all()))
    assert not caplog.records


def test_parts_of_a_partition_take_no_forward_pass(data: Path, model_file: Path) -> None:
    workspace, scene = open_model(data, model_file), Scene()
    cards = Cards(scene, workspace, lambda *_: None, workspace.model)  # type: ignore[arg-type]
    cards.place(workspace.layout)
    analysis = analysed(workspace)
    cards.show(analysis)
    areas = workspace.areas("satellite")
    np.testing.assert_array_equal(photo(workspace, scene, 2), expected(workspace, analysis, 2, areas))
    assert areas is not None
    assert cards._worker._thread is None
