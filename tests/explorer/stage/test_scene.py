"""The 3-D stage of a running app."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from unittest.mock import MagicMock

import numpy as np
import pytest

from explorer.app import App
from explorer.opening import open_model
from explorer.stage import scene
from lpn.drawing.part_areas import PartAreas
from lpn.models.partition import Partition
from tools.fixtures.websocket_client import WebSocketClient


@pytest.fixture
def page(data: Path, model_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[WebSocketClient]:
    """A page of the app."""
    monkeypatch.setenv("LPN_CACHE", str(tmp_path))
    app = App(open_model(data, model_file), "127.0.0.1", 0)
    try:
        with WebSocketClient(f"http://127.0.0.1:{app.server.get_port()}") as page:
            yield page.greet("?screen=all")
    finally:
        app.close()


def test_a_position_is_sent_although_the_page_reports_it_while_another_is_under_way(page: WebSocketClient) -> None:
    def framed(width: int, height: int, position: tuple[float, float, float]) -> tuple[float, float, float]:
        """Report a size and a position of the camera, and return the position that the server sets."""
        known = len(page.camera_positions)
        page.camera(image_width=width, image_height=height, position=position)
        page.wait(lambda: len(page.camera_positions) > known)
        return page.camera_positions[-1]

    wide = framed(1200, 600, (0.0, 0.0, 5.0))
    narrow = framed(300, 600, wide)
    assert narrow[2] > 1.9 * wide[2]
    # The page is wide again before it has moved its camera to `narrow`.
    assert framed(1200, 600, wide) == pytest.approx(wide)


def test_a_page_is_told_before_its_stage_that_it_needs_no_light(page: WebSocketClient) -> None:
    for kind in ("EnvironmentMapMessage", "EnableLightsMessage"):
        assert page.kinds.index(kind) < page.kinds.index("ImageMessage")
    assert page.kinds.count("EnableLightsMessage") == 1


def test_a_turn_around_the_pulled_rings_ends_with_them(page: WebSocketClient) -> None:
    page.tell("back", "?apart=1")
    page.wait(lambda: "apart=1" in (page.link or ""))
    page.camera(position=(4.0, 0.0, 3.0))
    known = len(page.camera_positions)
    page.tell("back", "?screen=first")
    page.wait(lambda: "screen=first" in (page.link or ""))
    page.tell("back", "?screen=all")
    page.wait(lambda: len(page.camera_positions) > known)
    assert page.camera_positions[-1][:2] == (0.0, 0.0)


def test_no_two_lines_between_pulled_parts_meet() -> None:
    rings = [(0.5 - half, 0.5 - half, 0.5 + half, 0.5 + half) for half in (0.125, 0.25, 0.375, 0.5)]
    rows = [(0.0, top, 1.0, top + 0.25) for top in (0.0, 0.25, 0.5, 0.75)]
    for boxes in (rings, rings[::-1], rows, []):
        heights = sorted(scene._line_height(part, 4, boxes) for part in range(4))
        assert np.diff(heights).min() > 0.1
        for part, (_, top, _, bottom) in enumerate(boxes):
            assert 0.5 - bottom < scene._line_height(part, 4, boxes) < 0.5 - top
    assert scene._line_height(0, 1, [(0.0, 0.0, 1.0, 1.0)]) == 0


@pytest.mark.parametrize("outside_in", [False, True])
def test_the_smaller_a_pulled_ring_the_nearer_it_stands_to_the_camera(outside_in: bool) -> None:
    areas = PartAreas.of_partition(Partition("rings", 4, outside_in=outside_in), (16, 16))
    picture, blank = scene.StagePicture(MagicMock(), "query", 4), np.zeros((64, 64, 3), np.uint8)
    picture.show(blank, blank, areas, True, 1.0)
    widths = [right - left for left, _, right, _ in areas.boxes]
    assert widths == sorted(widths, reverse=outside_in)
    depths = [picture.depth(part, True) for part in range(4)]
    assert depths == sorted(depths, reverse=not outside_in)
