"""The recipe `released` augments as the released code does: statistics of many draws."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.core.arrays import UInt8Array
from lpn.core.views import View
from lpn.training.augmentation import augment
from lpn.training.recipes import RECIPES
from tools.fixtures import seeded

SIZE, PAD, DRAWS = 256, 10, 500
# Shares of black, and angles in degrees, of as many satellites. `Resize`, `Pad`, `RandomAffine`, and `RandomCrop` of wtyhub/LPN
# train.py:92-110 were emulated with Pillow for them, by what torchvision's documentation says; commit 9a316620 has that code
# (tools/fixtures/released_augmentation.py).
RELEASED = seeded.arrays("released_augmentation")


@pytest.fixture(scope="module")
def chart() -> UInt8Array:
    """A picture whose red and green tell the place, and whose blue is noise, which is never black."""
    rows, columns = np.mgrid[:SIZE, :SIZE].astype(np.uint8)
    noise = np.random.default_rng(0).integers(128, 256, rows.shape, np.uint8)
    return np.stack([columns, rows, noise], axis=2)


def drawn(chart: UInt8Array, view: View) -> list[UInt8Array]:
    rng = np.random.default_rng(1)
    return [augment(chart, RECIPES["released"], rng, 0.0, False, view) for _ in range(DRAWS)]


def angle(satellite: UInt8Array) -> float:
    """Return the rotation of the chart's middle in degrees, counter-clockwise, from how its coordinates run."""
    middle = satellite[64:192, 64:192, :2].astype(np.float64)
    across = (middle[:, -1] - middle[:, 0]).mean(axis=0) / 127
    down = (middle[-1] - middle[0]).mean(axis=0) / 127
    sign = np.sign(across[0] * down[1] - across[1] * down[0])  # -1 where the picture is mirrored
    return float(np.degrees(np.arctan2(sign * across[1], sign * across[0])))


def test_satellites_have_as_much_black_and_are_turned_as_far(chart: UInt8Array) -> None:
    satellites = drawn(chart, "satellite")
    black = np.array([(one[..., 2] == 0).mean() for one in satellites])
    assert black.mean() == pytest.approx(RELEASED["black"].mean(), abs=0.012)
    for name, own in (("black", black), ("angles", np.array([angle(one) for one in satellites]))):
        values = np.concatenate([own, RELEASED[name]])
        shares = [np.searchsorted(np.sort(of), values, side="right") / DRAWS for of in (own, RELEASED[name])]
        # By Kolmogorov and Smirnov, two samples of one distribution differ by more in one of 10,000 cases.
        assert np.abs(shares[0] - shares[1]).max() < 2.23 * np.sqrt(2 / DRAWS)


def test_other_views_are_shifted_by_whole_pixels_of_equal_chance(chart: UInt8Array) -> None:
    padded = np.pad(chart, ((PAD, PAD), (PAD, PAD), (0, 0)), mode="edge")
    mirrored, places = 0, list[tuple[int, int]]()
    for other in drawn(chart, "drone"):
        flipped = bool(other[SIZE // 2, 0, 0] > other[SIZE // 2, -1, 0])
        upright = other[:, ::-1] if flipped else other
        left, top = (int(value) - SIZE // 2 + PAD for value in upright[SIZE // 2, SIZE // 2, :2])
        np.testing.assert_array_equal(upright, padded[top : top + SIZE, left : left + SIZE])
        mirrored += flipped
        places.append((top, left))
    assert mirrored / DRAWS == pytest.approx(0.5, abs=0.1)
    assert {top for top, _ in places} == {left for _, left in places} == set(range(21))
    counts, expected = np.bincount(np.ravel(places)), 2 * DRAWS / 21
    # The 0.9999 quantile of chi-square with 20 degrees of freedom.
    assert ((counts - expected) ** 2 / expected).sum() < 52.4
