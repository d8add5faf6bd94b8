from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from lpn.datasets import Picture, geo, open_dataset
from lpn.datasets.geo import Position, Positions
from lpn.drawing import mosaic
from lpn.tasks.gallery_geometry import GalleryGeometry
from tools.fixtures import small_worlds


def laid_out(root: Path) -> tuple[GalleryGeometry, list[Path]]:
    dataset, where = open_dataset(root), Positions(root)
    queries, gallery = dataset.queries("drone"), dataset.gallery("satellite")
    return GalleryGeometry.of(where.of(queries), where.of(gallery)), [picture.path for picture in gallery]


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_worlds.map_dataset(small_worlds.make_dataset(tmp_path_factory.mktemp("mapped") / "places"))


def test_tiles_lie_where_their_positions_say(root: Path) -> None:
    laid, _ = laid_out(root)
    assert laid.width == 90
    np.testing.assert_allclose(
        laid.ground[0] - laid.ground[1], geo.on_plane(laid.tiles[:1], laid.tiles[1])[0], rtol=1e-3
    )
    west, south, east, north = laid.bounds()
    assert west == pytest.approx(laid.ground[:, 0].min() - 45)
    assert north == pytest.approx(laid.ground[:, 1].max() + 45)
    assert (east - west, north - south) == pytest.approx((3 * 100 + 90, 4 * 100 + 90), rel=0.02)
    np.testing.assert_allclose(laid.errors_m(3), geo.metres([laid.queries[3]] * 14, laid.tiles))
    assert laid.errors_m(3)[3] == pytest.approx(0, abs=1e-6)
    found = laid.answer_errors_m(np.where(np.arange(len(laid.queries)) == 2, -1, 0))
    assert np.isinf(found).tolist() == [query == 2 for query in range(len(found))]
    assert found[1] == pytest.approx(laid.errors_m(1)[0])


def test_the_picture_of_all_tiles_shows_each_at_its_place(tmp_path: Path) -> None:
    colours = [(200, 30, 30), (30, 200, 30), (30, 30, 200)]
    files = []
    for i, colour in enumerate(colours):
        small_worlds.write(tmp_path / f"{i}.png", np.full((40, 40, 3), colour, np.uint8))
        files.append(Picture(tmp_path / f"{i}.png", i, str(i)))
    tiles = [Position(0.0, 0.0, width=100), Position(0.003, 0.0, width=100), Position(0.0, 0.003, width=100)]
    laid = GalleryGeometry.of(tiles, tiles)
    picture = mosaic.draw(laid, files)
    west, south, east, north = laid.bounds()
    scale = mosaic.LARGEST / max(east - west, north - south)
    assert max(picture.shape[:2]) == mosaic.LARGEST
    for (x, y), colour in zip(laid.ground, colours, strict=True):
        assert picture[int((north - y) * scale), int((x - west) * scale)].tolist() == list(colour)
    assert picture[0, -1].max() < 60


def test_a_width_that_is_not_given_is_the_usual_distance() -> None:
    tiles = [Position(0.0, i * 0.001) for i in range(6)]
    assert GalleryGeometry.of(tiles, tiles).width == pytest.approx(111.3, abs=0.1)
    assert GalleryGeometry.of(tiles[:1], tiles[:1]).width == 100


def test_several_pictures_of_a_place_are_no_neighbours(tmp_path: Path) -> None:
    tiles = [Position(0.0, place * 0.001) for place in (0, 0, 1, 1, 2, 2)]
    laid = GalleryGeometry.of(tiles, tiles)
    assert laid.width == pytest.approx(111.3, abs=0.1)
    assert laid.places.tolist() == [0, 2, 4]
    assert GalleryGeometry.of(tiles[:2], tiles[:2]).width == 100
    files = [tmp_path / f"{index}.png" for index in range(len(tiles))]
    for index, file in enumerate(files):
        small_worlds.write(file, np.full((8, 8, 3), 100 + 20 * index, np.uint8))
    picture = mosaic.draw(laid, [Picture(file, 0, file.name) for file in files])
    middle = picture[picture.shape[0] // 2, :, 0]
    assert [int(middle[round(part * len(middle))]) for part in (1 / 6, 3 / 6, 5 / 6)] == [100, 140, 180]
    files[2].write_bytes(files[2].read_bytes()[:30])  # damaged: the ground shows there
    middle = mosaic.draw(laid, [Picture(file, 0, file.name) for file in files])[picture.shape[0] // 2, :, 0]
    assert [int(middle[round(part * len(middle))]) for part in (1 / 6, 5 / 6)] == [100, 180]
    assert int(middle[len(middle) // 2]) == mosaic._EARTH[0]
