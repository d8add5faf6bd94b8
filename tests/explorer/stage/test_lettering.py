"""Heights of the texts on the stage, measured in its pictures."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

from explorer.layout import HEIGHT, layout_for
from explorer.opening import open_model
from explorer.session_state import SessionState
from explorer.stage.camera import FOV, SIGN_CAPTION, SIGN_PICTURE, Viewpoint
from explorer.stage.cards import _card_label
from explorer.stage.scene import Stage
from explorer.stage.viewport import Viewport
from explorer.workspace import StateAnalyser, Workspace
from lpn.drawing import captions
from lpn.drawing.theme import DARK
from tools.fixtures import small_worlds

# The stage of a phone of 390 x 844 above the sheet of panels, of a small notebook, and of a large screen.
SIZES = [(390, 388), (424, 600), (860, 820)]

# Rows of the bars in the pictures.
_BAR = 10


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory, model_file: Path) -> Workspace:
    places = small_worlds.make_dataset(tmp_path_factory.mktemp("lettering") / "places", train=1, test=12)
    return open_model(small_worlds.map_dataset(places), model_file)


class DrawnStage:
    """A stage whose pictures the test reads.

    Attributes:
        images: handles of the scene's images by their names.
    """

    def __init__(self, workspace: Workspace, width: int, height: int) -> None:
        self.images: dict[str, Any] = {}
        client: Any = MagicMock()
        client.camera.aspect = width / height
        client.scene.add_image.side_effect = self._add
        self.workspace, self.viewport = workspace, Viewport()
        self.viewport.resize(width, height)
        self.stage = Stage(client, workspace, lambda *_: None, None, self.viewport)

    def _add(self, name: str, image: Any, width: float, height: float, **_: Any) -> Any:
        self.images[name] = MagicMock(image=image, render_width=width, render_height=height)
        return self.images[name]

    def show(self, **choices: Any) -> None:
        state = SessionState("drone-to-satellite", 4, **choices)
        self.stage.show(StateAnalyser(self.workspace).analyse(state, 10))

    def text_heights(self, name: str, unit: float, rows: slice = slice(None)) -> list[float]:
        """The heights of a picture's lines of text in CSS pixels, without bars, given the CSS pixels of a stage unit."""
        handle = self.images[name]
        picture = np.asarray(handle.image, np.int64)[rows, ..., :3]
        ink = np.abs(picture - picture[0, -1]).max(axis=2) > 70
        edges = np.flatnonzero(np.diff(ink.any(axis=1).astype(int), prepend=0, append=0)).reshape(-1, 2)
        scale = handle.render_height * unit / handle.image.shape[0]
        return [float(end - start) * scale for start, end in edges if end - start > _BAR]


def digit_height(pixels: float) -> float:
    """The height of a digit of a text of some size."""
    _, top, _, bottom = captions.font(200).getbbox("0")
    return (bottom - top) / 200 * pixels


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_no_text_of_the_pair_is_smaller_than_twelve_pixels(workspace: Workspace, width: int, height: int) -> None:
    drawn = DrawnStage(workspace, width, height)
    drawn.show(heat=False)
    for name in ("/query_caption", "/tile_caption", "/cards0/labels"):
        heights = drawn.text_heights(name, height / HEIGHT, slice(0, 38) if "labels" in name else slice(None))
        assert heights, name
        assert min(heights) >= 0.94 * digit_height(12), (name, heights)


@pytest.mark.parametrize(("width", "height"), SIZES)
def test_no_text_of_the_map_is_smaller_than_twelve_pixels(workspace: Workspace, width: int, height: int) -> None:
    drawn = DrawnStage(workspace, width, height)
    drawn.show(map=True)
    unit = height * Viewpoint().sign_share(width / height, FOV)
    sign = drawn.images["/map/caption"]
    assert sign.render_width / sign.render_height == pytest.approx(SIGN_CAPTION / SIGN_PICTURE)
    heights = drawn.text_heights("/map/caption", unit)
    assert len(heights) >= 4
    assert min(heights) >= 0.94 * digit_height(12)
    for slot in range(10):
        tile = drawn.images[f"/map/tile{slot}"]
        shown = tile.render_width * unit
        patch = (np.asarray(tile.image)[7, 7:, :3] == (20, 20, 20)).all(axis=1)
        assert patch[:6].all(), "the number's patch"
        digits = np.asarray(tile.image)[8:, 9 : 9 + int(patch.argmin()), :3].min(axis=2) > 200
        rows = np.flatnonzero(digits[: int(0.9 * len(digits))].any(axis=1))
        assert (rows[-1] - rows[0] + 1) * shown / tile.image.shape[0] >= 0.9 * digit_height(12)


def test_a_text_without_room_is_the_shorter_one_or_left_out() -> None:
    _, draw = captions.caption(400, 40)
    wide, narrow = (draw.textlength(text, font=captions.font(20)) for text in ("1 centre", "1"))
    assert captions.fitted(draw, "1 centre", 20, wide, "1") == "1 centre"
    assert captions.fitted(draw, "1 centre", 20, narrow, "1") == "1"
    assert captions.fitted(draw, "satellite 0450", 20, 60, "satellite") == "satel..."
    assert captions.fitted(draw, "satellite 0450", 20, 20, "0450") == ""
    assert captions.fitted(draw, "46 m W, 18 m N, 37 m wide", 20, 80, "46 m W, 18 m N") == "", "46 m W is another place"


@pytest.mark.parametrize(("width", "height"), [(290, 390), (390, 304), *SIZES])
def test_a_rank_its_sign_and_its_distance_stand_apart(workspace: Workspace, width: int, height: int) -> None:
    layout = layout_for(workspace.contract.input_size, 4, (width, height))
    match: Any = SimpleNamespace(rank=10, true=False, distance2=1.141, contributions=np.zeros(4, np.float32))
    text = _card_label(layout, match, 2.0, DARK)[:39].astype(int)
    sign = np.flatnonzero((text[..., 2] - text[..., 0] > 60).any(axis=0))
    digits = np.flatnonzero((text.min(axis=2) > 120).any(axis=0))
    assert digits[digits < sign[0]].max() + 2 < sign[0]
    assert sign[-1] + 2 < digits[digits > sign[0]].min()


def test_the_stage_is_drawn_again_for_another_size(workspace: Workspace) -> None:
    drawn = DrawnStage(workspace, 860, 820)
    drawn.show()
    assert not drawn.stage.outgrown
    drawn.viewport.resize(390, 388)
    assert drawn.stage.outgrown
    drawn.show()
    assert not drawn.stage.outgrown
    drawn.show(map=True)
    drawn.viewport.resize(390, 380)
    assert drawn.stage.outgrown
