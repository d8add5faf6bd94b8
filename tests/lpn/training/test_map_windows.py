from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from rich.console import Console

import lpn
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.flight.files.cameras import rotation
from lpn.flight.maps import Map, Window, open_map
from lpn.training import augmentation as appearance
from lpn.training.loader import Loader, TrainingBatch
from lpn.training.map_windows import GroundPicture, MapWindows, draw_photo, overlaps
from lpn.training.recipe import Recipe
from lpn.training.recipes import RECIPES
from lpn.training.trainer import Trainer
from tests.conftest import Refused
from tests.lpn.flight.maps import small_maps
from tools.fixtures.trainings import losses, make_resnets_shallow

pytest.importorskip("rasterio")

CPU = torch.device("cpu")
RECIPE = replace(RECIPES["map"], size=64, windows=12, batch=4, seed=3)
QUICK = replace(RECIPE, size=32, windows=16, epochs=3, batch=8, warmup_epochs=0, precision="float32", lr=1e-3, ema=0.0)
# A map without any change but the camera's place.
PLAIN = replace(RECIPE, **dict.fromkeys(("colour", "season", "bands", "shadows", "occlusion", "blur", "noise"), 0.0))
PIXELS = 120


@pytest.fixture(scope="module")
def ramp(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """A map of a metre a pixel whose red tells the column and whose green tells the row, each in steps of two."""
    rows, columns = np.mgrid[:PIXELS, :PIXELS].astype(np.uint8)
    picture = np.stack([2 * columns + 8, 2 * rows + 8, np.full_like(rows, 99)], axis=2)
    return open_map(
        small_maps.write_geotiff(
            tmp_path_factory.mktemp("ramp") / "ramp.tif",
            picture,
            matrix=(1, 0, small_maps.EAST, 0, -1, small_maps.NORTH),
        )
    )


@pytest.fixture(scope="module")
def town(tmp_path_factory: pytest.TempPathFactory) -> Map:
    """A map of smooth waves and boxes, 160 m a side, of which the south-west has no data."""
    rng = np.random.default_rng(0)
    picture = small_maps.smooth(320, 320)
    for _ in range(150):
        x, y = rng.integers(0, 300, 2).tolist()
        cv2.rectangle(picture, (x, y), (x + 14, y + 9), rng.uniform(20, 235, 3).tolist(), -1)
    picture[220:, :100] = 0
    return open_map(small_maps.write_geotiff(tmp_path_factory.mktemp("town") / "town.tif", picture, nodata=0))


def places_of(ramp: Map, picture: UInt8Array) -> Float64Array:
    """Metres east and north, (H, W, 2), that the colours of a picture of the ramp tell."""
    west, _, _, north = ramp.bounds
    cells = (picture[..., :2].astype(np.float64) - 8) / 2 + 0.5
    return np.stack([west + cells[..., 0], north - cells[..., 1]], axis=2)


def test_the_drone_view_shows_the_ground_that_its_rays_meet(ramp: Map) -> None:
    recipe = replace(PLAIN, size=32, tilt=12.0, rotation=0.0)
    window = Window(4.0, -6.0, 40.0)
    ground = GroundPicture.read(ramp, window, recipe.size)
    for seed in (1, 2, 3):
        shot = draw_photo(window, recipe, np.random.default_rng(seed))
        # The square keeps the photo's top, so its pixels lie on a grid of the photo's.
        shot = replace(shot, heading=0.0)
        found = places_of(ramp, ground.photo(shot, recipe.size))
        frame, metres = shot.frame, shot.frame.height_above_ground or 0.0
        v, u = np.mgrid[: recipe.size, : recipe.size] - (recipe.size - 1) / 2
        step = shot.share * frame.width / recipe.size
        focal = frame.width / 2 / np.tan(np.radians(frame.fov or 0.0) / 2)
        turn = rotation(frame.heading or 0.0, frame.pitch or 0.0, frame.roll or 0.0)
        rays = np.stack([-v * step, u * step, np.full(u.shape, focal)], axis=2) @ turn.T
        expected = (rays / rays[..., 2:] - turn[:, 2] / turn[2, 2])[..., 1::-1] * metres + shot.centre
        pixel = 40.0 / recipe.size
        off = np.linalg.norm(found - expected, axis=2)
        # A pixel is 1.25 m, and a grey level half a metre, to which the photo and the cut are rounded.
        assert off.max() < pixel
        assert np.abs((found - expected).mean(axis=(0, 1))).max() < 0.15 * pixel


def test_a_square_is_cut_with_the_windows_heading_up(ramp: Map) -> None:
    recipe = replace(PLAIN, tilt=0.0, rotation=0.0, shift=0.0, scale=0.0)
    for seed in range(4):
        window = Window(0.0, 0.0, 40.0, 37.0 * seed)
        shot, ground = draw_photo(window, recipe, np.random.default_rng(seed)), GroundPicture.read(ramp, window, 64)
        photo, tile = ground.photo(shot, 64), ground.tile(window, 64)
        inside = cv2.circle(np.zeros((64, 64), np.uint8), (32, 32), 28, 1, -1) > 0
        off = np.linalg.norm(places_of(ramp, photo) - places_of(ramp, tile), axis=2)[inside]
        assert off.mean() < 0.6


def test_a_tile_is_what_retrieval_cuts(town: Map) -> None:
    windows = MapWindows(town, PLAIN, (40.0, 60.0))
    for number, window in enumerate(windows.windows(0)):
        (tile,) = windows.draw(number, 0)["satellite"]
        cut = town.read(window, PLAIN.size)[0]
        # Mirrored views are mirrored back.
        assert min(np.abs(view.astype(int) - cut).mean() for view in (tile, tile[:, ::-1])) < 6


def test_ground_without_data_is_black_in_a_tile_and_not_in_a_photo(town: Map) -> None:
    west, south, *_ = town.bounds
    edge = Window(west + 50, south + 25, 40.0)
    ground = GroundPicture.read(town, edge, 64)
    black = (ground.tile(edge, 64) == 0).all(axis=2)
    assert (black ^ ~town.read(edge, 64)[1]).mean() < 0.03
    assert 0.2 < black.mean() < 0.8
    photo = ground.photo(draw_photo(edge, PLAIN, np.random.default_rng(0)), 64)
    assert (photo == 0).all(axis=2).mean() < 0.01


def test_windows_of_an_epoch_have_data_and_sizes_in_range(town: Map) -> None:
    windows = MapWindows(town, replace(RECIPE, windows=200), (30.0, 60.0))
    drawn = windows.windows(0)
    sizes = np.array([window.size for window in drawn])
    assert 30 <= sizes.min() < 33
    assert 55 < sizes.max() <= 60
    shares = [town.read(replace(window, heading=0.0), 20)[1].mean() for window in drawn[:60]]
    assert min(shares) > 0.6
    assert np.ptp([window.heading for window in drawn]) > 300
    assert drawn == MapWindows(town, replace(RECIPE, windows=200), (30.0, 60.0)).windows(0)
    assert (
        drawn != windows.windows(1) != MapWindows(town, replace(RECIPE, windows=200, seed=4), (30.0, 60.0)).windows(1)
    )


def batches(town: Map, workers: int, first: int = 0) -> list[TrainingBatch]:
    return list(Loader(MapWindows(town, RECIPE, (30.0, 60.0)), RECIPE, CPU, workers=workers).stream(first, 2))


def test_batches_depend_on_the_seed_and_the_epoch_alone(town: Map) -> None:
    one, many, resumed = batches(town, 1), batches(town, 4), batches(town, 2, first=1)
    assert len(one) == 6
    for a, b in [*zip(one, many, strict=True), *zip(one[3:], resumed, strict=True)]:
        assert torch.equal(a.overlaps, b.overlaps)
        assert all(torch.equal(a.sets[name], b.sets[name]) for name in ("satellite", "drone"))
    assert not torch.equal(one[0].sets["drone"], one[3].sets["drone"])
    assert one[0].sets["drone"].shape == (4, 3, 64, 64)


def test_windows_overlap_where_they_share_ground() -> None:
    rng = np.random.default_rng(5)
    windows = [Window(*rng.uniform(-60, 60, 2), rng.uniform(20, 50), rng.uniform(0, 360)) for _ in range(40)]
    found = overlaps([window.corners for window in windows])
    for i, one in enumerate(windows):
        for j, other in enumerate(windows):
            shared = cv2.intersectConvexConvex(one.corners.astype(np.float32), other.corners.astype(np.float32))[0]
            assert found[i, j] == (shared > 1e-3), (i, j)
    assert 0.1 < found.mean() < 0.9


def train(town: Map, out: Path, recipe: Recipe = QUICK, **options: object) -> tuple[Path, str]:
    said = io.StringIO()
    options.setdefault("from_scratch", "init" not in options)
    run = Trainer(town, out, recipe, console=Console(file=said, width=200), window_sizes=(30.0, 50.0), **options)
    return run.run(), said.getvalue()


def stop_after_two(history: list[object], _: int) -> str:
    if len(history) == 2:
        raise KeyboardInterrupt
    return ""


def test_a_training_lowers_the_loss_resumes_and_goes_on_from_its_model(
    town: Map, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    make_resnets_shallow(monkeypatch, first=2)
    model, _ = train(town, tmp_path / "whole")
    whole = losses(tmp_path / "whole")
    assert min(whole[2:]) < whole[0]
    loaded = lpn.load(model)
    assert (loaded.views, loaded.n_parts) == (("satellite", "drone"), 4)
    picture = loaded.prepare(town.read(Window(0, 0, 40), 32)[0], "satellite")
    assert np.isfinite(loaded.run(picture[None], "satellite").parts).all()

    with monkeypatch.context() as patch:
        patch.setattr("lpn.training.trainer.epoch_line", stop_after_two)
        with pytest.raises(KeyboardInterrupt):
            train(town, tmp_path / "half")
    train(town, tmp_path / "half", resume=True)
    assert losses(tmp_path / "half") == whole

    _, said = train(town, tmp_path / "more", replace(QUICK, epochs=1), init=model)
    assert "last.safetensors fills the heads of all 4 parts." in said
    assert losses(tmp_path / "more")[0] < whole[0]
    _, said = train(town, tmp_path / "other", replace(QUICK, epochs=1, n_parts=2), init=model)
    assert "has other parts (n_parts 4 instead of 2), so the heads of the parts start anew." in said


@pytest.mark.parametrize(
    ("sizes", "message"),
    [
        ((50.0, 30.0), "The windows are 50 to 30 m wide; expected two numbers above 0, the smaller one first."),
        ((0.0, 30.0), "expected two numbers above 0"),
        ((30.0, 100.0), "too large for the map town, which is 160 m by 160 m; give at most 80 m"),
    ],
)
def test_windows_that_do_not_fit_are_refused(town: Map, sizes: tuple[float, float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        MapWindows(town, RECIPE, sizes)


def test_a_map_without_enough_data_is_refused(town: Map, tmp_path: Path) -> None:
    picture = np.zeros((200, 200, 3), np.uint8)
    picture[:, 95:105] = 90
    strip = open_map(small_maps.write_geotiff(tmp_path / "strip.tif", picture, nodata=0))
    with pytest.raises(DataError, match="has no window of up to 50 m with data on 75% of it"):
        MapWindows(strip, RECIPE, (30.0, 50.0))
    picture[:, 70:130] = 90
    wider = open_map(small_maps.write_geotiff(tmp_path / "wider.tif", picture, nodata=0))
    low, high = MapWindows(wider, RECIPE).sizes
    assert low == pytest.approx(16, rel=0.01)
    assert 30 < high < 41
    # Else they follow from the resolution, up to half of the map.
    assert MapWindows(town, RECIPE).sizes == pytest.approx((16.0, 64.0), rel=0.01)
    assert MapWindows(town, replace(RECIPE, size=256)).sizes == pytest.approx((40.0, 80.0), rel=0.01)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "give either --data or --map"),
        (["--map", "{map}", "--data", "{data}"], "give either --data or --map"),
        (["--data", "{data}", "--window-sizes", "30", "50"], "give --window-sizes with --map only"),
        (["--data", "{data}", "--recipe", "map"], "give --map in place of --data"),
        (["--map", "{map}", "--recipe", "small"], "give --recipe map with --map"),
        (["--map", "{map}", "--validate", "0.1"], "leave --evaluate-every and --validate out"),
        (["--map", "{map}", "--method", "lpn"], "leave --method lpn out"),
    ],
)
def test_the_command_refuses_in_one_sentence(
    town: Map, data: Path, tmp_path: Path, refused: Refused, arguments: list[str], message: str
) -> None:
    given = [word.format(map=town.sheets[0].raster.path, data=data) for word in arguments]
    assert message in refused("train", *given, "--out", tmp_path / "run", "--from-scratch")
    assert not (tmp_path / "run").exists()


def test_each_change_of_appearance_is_what_it_says(town: Map) -> None:
    picture = town.read(Window(0, 10, 60), 64)[0]
    rng = np.random.default_rng(0)
    grey = np.repeat(picture[..., :1], 3, axis=2)
    assert np.abs(appearance.mix_bands(grey, rng).astype(int) - grey).max() <= 1
    assert np.array_equal(appearance.change_season(grey, rng), grey)
    assert (appearance.cast_shadows(picture, rng) <= picture).all()
    assert np.abs(appearance.blur(picture, rng).astype(int) - picture).mean() > 0.3
    hidden = (appearance.occlude(picture, rng) != picture).any(axis=2).mean()
    assert 0 < hidden < 0.5
    flat = np.full((64, 64, 3), 128, np.uint8)
    assert appearance.add_noise(flat, 8.0, rng).std() == pytest.approx(8.0, rel=0.1)
    assert (appearance.cast_shadows(flat, rng).min(), appearance.cast_shadows(flat, rng).max()) != (128, 128)
