"""A small flight over a small map, with answers of all stages that were made up."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from explorer.flight.service import SharedFlight
from lpn.flight.files import Flight, Frame
from lpn.flight.locate.audit import TagAudit
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.retrieval import FrameViews, MapRetrieval, WindowGallery, WindowRecord
from lpn.flight.maps import Window, open_map
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff

# Metres from one frame to the next, and width of a photo on the ground.
STEP, WIDTH = 20.0, 40.0
SIZE = (80, 60)


def registered(x: float, y: float, radius: float = 1.0) -> StageRecord:
    """A registration of a north-up photo about a place."""
    scale = WIDTH / SIZE[0]
    matrix = [scale, 0, x - scale * (SIZE[0] - 1) / 2, 0, -scale, y + scale * (SIZE[1] - 1) / 2, 0, 0, 1]
    return StageRecord("accepted", "40 matches agree.", x, y, True, radius, 0.0, 0.0, WIDTH, 40, matrix)


@pytest.fixture(scope="session")
def flight(tmp_path_factory: pytest.TempPathFactory) -> LocatedFlight:
    """Three frames from west to east: registered, registered far from its tag, and refused with a nasty sentence.

    The map is 200 m wide and 120 m high, in pixels of 0.5 m, and its western 20 m are not valid.
    """
    pytest.importorskip("rasterio")
    folder = tmp_path_factory.mktemp("flight")
    ground = smooth(240, 400)
    mask = np.full((240, 400, 1), 255, np.uint8)
    mask[:, :40] = 0
    town = open_map(write_geotiff(folder / "town.tif", np.dstack([ground, mask])))
    frames = []
    for i in range(3):
        file = folder / f"photo{i}.png"
        cv2.imwrite(str(file), cv2.resize(ground, SIZE))
        tag = np.array([(i - 1) * STEP, 0.0])
        name = file.name if i < 2 else "<b>photo2</b>.png"
        known = {"heading": 0.0, "heading_source": "gimbal", "pitch": -90.0, "roll": 0.0, "fov": 60.0}
        frame = Frame(name, file, *SIZE, 2.0 * i, *town.frame.degrees([tag])[0].tolist(), 30.0 + i, **known)
        frames.append(LocatedFrame(frame, tag))
    places = np.array([(x, y) for y in (30.0, 0.0, -30.0) for x in (-60.0, -30.0, 0.0, 30.0, 60.0)])
    for i, located in enumerate(frames):
        located.windows = [WindowRecord(0.0, 0.0, 60.0, 0.5 + i / 10, 0.0, [0.5, 0.5], [0.5, 0.5])]
        located.stages["retrieval"] = StageRecord("not verified", "A window; not verified.", 0.0, 0.0, heading=0.0)
        located.stages["sequence"] = StageRecord("accepted", "Its neighbours agree.", (i - 1) * STEP, 5.0, radius=10.0)
    frames[0].stages["registration"] = registered(-STEP, 1.0)
    frames[1].stages["registration"] = registered(45.0, 0.0)
    frames[2].stages["registration"] = StageRecord("refused", "Only <i>4</i> matches agree.")
    gallery = WindowGallery(
        [Window(x, y, 60.0) for x, y in places.tolist()], 0.75, np.zeros((len(places), 2, 4), np.float32)
    )
    described = [np.zeros((1, 2, 4), np.float32)] * 3
    retrieval = MapRetrieval(gallery, [FrameViews(60.0, 1.0, [0.0])] * 3, list(described), 32, {})
    whole = Flight("monday", tuple(located.frame for located in frames), ("A note.",))
    return LocatedFlight(whole, town, frames, TagAudit(2, 22.0, 45.0), ["Said."], retrieval)


def shared_flight(flight: LocatedFlight, root: Path) -> SharedFlight:
    """The flight of a workspace whose corrections lie in a folder."""
    return SharedFlight(SimpleNamespace(flight=flight, root=root))
