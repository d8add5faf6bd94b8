"""Weathers of pictures: the same picture has the same weather; statistics measured of imgaug 0.4 (docs/weather.md) hold."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.descriptors import weather
from lpn.descriptors.transforms import Change
from lpn.descriptors.weather import CLEAR, WEATHERS, Weather, WeatherName
from tools.fixtures import small_worlds


@pytest.mark.parametrize("name", WEATHERS[1:])
def test_a_picture_has_the_same_weather_each_time_and_another_one_by_another_seed(name: WeatherName) -> None:
    picture = small_worlds.place(1)
    once = Weather(name).apply(picture)
    assert once.shape == picture.shape
    assert once.dtype == np.uint8
    np.testing.assert_array_equal(once, Weather(name).apply(picture.copy()))
    assert any((Weather(name, seed=seed).apply(picture) != once).any() for seed in (1, 2, 3))
    assert (once != picture).any()


def test_the_strength_is_the_share_of_the_weather() -> None:
    picture = small_worlds.place(2)
    whole, half = (Weather("fog+snow", strength).apply(picture).astype(int) for strength in (1, 0.5))
    assert np.abs(half - (whole + picture) / 2).max() <= 0.5
    assert Weather("rain", 0) == Weather("normal", 0.3, 7) == CLEAR
    assert CLEAR.apply(picture) is picture


def test_fog_is_the_same_alone_and_with_rain_and_under_any_turn() -> None:
    picture = small_worlds.place(3)
    foggy, both = (Change(90, weather=Weather(name)).apply(picture) for name in ("fog", "fog+rain"))
    np.testing.assert_array_equal(foggy, images.rotate(Weather("fog").apply(picture), 90))
    # Rain lightens where a drop falls; elsewhere the fog stays.
    assert (both == foggy).mean() > 0.02
    assert Change(90, weather=Weather("fog", 0.5)).describe() == "in fog (strength 0.5), turned 90°"


def test_dark_and_overexposed_pictures_change_their_brightness_as_stated() -> None:
    grey = np.full((4, 4, 3), 100, np.uint8)
    # ((100 + 100) + floor(100 / 5)) / 2 = 110; then 110 / 5 - 20 = 2, or (110 - 20) / 5 = 18.
    half = weather.half_lit(grey, np.random.default_rng(0))
    assert (half == 110).all()

    def brightened(picture: UInt8Array, factor: float, summand: float, multiply_first: bool) -> UInt8Array:
        """In YUV, the last of the six spaces."""
        drawn = iter((5, multiply_first))
        rng = SimpleNamespace(integers=lambda _: next(drawn), uniform=lambda *_: summand)
        return weather.brightness(picture, rng, factor, (summand, summand))

    for multiply_first, level in ((True, 2), (False, 18)):
        assert (brightened(half, 0.2, -20, multiply_first) == level).all()
    assert (brightened(grey, 1.6, 10, True) == 170).all()


def test_a_motion_is_a_line_of_sum_one_that_fades_along_its_way() -> None:
    kernel = weather.motion_kernel(15, 0, 1)
    assert kernel.shape == (15, 15)
    assert kernel.sum() == pytest.approx(1)
    assert not np.delete(kernel, 7, axis=1).any()
    assert (np.diff(kernel[:, 7]) < 0).all()
    # Clockwise from straight up: a quarter turn puts the start at the right.
    assert (np.diff(weather.motion_kernel(15, 90, 1)[7]) > 0).all()


def test_large_pictures_are_shrunk_to_where_flakes_have_their_size() -> None:
    picture = images.resize(small_worlds.place(4), 600, 1200)
    assert Weather("wind").apply(picture).shape == (256, 512, 3)
    assert Weather("snow").apply(picture[:1, :1]).shape == (1, 1, 3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        (("hail",), "no weather 'hail'; expected one of normal, fog, "),
        (("fog", 1.5), "strength is 1.5; expected a number from 0 to 1"),
        (("fog", float("nan")), "strength is nan"),
        (("fog", 1, -1), "seed is -1"),
    ],
)
def test_weathers_that_mean_nothing_are_refused(values: tuple[str, float, int], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Weather(*values)
