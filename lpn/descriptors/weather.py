"""The ten weathers of University-WX as filters of a picture, with the arithmetic of imgaug 0.4 and the settings of MuseNet.

MuseNet (wtyhub/MuseNet, `train.py`, repeated in `test_iaa.py`) measures robustness by filters of imgaug 0.4 on each drone
picture before the resize. The filters here draw from equal distributions and round at the same steps. With equal random
numbers, they give equal pixels; docs/weather.md has the measured differences.
MuseNet's seeds fix a sequence over all pictures, which depends on their order and on the number of loaders. Here, seed and
pixels fix the random numbers, so that a picture has one weather in every command, and in the app.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Literal, cast, get_args

import cv2
import numpy as np
from numpy.random import Generator

from lpn.core import images
from lpn.core.arrays import AnyArray, Float32Array, UInt8Array
from lpn.core.errors import InputError

WeatherName = Literal[
    "normal", "fog", "rain", "snow", "fog+rain", "fog+snow", "rain+snow", "dark", "overexposure", "wind"
]
# In the leaderboard's order.
WEATHERS: tuple[WeatherName, ...] = get_args(WeatherName)
# Flakes and drops have sizes in pixels; University-1652's drone pictures have 512 pixels a side.
MAX_SIDE = 512
MAX_SEED = 2**31 - 1
# imgaug draws one of these for each change of brightness: conversion, its inverse, and the channel of brightness.
_BRIGHTNESS = (
    (cv2.COLOR_RGB2YCrCb, cv2.COLOR_YCrCb2RGB, 0),
    (cv2.COLOR_RGB2HSV, cv2.COLOR_HSV2RGB, 2),
    (cv2.COLOR_RGB2HLS, cv2.COLOR_HLS2RGB, 1),
    (cv2.COLOR_RGB2Lab, cv2.COLOR_Lab2RGB, 0),
    (cv2.COLOR_RGB2Luv, cv2.COLOR_Luv2RGB, 0),
    (cv2.COLOR_RGB2YUV, cv2.COLOR_YUV2RGB, 0),
)


@dataclass(frozen=True)
class Weather:
    """A weather of a picture; the default changes nothing.

    Attributes:
        name: one of `WEATHERS`.
        strength: share of the weather in the result, 0 .. 1; 0 is the picture itself, 1 is MuseNet's weather.
        seed: of the random numbers, 0 .. 2^31 - 1.

    Raises:
        InputError: if a value is out of range.
    """

    name: WeatherName = "normal"
    strength: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.name not in WEATHERS:
            raise InputError(f"There is no weather {self.name!r}; expected one of {', '.join(WEATHERS)}.")
        if not 0 <= self.strength <= 1:
            raise InputError(f"The weather's strength is {self.strength:g}; expected a number from 0 to 1.")
        if not 0 <= self.seed <= MAX_SEED:
            raise InputError(f"The weather's seed is {self.seed}; expected a whole number from 0 to {MAX_SEED}.")
        # Normalise, so that equal weathers compare equal.
        if not self.strength or self.name == "normal":
            for attribute, value in (("name", "normal"), ("strength", 1.0), ("seed", 0)):
                object.__setattr__(self, attribute, value)

    def __bool__(self) -> bool:
        """Return whether the weather changes pictures."""
        return self.name != "normal"

    def apply(self, picture: UInt8Array) -> UInt8Array:
        """Draw the weather on a picture: (H, W, 3) uint8 to the same shape, or at most 512 pixels a side.

        The result is round((1 - s) picture + s weathered) for the strength s.
        """
        if not self:
            return picture
        clear = np.ascontiguousarray(images.shrink(picture, MAX_SIDE))
        weathered = draw(clear, self.name, np.random.default_rng([self.seed, zlib.crc32(clear.data)]))
        if self.strength == 1:
            return weathered
        return cast(UInt8Array, cv2.addWeighted(weathered, self.strength, clear, 1 - self.strength, 0))

    def describe(self) -> str:
        """Describe the weather in words, such as "in fog" or "in rain (strength 0.5)"; empty without one."""
        if not self:
            return ""
        details = [f"strength {self.strength:g}"] if self.strength != 1 else []
        details += [f"seed {self.seed}"] if self.seed else []
        place = {"dark": "in the dark", "overexposure": "overexposed"}.get(self.name, f"in {self.name}")
        return f"{place} ({', '.join(details)})" if details else place


CLEAR = Weather()


def draw(picture: UInt8Array, name: WeatherName, rng: Generator) -> UInt8Array:
    """Draw one of `WEATHERS` at full strength on a picture (H, W, 3) uint8, with random numbers from `rng`."""
    for layer in _LAYERS[name]:
        picture = layer(picture, rng)
    return picture


def draw_any(picture: UInt8Array, probability: float, rng: Generator) -> UInt8Array:
    """With a probability, draw one of the nine weathers that change a picture, uniformly chosen, at full strength.

    A picture of more than 512 pixels a side is shrunk, see `Weather.apply`. At a probability of 0, no random number is drawn.
    """
    if not probability or rng.random() >= probability:
        return picture
    name = WEATHERS[1:][int(rng.integers(len(WEATHERS) - 1))]
    return draw(images.shrink(picture, MAX_SIDE), name, rng)


def fog(picture: UInt8Array, rng: Generator) -> UInt8Array:
    """Blend a picture with a cloud: (1 - a) picture + a light, imgaug's CloudLayer.

    The light is 225 + N(0, 2) on 8 x 8 cells, cubic, + 45 (2 v - 1), for noise v of the picture's own size; the opacity is
    a = 0.5 (1 + 0.9 u)^0.9, for noise u of 10 cells a side.
    """
    height, width = picture.shape[:2]
    cells = (225 + 2 * rng.standard_normal((8, 8))).astype(np.float32)
    light = _enlarged(cells, height, width) + 45 * (2 * frequency_noise(height, width, max(height, width), rng) - 1)
    opacity = 0.5 * (1 + 0.9 * frequency_noise(height, width, 10, rng)) ** 0.9
    return _blended(picture, np.clip(light, 0, 255), np.clip(opacity, 0, 1))


def frequency_noise(height: int, width: int, side: int, rng: Generator) -> Float32Array:
    """Draw noise (height, width) from 0 to 1 whose amplitudes fall with the square of the frequency.

    It is drawn at `side` pixels of the longer side, at least 4, and enlarged. The spectrum at distance f from frequency 0 is
    r cos(t) (1 + i sin(t)) / f^2 for r and t uniform, as imgaug computes it, and 0 at f = 0.
    """
    shrunk = min(1.0, side / max(height, width))
    rows, columns = max(int(height * shrunk), 4), max(int(width * shrunk), 4)
    size = rng.random((rows, columns), np.float32) * max(rows, columns) ** 2
    phase = rng.random((rows, columns), np.float32) * 2 * np.pi
    real = size * np.cos(phase)
    y, x = (np.minimum(np.arange(n), n - np.arange(n)) for n in (rows, columns))
    squared = (y[:, None] ** 2 + x[None, :] ** 2).astype(np.float64)
    squared[0, 0] = np.inf
    noise = np.fft.ifft2((real + 1j * real * np.sin(phase)) / squared).real
    noise = (noise - noise.min()) / max(float(np.ptp(noise)), 1e-12)
    if noise.shape != (height, width):
        noise = _enlarged((noise * 255).astype(np.uint8), height, width) / 255
    return cast(Float32Array, noise.astype(np.float32))


def rain(picture: UInt8Array, rng: Generator, drop: tuple[float, float]) -> UInt8Array:
    """Draw one layer of rain, imgaug's RainLayer: drops of opacity 1.3 noise / 255, at most 1.

    The drops' grey is 110 + 130 mod S, for the sum S of the first 1000 values of the noise, each repeated for red, green, and
    blue. It is 240 if S exceeds 130.

    Args:
        drop: range of the drop size, 0 .. 1; noise is drawn at 1 - drop size of the picture's size.
    """
    size, angle, speed = rng.uniform(*drop), rng.uniform(-15, 15), rng.uniform(0.04, 0.06)
    noise = streaked(falling(picture.shape[:2], size, (0.03, 0.14), rng.uniform(0.8, 1), rng), angle, speed)
    total = int(np.repeat(noise.ravel()[:334].astype(np.int64), 3)[:1000].sum())
    return _blended(picture, 110 + 130 % max(total, 1), np.minimum(noise * np.float32(1.3 / 255), 1))


def snow(picture: UInt8Array, rng: Generator, flake: tuple[float, float]) -> UInt8Array:
    """Draw one layer of snow, imgaug's SnowflakesLayer.

    The result is max(picture + (0.1 + 20 speed) flakes, (1 + 20 speed) flakes), at most 255, where flakes are noise of gamma
    1 + 2 (1 - evenness), times 1 + 5 (1 - evenness).

    Args:
        flake: range of the flake size, 0 .. 1; noise is drawn at 1 - flake size of the picture's size.
    """
    size, evenness, angle = rng.uniform(*flake), rng.uniform(0.4, 0.8), rng.uniform(-30, 30)
    speed, spread = rng.uniform(0.007, 0.03), rng.uniform(0.0001, 0.001)
    noise = falling(picture.shape[:2], size, (0.005, 0.075), rng.uniform(0.3, 0.9), rng)
    sigma = min(max(spread * max(noise.shape), 0.5), 3.75)
    soft = cast(UInt8Array, cv2.GaussianBlur(noise, (5, 5), sigma, borderType=cv2.BORDER_REFLECT_101))
    table = np.linspace(0, 1, 256, dtype=np.float32) ** np.float32(1 + 2 * (1 - evenness)) * 255
    flakes = cv2.LUT(streaked(soft, angle, speed), table.astype(np.uint8)) * np.float32(1 + 5 * (1 - evenness))
    added = np.minimum(picture + np.float32(0.1 + 20 * speed) * flakes[..., None], 255).astype(np.uint8)
    white = np.minimum(np.float32(1 + 20 * speed) * flakes[..., None], 255).astype(np.uint8)
    return cast(UInt8Array, np.maximum(added, white))


def falling(
    shape: tuple[int, ...], size: float, density: tuple[float, float], evenness: float, rng: Generator
) -> UInt8Array:
    """Draw white points (H, W) uint8, denser in some areas.

    A share of the pixels, uniform within `density`, has values 127.5 + 127.5 |cos(pi u)| for u uniform (a folded arcsine
    distribution). They are dimmed by 8 x 8 cells of Beta(1, 1 - evenness), cubic, and enlarged from 1 - size of the shape.
    """
    height, width = shape[:2]
    rows, columns = (max(1, int(side * min(max(1 - size, 0.001), 1))) for side in (height, width))
    points = np.zeros((rows, columns), np.float32)
    hit = rng.random((rows, columns), np.float32) < rng.uniform(*density)
    points[hit] = np.round(127.5 + 127.5 * np.abs(np.cos(np.pi * rng.random(int(hit.sum())))))
    gate = rng.beta(1, max(1 - evenness, 1e-4), (8, 8)).astype(np.float32)
    points *= np.clip(_enlarged(gate, rows, columns), 0, 1)
    return cast(UInt8Array, _enlarged(points.astype(np.uint8), height, width))


def streaked(noise: UInt8Array, angle: float, speed: float) -> UInt8Array:
    """Blur falling points (H, W) along their path, `speed` times the longer side, in degrees clockwise from straight down."""
    length = int(speed * max(noise.shape))
    return noise if length <= 1 else _filtered(noise, motion_kernel(max(length, 3), angle, 1))


def wind(picture: UInt8Array, rng: Generator) -> UInt8Array:
    """Blur a picture by a motion of 15 pixels in a random direction, imgaug's MotionBlur(15)."""
    return _filtered(picture, motion_kernel(15, rng.uniform(0, 360), rng.uniform(-1, 1)))


