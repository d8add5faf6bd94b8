"""A map made of a flight's own photos."""

from __future__ import annotations

import math
import os
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import Image

from lpn.cli.main import main
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.flight.files import photos_of
from lpn.flight.locate.options import LocateOptions
from lpn.flight.locate.pipeline import locate
from lpn.flight.maps import LocalFrame, Window, open_map
from lpn.flight.maps.orthophoto import place_error
from tests.conftest import Refused
from tests.lpn.flight.maps.small_maps import write_geotiff
from tools.fixtures.photos import exif, write_photo

HERE = LocalFrame(48.0, 9.0)
# Metres of a pixel, and pixels of a photo.
PIXEL, WIDTH, HEIGHT = 0.2, 480, 360


def ground(side: int = 900, seed: int = 0) -> UInt8Array:
    """Ground with details of all sizes, (side, side, 3), whose middle is at HERE."""
    rng = np.random.default_rng(seed)
    layers = [
        cv2.resize(rng.normal(size=(side // k, side // k)), (side, side), interpolation=cv2.INTER_CUBIC)
        for k in (3, 9, 30, 100)
    ]
    grey = np.clip(128 + 30 * np.sum(layers, axis=0), 20, 235)
    return np.stack([grey, 0.9 * grey, 0.8 * grey], axis=2).astype(np.uint8)


def write_flight(folder: Path, picture: UInt8Array) -> Path:
    """Write nine photos over the ground in three rows; each shares half or more with its neighbours, and has its GPS tag."""
    middle = picture.shape[0] / 2
    for number in range(9):
        column, row = 60 + 165 * (number % 3), 80 + 170 * (number // 3)
        east = (column + WIDTH / 2 - middle) * PIXEL
        north = (middle - row - HEIGHT / 2) * PIXEL
        latitude, longitude = HERE.degrees([(east, north)])[0]
        file = write_photo(folder / f"photo_{number:02d}.jpg")
        tags = exif(float(latitude), float(longitude)).tobytes()
        Image.fromarray(picture[row : row + HEIGHT, column : column + WIDTH]).save(file, quality=95, exif=tags)
    return folder


def write_heights(path: Path, latitude: float = 48.0) -> str:
    """Write heights in metres, 1 m more every 0.001 degrees to the east, 0.02 degrees about a place."""
    heights = np.tile(300 + np.arange(200) * 0.1, (200, 1))[..., None].astype(np.float32)
    matrix = (0.0001, 0, 8.99, 0, -0.0001, latitude + 0.01)
    return str(write_geotiff(path, heights, "EPSG:4326", matrix=matrix))


def test_the_map_of_photos_shows_the_ground_at_its_place(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("orthomosaic")
    picture = ground()
    photos, out = write_flight(tmp_path / "photos", picture), tmp_path / "maps" / "here"
    heights = write_heights(tmp_path / "dsm.tif")
    assert main(["map", "--from-flight", str(photos), "--out", str(out), "--elevation", heights]) == 0
    printed = capsys.readouterr().out
    assert "Step 1 of 3" in printed
    assert "Step 3 of 3" in printed
    assert "is made of 9 photos as if the ground were flat" in printed
    assert sorted(path.name for path in out.iterdir()) == ["coverage.png", "map.json", "sheets"]
    assert list((tmp_path / "maps").iterdir()) == [out]
    made = open_map(out)
    assert made.resolution == pytest.approx(PIXEL, rel=0.02)
    assert made.error < 0.2
    assert made.place_error(None) == made.error
    assert made.place_error(made.default_error) == 0, "a person's own figure tells nothing of the map's place"
    assert any(f"an error of ± {made.error:.1f} m (1 sigma along each axis)" in note for note in made.notes)
    assert made.default_error == pytest.approx(math.hypot(1.0, made.error))
    east, north = made.frame.xy([48.0], [9.0])[0]
    np.testing.assert_allclose(made.heights(made.frame.xy([48.0, 48.0], [9.0, 9.0005])), [309.95, 310.45], atol=0.01)
    read, valid = made.read(Window(float(east), float(north), 60.0), 300)
    assert valid.all()
    shown = picture[300:600, 300:600, 0].astype(float)
    agreement = np.corrcoef(cv2.GaussianBlur(shown, (0, 0), 3).ravel(), read[..., 0].astype(float).ravel())[0, 1]
    assert agreement > 0.8


def laid_by(truth: Float64Array, tags: Float64Array) -> Float64Array:
    """Return places (N, 2) by the similarity that takes them to their tags."""
    z, w = truth @ (1, 1j), tags @ (1, 1j)
    turn = (np.conj(z - z.mean()) * (w - w.mean())).sum() / (np.abs(z - z.mean()) ** 2).sum()
    placed = w.mean() + turn * (z - z.mean())
    return np.stack([placed.real, placed.imag], axis=1)


@pytest.mark.parametrize("lag", [0.0, 6.0])
def test_the_error_of_a_map_is_that_of_its_place_by_the_tags(lag: float) -> None:
    """A flight of six legs there and back, 300 times, with tags that err by themselves, and by the same along each leg."""
    rng = np.random.default_rng(3)
    leg, step = np.divmod(np.arange(48), 8)
    truth = np.stack([20.0 * np.where(leg % 2, 7 - step, step), 25.0 * leg], axis=1)
    wrong, told = [], []
    for _ in range(300):
        tags = truth + rng.normal(0, 3, truth.shape) + lag * rng.normal(size=(6, 2))[leg]
        placed = laid_by(truth, tags)
        wrong.append(((placed - truth) ** 2).sum(axis=1).mean() / 2)
        error = place_error(placed, tags)
        told.append(error**2)
    # Tags that err by themselves make a map that does not bend look bent by a little.
    assert 0.8 < np.sqrt(np.mean(told) / np.mean(wrong)) < 1.6


def test_the_error_of_a_map_holds_its_bend() -> None:
    """A map whose second half lies up to 12 m beside its place, by tags that err by 3 m."""
    rng = np.random.default_rng(4)
    leg, step = np.divmod(np.arange(60), 10)
    truth = np.stack([20.0 * np.where(leg % 2, 9 - step, step), 25.0 * leg], axis=1)
    bend = 12 * np.sin(truth[:, 0] / 45)
    error = place_error(truth + np.stack([np.zeros(60), bend], axis=1), truth + rng.normal(0, 3, truth.shape))
    assert error == pytest.approx(np.sqrt((bend**2).mean() / 2), rel=0.3)


@pytest.mark.parametrize(("photos", "error"), [(8, None), (9, None), (30, None), (16, 4.0)])
def test_tags_of_one_leg_may_err_alike_and_do_not_tell_a_small_error(photos: int, error: float | None) -> None:
    """Legs of 8 photos, or one of 30, whose tags err by 1 m each, and by 8 m along the first leg and back along the second."""
    leg, step = np.divmod(np.arange(photos), 8 if photos < 30 else 30)
    truth = np.stack([20.0 * np.where(leg % 2, 7 - step, step), 25.0 * leg], axis=1)
    tags = truth + np.random.default_rng(5).normal(0, 1, truth.shape) + np.stack([8.0 - 16.0 * leg, 0.0 * leg], axis=1)
    assert place_error(laid_by(truth, tags), tags) == (None if error is None else pytest.approx(error, rel=0.5))
    # A map that bends by more than tags err says so on one leg, too.
    bend = np.stack([0 * step, 30 * np.sin(step / 3)], axis=1)
    assert (place_error(truth + bend, tags) or 0.0) > 5.0


def test_few_tags_and_tags_of_one_place_tell_no_error_and_one_far_off_does_not_count() -> None:
    places = np.array([[20.0 * (i % 5), 25.0 * (i // 5)] for i in range(10)])
    assert place_error(places[:4], places[:4]) is None
    assert place_error(np.zeros((9, 2)), places[:9]) is None
    far = places.copy()
    far[3] += 1000
    assert place_error(places, far) == pytest.approx(0, abs=1e-6)


def test_an_elevation_of_another_place_is_refused_before_the_map_is_made(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("orthomosaic")
    for number in range(3):
        write_photo(tmp_path / "photos" / f"{number}.jpg", exif(48.0 + 0.0002 * number, 9.0))
    elsewhere = write_heights(tmp_path / "dsm.tif", 50.0)
    command = ["map", "--from-flight", str(tmp_path / "photos"), "--out", str(tmp_path / "map")]
    assert main([*command, "--elevation", elsewhere]) == 2
    printed = capsys.readouterr()
    assert "covers none of the map, which lies about 48.00020, 9.00000" in printed.err
    assert "Step 1" not in printed.out
    assert not (tmp_path / "map").exists()


def test_the_extra_is_named_and_other_files_beside_a_flight_are_refused(
    tmp_path: Path, refused: Refused, monkeypatch: pytest.MonkeyPatch
) -> None:
    photo, made = write_photo(tmp_path / "photos" / "a.jpg", exif(48.0, 9.0)), ["--out", tmp_path / "map"]
    said = refused("map", photo, "--from-flight", photo, *made)
    assert "leave the other files and options, except --elevation, out" in said
    monkeypatch.setitem(sys.modules, "orthomosaic", None)
    assert "pip install 'lpn-explorer[maps]'" in refused("map", "--from-flight", photo.parent, *made)
    assert not (tmp_path / "map").exists()


@pytest.mark.parametrize(
    ("count", "tagged", "words"),
    [
        (0, True, "There is no photo in"),
        (1, True, "A map needs 3 photos at least, which overlap; found 1."),
        (4, False, "4 of 4 photos have no GPS tag, such as 0.jpg"),
        (4, True, "Too few of the 4 photos overlap"),
    ],
)
def test_photos_that_make_no_map_are_named_in_one_sentence(
    tmp_path: Path, refused: Refused, count: int, tagged: bool, words: str
) -> None:
    pytest.importorskip("orthomosaic")
    photos = tmp_path / "photos"
    photos.mkdir()
    for number in range(count):
        tags = exif(48.0 + 0.0002 * number, 9.0) if tagged else Image.Exif()
        Image.fromarray(ground(360, number + 1)).save(photos / f"{number}.jpg", exif=tags.tobytes())
    assert words in refused("map", "--from-flight", photos, "--out", tmp_path / "map")
    assert list(tmp_path.iterdir()) == [photos]


@pytest.mark.slow
def test_even_photos_of_caliterra_are_registered_on_a_map_of_the_odd_ones(tmp_path: Path) -> None:
    if "LPN_FLIGHTS" not in os.environ:
        pytest.skip("LPN_FLIGHTS names no folder of real flights")
    pytest.importorskip("orthomosaic")
    files = sorted((Path(os.environ["LPN_FLIGHTS"]) / "caliterra" / "photos").iterdir())[:30]
    assert main(["map", "--from-flight", *map(str, files[::2]), "--out", str(tmp_path / "map")]) == 0
    even = photos_of(files[1::2], "even")
    chosen = replace(even, frames=even.frames[2::4])
    located = locate(open_map(tmp_path / "map"), chosen, None, LocateOptions())
    assert [frame.stages["registration"].accepted for frame in located.frames] == [True] * 4
    assert max(frame.error("registration") or 99.0 for frame in located.frames) < 60
