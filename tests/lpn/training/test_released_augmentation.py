"""The recipe `released` augments as the released code does, which is emulated with Pillow."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.core.arrays import FloatingArray
from tools.fixtures.released_augmentation import AugmentationStatistics, measure, ours, released

DRAWS = 500


@pytest.fixture(scope="module")
def both() -> tuple[AugmentationStatistics, AugmentationStatistics]:
    return measure(ours, DRAWS, 1), measure(released, DRAWS, 2)


def largest_gap(first: FloatingArray, second: FloatingArray) -> float:
    """The statistic of Kolmogorov and Smirnov: the largest difference of two cumulative distributions."""
    values = np.concatenate([first, second])
    shares = [np.searchsorted(np.sort(of), values, side="right") / len(of) for of in (first, second)]
    return float(np.abs(shares[0] - shares[1]).max())


# Two samples of one distribution differ by more in one of 10,000 cases.
LIMIT = 2.23 * np.sqrt(2 / DRAWS)


def test_satellites_have_as_much_black_and_are_turned_as_far(
    both: tuple[AugmentationStatistics, AugmentationStatistics],
) -> None:
    own, theirs = both
    assert largest_gap(own.black, theirs.black) < LIMIT
    assert largest_gap(own.angles, theirs.angles) < LIMIT
    assert own.black.mean() == pytest.approx(theirs.black.mean(), abs=0.012)
    for found in both:
        assert 80 < np.abs(found.angles).max() <= 90.5
        assert np.abs(found.angles).mean() == pytest.approx(45, abs=5)


def test_other_views_are_shifted_by_whole_pixels_of_equal_chance(
    both: tuple[AugmentationStatistics, AugmentationStatistics],
) -> None:
    for found in both:
        assert found.whole == 1.0
        assert found.flipped == pytest.approx(0.5, abs=0.1)
        counts = np.bincount(found.shifts, minlength=21)
        assert len(counts) == 21
        expected = 2 * DRAWS / 21
        # The 0.9999 quantile of chi-square with 20 degrees of freedom.
        assert ((counts - expected) ** 2 / expected).sum() < 52.4
