from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from explorer.feeds import Feeds
from explorer.flight import pictures as pictures_module
from explorer.flight.pictures import TILE, FlightPicturesFeed, TilePyramid, ground_window, tile
from explorer.server.picture_route import PREFIX
from lpn.core.arrays import AnyArray
from lpn.core.errors import DataError
from lpn.flight.files.lenses import Lens
from lpn.flight.locate.located import LocatedFlight
from lpn.flight.maps import Window, open_map
from tests.lpn.flight.maps.small_maps import smooth, write_geotiff


class Served:
    """A flight's pictures, loaded as the page does."""

    def __init__(self, flight: LocatedFlight) -> None:
        self.feeds = Feeds()
        self.addresses = FlightPicturesFeed(self.feeds, lambda: flight).addresses

    def bytes(self, folder: str, number: int) -> bytes:
        compute = self.feeds.find(f"{folder.removeprefix(PREFIX.lstrip('/'))}{number}")
        found = compute()
        if found.mime != "application/json":
            assert found.mime == ("image/webp" if found.data[8:12] == b"WEBP" else "image/jpeg")
        return found.data

    def picture(self, folder: str, number: int) -> AnyArray:
        """Return a picture, BGR or BGRA."""
        return cv2.imdecode(np.frombuffer(self.bytes(folder, number), np.uint8), cv2.IMREAD_UNCHANGED)


@pytest.fixture
def served(flight: LocatedFlight) -> Served:
    return Served(flight)


def test_tiles_of_a_level_cover_the_map_without_gap_or_overlap(flight: LocatedFlight) -> None:
    pyramid = TilePyramid.of(flight.basemap)
    west, south, east, north = flight.basemap.bounds
    assert pyramid.side == pytest.approx(max(east - west, north - south))
    # 400 pixels need two tiles of 256.
    assert pyramid.levels == 1
    whole, first, final = pyramid.window(0, 0, 0), pyramid.window(1, 0, 0), pyramid.window(1, 1, 1)
    assert (whole.x - whole.size / 2, whole.y + whole.size / 2) == pytest.approx((west, north))
    assert (first.x + first.size / 2, first.y - first.size / 2) == pytest.approx((whole.x, whole.y))
    assert (final.x - final.size / 2, final.y + final.size / 2) == pytest.approx((whole.x, whole.y))


def test_a_tile_shows_its_window_and_is_transparent_where_the_map_is_unknown(
    flight: LocatedFlight, served: Served
) -> None:
    tiles = served.addresses["tiles"]
    shown = served.picture(tiles[1], 1)
    window = TilePyramid.of(flight.basemap).window(1, 1, 0)
    expected, valid = flight.basemap.read(window, TILE)
    assert shown.shape[:2] == (TILE, TILE)
    assert np.abs(shown[..., 2::-1].astype(int) - expected)[valid].mean() < 3
    edge = served.picture(tiles[1], 0)
    # The western 20 m of a tile of 100 m are not valid.
    assert edge[10:100, :40, 3].max() == 0
    assert edge[10:100, 60:, 3].min() == 255


def test_coarse_tiles_of_a_large_map_are_cut_from_one_overview(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ground = smooth(600, 1200)
    mask = np.full((600, 1200, 1), 255, np.uint8)
    mask[:, :300] = 0
    town = open_map(write_geotiff(tmp_path / "large.tif", np.dstack([ground, mask])))
    monkeypatch.setattr(pictures_module, "TILE", 32)
    monkeypatch.setattr(pictures_module, "OVERVIEW", 256)
    monkeypatch.setattr(pictures_module, "_COARSE", 3)
    monkeypatch.setattr("lpn.flight.maps.map.OVERVIEW", 256)
    pyramid = TilePyramid.of(town)
    places = [(0, 0, 0), (1, 1, 0), (3, 2, 1), (3, 7, 3), (3, 7, 4)]
    windows = [pyramid.window(*place) for place in places]
    expected = [town.read(window, 32) for window in windows]
    town.overview(256)
    reads: list[Window] = []
    read = town._read
    monkeypatch.setattr(town, "_read", lambda window, *rest: reads.append(window) or read(window, *rest))
    for place, (picture, valid) in zip(places, expected, strict=True):
        found, known = tile(town, pyramid, *place)
        assert (known != valid).mean() < 0.05, place
        both = known & valid
        assert np.abs(found.astype(int) - picture)[both].mean() < 3 if both.any() else not valid.any(), place
    assert not reads
    tile(town, pyramid, 4, 8, 4)
    assert len(reads) == 1

    def damaged(_: int) -> None:
        raise DataError("The tile 3.png cannot be read.")

    monkeypatch.setattr(town, "overview", damaged)
    assert (tile(town, pyramid, 1, 1, 0)[0] == expected[1][0]).all()


def test_a_photo_and_the_ground_there_are_the_same_scene(flight: LocatedFlight, served: Served) -> None:
    folders = served.addresses
    assert served.picture(folders["photo"], 0).shape == (60, 80, 3)
    assert served.picture(folders["square"], 0).shape[:2] == served.picture(folders["ground"], 0).shape[:2]
    found = ground_window(flight.frames[0], "registration")
    # The square of the photo's shorter side: 60 of 80 pixels of 40 m, about the registered middle.
    assert (found.x, found.y, found.size) == pytest.approx((-20.0, 1.0, 30.0))
    assert ground_window(flight.frames[2], "sequence") == Window(20.0, 5.0, 60.0, 0.0)
    assert ground_window(flight.frames[2], "registration") is None
    assert ground_window(flight.frames[2], None) is None


def test_a_photo_is_laid_over_the_map_without_the_distortion_of_its_lens(flight: LocatedFlight, tmp_path: Path) -> None:
    """A vertical edge near the border is bent by the lens. Photo, photo beside the map, and homography are of a pinhole."""
    lens = Lens(0.6, 0.6, 0.0, 0.0, k1=-0.1)
    straight = np.zeros((600, 800, 3), np.uint8)
    straight[:, 160:] = 255
    cv2.imwrite(str(tmp_path / "a.png"), straight)
    located = replace(flight.frames[0], frame=replace(flight.frames[0].frame, file=tmp_path / "a.png", lens=lens))
    served = Served(replace(flight, frames=[located]))
    for kind, rows in (("photo", (300, 20)), ("square", (110, 5))):
        picture = served.picture(served.addresses[kind], 0)[..., 0]
        middle, top = (int(np.argmax(picture[row] > 127)) for row in rows)
        assert top < middle - 1
    bent = lens.undistorted(straight)
    assert np.abs(served.picture(served.addresses["photo"], 0).astype(int) - bent).mean() < 2


def test_a_number_beyond_the_flight_or_the_map_has_no_picture(served: Served) -> None:
    folders = served.addresses
    assert all(served.bytes(folders[kind], 3) == b"[]" for kind in ("photo", "square", "ground"))
    assert served.bytes(folders["tiles"][1], 4) == b"[]"
