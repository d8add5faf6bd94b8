"""Compare the weathers of `lpn.descriptors.weather` with imgaug 0.4's own output, in numbers.

    python3.11 -m venv /tmp/imgaug && /tmp/imgaug/bin/pip install . imgaug==0.4.0 "numpy<2" "opencv-python-headless<4.12"
    /tmp/imgaug/bin/python -m tools.weather_check --pictures assets/demo/test/query_drone

imgaug is of 2020 and needs NumPy 1, so it has an environment of its own and is no dependency. The first table compares filters
that get the same random numbers, pixel by pixel. The second one compares distributions over pictures and draws: imgaug's
augmenters are made once for each weather, as MuseNet makes them, and run on through all draws.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, cast
from unittest.mock import patch

import cv2
import numpy as np
import tyro

from lpn.core import images
from lpn.core.arrays import Float64Array, UInt8Array
from lpn.descriptors import weather

for _name, _type in (("bool", bool), ("complex", complex), ("int", int), ("float", float), ("object", object)):
    if _name not in np.__dict__:
        setattr(np, _name, _type)  # names that NumPy 1.24 dropped and imgaug 0.4 uses
import imgaug.augmenters as iaa  # noqa: E402
from imgaug.random import RNG  # noqa: E402
from skimage.metrics import structural_similarity  # noqa: E402

SIDE = 512


def musenet(name: str) -> Any:
    """Return imgaug's augmenters of a weather with the settings and seeds of MuseNet's train.py."""

    def rain(low: float, high: float, seed: int) -> Any:
        return iaa.Rain(drop_size=(low, high), speed=(0.04, 0.06), seed=seed)

    def snow(low: float, high: float, seed: int) -> Any:
        return iaa.Snowflakes(flake_size=(low, high), speed=(0.007, 0.03), seed=seed)

    def fog() -> Any:
        return iaa.CloudLayer(
            intensity_mean=225,
            intensity_freq_exponent=-2,
            intensity_coarse_scale=2,
            alpha_min=1.0,
            alpha_multiplier=0.9,
            alpha_size_px_max=10,
            alpha_freq_exponent=-2,
            sparsity=0.9,
            density_multiplier=0.5,
            seed=35,
        )

    layers = {
        "fog": lambda: [fog()],
        "rain": lambda: [
            rain(*drop) for drop in ((0.05, 0.1, 38), (0.05, 0.1, 35), (0.1, 0.2, 73), (0.1, 0.2, 93), (0.05, 0.2, 95))
        ],
        "snow": lambda: [
            snow(*flake) for flake in ((0.5, 0.8, 38), (0.5, 0.8, 35), (0.6, 0.9, 74), (0.6, 0.9, 94), (0.5, 0.9, 96))
        ],
        "fog+rain": lambda: [fog(), rain(0.05, 0.2, 35), rain(0.05, 0.2, 36)],
        "fog+snow": lambda: [fog(), snow(0.5, 0.9, 35), snow(0.5, 0.9, 36)],
        "rain+snow": lambda: [
            snow(0.5, 0.8, 35),
            rain(0.05, 0.1, 35),
            rain(0.1, 0.2, 92),
            rain(0.05, 0.2, 91),
            snow(0.6, 0.9, 74),
        ],
        "dark": lambda: [
            iaa.BlendAlpha(0.5, foreground=iaa.Add(100), background=iaa.Multiply(0.2), seed=31),
            iaa.MultiplyAndAddToBrightness(mul=0.2, add=(-30, -15), seed=1991),
        ],
        "overexposure": lambda: [iaa.MultiplyAndAddToBrightness(mul=1.6, add=(0, 30), seed=1992)],
        "wind": lambda: [iaa.MotionBlur(15, seed=17)],
    }
    return iaa.Sequential(layers[name]())


def same_numbers(pictures: Sequence[UInt8Array]) -> dict[str, tuple[int, float]]:
    """Return the largest difference in grey levels, and the share of equal values, of filters with the same random numbers."""
    layers = iaa.RainLayer, iaa.SnowflakesLayer
    spaces = ("YCrCb", "HSV", "HLS", "Lab", "Luv", "YUV")
    pairs: dict[str, list[tuple[UInt8Array, UInt8Array]]] = {}
    for seed, picture in enumerate(pictures):
        rng = np.random.default_rng(seed)

        def add(name: str, ours: UInt8Array, theirs: UInt8Array) -> None:
            pairs.setdefault(name, []).append((ours, theirs))

        streams = (np.random.Generator(np.random.SFC64(seed)) for _ in range(2))
        # imgaug drops random numbers between two draws, which changes no distribution.
        with patch.object(RNG, "advance_"):
            stream: Any = RNG(next(streams))
            theirs = musenet("fog")[0].draw_on_image(picture.copy(), stream)
        add("fog, whole", weather.fog(picture, next(streams)), theirs)
        noise = weather.falling(picture.shape, 0.1, (0.03, 0.14), 0.9, rng)
        add("rain, blend", weather.rained(picture, noise), layers[0]._blend(picture, 0, np.tile(noise[..., None], 3)))
        for angle, speed in ((-14.3, 0.043), (9.1, 0.059), (28, 0.011)):
            streaks = layers[0]._motion_blur(noise.copy(), angle, speed, RNG(seed))
            add("rain and snow, streaks", weather.streaked(noise, angle, speed), streaks)
            flakes = layers[1]._postprocess_noise(noise.copy(), 0.61, 3)
            theirs = layers[1]._blend(picture, speed, flakes)
            add("snow, blend", weather.snowed(picture, noise, 0.61, speed), theirs)
        blend = musenet("dark")[0]
        add("dark, first blend", weather.half_lit(picture, rng), blend(image=picture.copy()))
        for (number, space), first, (factor, summand) in product(
            enumerate(spaces), (True, False), ((0.2, -21.4), (1.6, 13.7))
        ):
            steps = [iaa.Multiply(factor), iaa.Add(summand)]
            change = iaa.WithBrightnessChannels(steps if first else steps[::-1], to_colorspace=space)
            ours = weather.brightened(picture, weather._BRIGHTNESS[number], factor, np.round(summand), first)
            add("dark and overexposure, brightness", ours, change(image=picture.copy()))
        for angle, direction in ((0, 1), (73.2, -0.4), (301, 0.9)):
            ours = weather._filtered(picture, weather.motion_kernel(15, angle, direction))
            add("wind, whole", ours, iaa.MotionBlur(15, angle=angle, direction=direction)(image=picture.copy()))
    return {
        name: (
            max(int(np.abs(a.astype(int) - b).max()) for a, b in both),
            100 * float(np.mean([np.mean(a == b) for a, b in both])),
        )
        for name, both in pairs.items()
    }


@dataclass(frozen=True, eq=False)
class Distribution:
    """Means over pictures and draws of one implementation.

    Attributes:
        figures: mean, standard deviation, and SSIM of greys with the clear picture, (3,).
        errors: their standard errors, (3,).
        histogram: shares of the grey levels, (256,).
    """

    figures: Float64Array
    errors: Float64Array
    histogram: Float64Array

    @classmethod
    def of(
        cls, pictures: Sequence[UInt8Array], draws: int, filtered: Callable[[UInt8Array], UInt8Array]
    ) -> Distribution:
        """Filter each picture `draws` times."""
        rows, histogram = [], np.zeros(256)
        for _, picture in product(range(draws), pictures):
            result = filtered(picture)
            similar = structural_similarity(*(cv2.cvtColor(one, cv2.COLOR_RGB2GRAY) for one in (picture, result)))
            rows.append((result.mean(), result.std(), float(similar)))
            histogram += np.bincount(result.ravel(), minlength=256)
        table = np.array(rows)
        return cls(table.mean(axis=0), table.std(axis=0) / len(table) ** 0.5, histogram / histogram.sum())

    def distance(self, other: Distribution) -> float:
        """Return the Wasserstein-1 distance of the two histograms, in grey levels."""
        return float(np.abs(np.cumsum(self.histogram) - np.cumsum(other.histogram)).sum())


def _augmented(augmenters: Any, picture: UInt8Array) -> UInt8Array:
    return cast(UInt8Array, augmenters(image=picture.copy()))


def with_own_seeds(augmenters: Any) -> Any:
    """Give each layer of Rain and Snowflakes a seed of its own, in place of one seed for all three."""
    for number, layers in enumerate(augmenters):
        if isinstance(layers, iaa.SomeOf):
            for i, layer in enumerate(layers):
                layer.random_state = RNG(1000 * number + i)
    return augmenters


def main(
    pictures: Path,
    count: int = 4,
    draws: int = 20,
    weathers: tuple[weather.WeatherName, ...] = weather.WEATHERS[1:],
    own_seeds: bool = False,
) -> None:
    """Print both tables.

    Args:
        pictures: folder of drone pictures, in folders of places.
        count: number of pictures, each of another place.
        draws: number of draws of each weather for each picture.
        weathers: of the second table.
        own_seeds: see `with_own_seeds`.
    """
    folders = sorted(folder for folder in pictures.iterdir() if folder.is_dir())
    some = [sorted(folder.iterdir())[0] for folder in folders[:: max(len(folders) // count, 1)]][:count]
    clear = [images.resize(images.load_picture(file), SIDE, SIDE) for file in some]
    print("| with the same random numbers | largest difference | equal values |\n|---|---|---|")
    for name, (largest, share) in same_numbers(clear).items():
        print(f"| {name} | {largest} | {share:.3f} % |", flush=True)
    print(
        "\n| weather | mean | standard deviation | SSIM with the clear picture | histograms' distance |\n|---|---|---|---|---|"
    )
    rng = np.random.default_rng(0)
    for name in weathers:
        augmenters = with_own_seeds(musenet(name)) if own_seeds else musenet(name)
        theirs = Distribution.of(clear, draws, partial(_augmented, augmenters))
        ours = Distribution.of(clear, draws, partial(weather.draw, name=name, rng=rng))
        pairs = [
            f"{a:.{digits}f} ± {b:.{digits}f}, {c:.{digits}f} ± {d:.{digits}f}"
            for a, b, c, d, digits in zip(
                ours.figures, ours.errors, theirs.figures, theirs.errors, (1, 1, 3), strict=True
            )
        ]
        print(f"| {name} | {' | '.join(pairs)} | {ours.distance(theirs):.2f} |", flush=True)


if __name__ == "__main__":
    tyro.cli(main)
