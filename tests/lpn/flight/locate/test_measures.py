"""Measures against sums written out."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.flight.locate import measures


def test_summary_counts_frames_without_an_answer() -> None:
    errors = np.array([3.0, 7.0, np.nan, 60.0, 20.0, np.nan, 4.0, 11.0])
    found = measures.summarise(errors, [1, 2, 3, 9, 4, 5, 1, 2], limit=50)
    assert (found.frames, found.answered) == (8, 6)
    assert found.median == 9.0
    assert (found.p90, found.p95) == pytest.approx((40.0, 50.0))
    assert found.within == {5: 25.0, 10: 37.5, 25: 62.5, 50: 62.5, 100: 75.0}
    assert found.coverage_at_zero == 62.5
    # Ratios of error and radius: 3, 3.5, 6.7, 5, 4, 5.5.
    assert found.calibration == pytest.approx({1: 0, 2: 0, 3: 100 / 6})


def test_answers_without_radii_are_ordered_by_score() -> None:
    errors = [1.0, 60.0, 2.0, 3.0]
    assert measures.summarise(errors, scores=[0.9, 0.5, 0.8, 0.1]).coverage_at_zero == 50.0
    assert measures.summarise(errors, scores=[0.9, 0.5, 0.8, 0.1]).calibration == {}
    assert measures.summarise(errors, [1.0, 2.0, 0.5, np.nan]).coverage_at_zero == 50.0


def test_radii_of_normal_errors_are_right() -> None:
    rng = np.random.default_rng(0)
    radii = rng.uniform(1, 9, 20_000)
    errors = np.linalg.norm(rng.normal(0, 1, (20_000, 2)) * radii[:, None], axis=1)
    assert measures.summarise(errors, radii).calibration == pytest.approx(measures.RIGHT_CALIBRATION, abs=1)


@pytest.mark.parametrize("seed", range(5))
def test_coverage_at_zero_is_the_longest_prefix_without_a_false_one(seed: int) -> None:
    rng = np.random.default_rng(seed)
    errors, radii = rng.uniform(0, 70, 30), rng.integers(1, 12, 30).astype(float)
    best = 0
    for limit in sorted(set(radii)):
        taken = errors[radii <= limit]
        if (taken <= 50).all():
            best = max(best, len(taken))
    assert measures.accepted_before_false(errors, radii, 50.0) == best


def test_wrong_shapes_are_refused() -> None:
    with pytest.raises(InputError, match="one number a frame"):
        measures.summarise(np.zeros(3), np.zeros(4))