def motion_kernel(length: int, angle: float, direction: float) -> Float32Array:
    """Return the kernel (k, k) of a motion, with sum 1; k is the first odd number from `length` on.

    Args:
        angle: degrees clockwise from straight up.
        direction: 1 is brightest at the start of the path, -1 at its end, 0 even.
    """
    side = length + 1 - length % 2
    start = (direction + 1) / 2
    kernel = np.zeros((side, side), np.float32)
    kernel[:, side // 2] = np.linspace(start, 1 - start, side, dtype=np.float32)
    centre = (side - 1) / 2
    turn = cv2.getRotationMatrix2D((centre, centre), -angle, 1)
    turned = cv2.warpAffine((kernel * 255).astype(np.uint8), turn, (side, side), flags=cv2.INTER_LINEAR)
    total = int(turned.sum())
    return cast(Float32Array, turned / np.float32(total))


def half_lit(picture: UInt8Array, _: Generator) -> UInt8Array:
    """Return (min(picture + 100, 255) + floor(picture / 5)) / 2, rounded: the first blend of MuseNet's dark."""
    values = np.arange(256, dtype=np.float32)
    lighter, darker = np.minimum(values + 100, 255), np.floor(values * np.float32(0.2))
    return cast(UInt8Array, cv2.LUT(picture, np.round((lighter + darker) / 2).astype(np.uint8)))


def brightness(picture: UInt8Array, rng: Generator, factor: float, offset: tuple[float, float]) -> UInt8Array:
    """Multiply the brightness and add to it, in either order, in one of six colour spaces: MultiplyAndAddToBrightness.

    Args:
        offset: range of the summand, in grey levels.
    """
    there, back, channel = _BRIGHTNESS[int(rng.integers(len(_BRIGHTNESS)))]
    summand, multiply_first = np.round(rng.uniform(*offset)), bool(rng.integers(2))
    values = np.arange(256, dtype=np.float32)
    for multiplies in (multiply_first, not multiply_first):
        changed = values * np.float32(factor) if multiplies else values + np.float32(summand)
        values = np.floor(np.clip(changed, 0, 255))
    converted = cv2.cvtColor(picture, there)
    converted[..., channel] = cv2.LUT(converted[..., channel], values.astype(np.uint8))
    return cast(UInt8Array, cv2.cvtColor(converted, back))


def _some(layer: Callable[..., UInt8Array], size: tuple[float, float]) -> Callable[[UInt8Array, Generator], UInt8Array]:
    """Return a filter that draws one to three layers of rain or snow, as imgaug's Rain and Snowflakes do."""

    def layers(picture: UInt8Array, rng: Generator) -> UInt8Array:
        for _ in range(int(rng.integers(1, 4))):
            picture = layer(picture, rng, size)
        return picture

    return layers


def _blended(picture: UInt8Array, over: Float32Array | float, opacity: Float32Array) -> UInt8Array:
    """Blend a picture with light (H, W) or a grey level by an opacity (H, W) 0 .. 1; imgaug cuts off the decimals."""
    alpha = opacity[..., None]
    light = (over * opacity)[..., None]
    return np.clip(picture * (1 - alpha) + light, 0, 255).astype(np.uint8)


def _filtered(picture: UInt8Array, kernel: Float32Array) -> UInt8Array:
    return cast(UInt8Array, cv2.filter2D(picture, -1, kernel))


def _enlarged(values: Float32Array | UInt8Array, height: int, width: int) -> AnyArray:
    """Resize (rows, columns) to (height, width), cubic, with the dtype unchanged."""
    return cast(AnyArray, cv2.resize(values, (width, height), interpolation=cv2.INTER_CUBIC))


_DROPS, _FLAKES = partial(_some, rain), partial(_some, snow)
_LAYERS: dict[WeatherName, tuple[Callable[[UInt8Array, Generator], UInt8Array], ...]] = {
    "normal": (),
    "fog": (fog,),
    "rain": (*(_DROPS(size) for size in ((0.05, 0.1), (0.05, 0.1), (0.1, 0.2), (0.1, 0.2), (0.05, 0.2))),),
    "snow": (*(_FLAKES(size) for size in ((0.5, 0.8), (0.5, 0.8), (0.6, 0.9), (0.6, 0.9), (0.5, 0.9))),),
    "fog+rain": (fog, _DROPS((0.05, 0.2)), _DROPS((0.05, 0.2))),
    "fog+snow": (fog, _FLAKES((0.5, 0.9)), _FLAKES((0.5, 0.9))),
    "rain+snow": (_FLAKES((0.5, 0.8)), *(_DROPS(size) for size in ((0.05, 0.1), (0.1, 0.2), (0.05, 0.2))), _FLAKES((0.6, 0.9))),
    "dark": (half_lit, partial(brightness, factor=0.2, offset=(-30, -15))),
    "overexposure": (partial(brightness, factor=1.6, offset=(0, 30)),),
    "wind": (wind,),
}  # fmt: skip
