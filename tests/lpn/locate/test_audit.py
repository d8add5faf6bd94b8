"""The lag of tags against registered positions."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.locate.audit import audit_tags, track_velocities


def _flown(times: np.ndarray) -> np.ndarray:
    """A lawnmower path with turns, in metres."""
    return np.stack([60 * np.sin(times / 12), 3 * times], axis=1)


@pytest.mark.parametrize("lag", [2.3, -1.5])
def test_the_lag_is_found_under_noise_and_outliers(lag: float) -> None:
    rng = np.random.default_rng(0)
    times = np.arange(0, 120, 3.0) + 1.4e9
    tags = _flown(times - 1.4e9 - lag) + np.array([2.0, -1.0]) + rng.normal(0, 0.7, (len(times), 2))
    tags[7] += 80
    found = audit_tags(times, tags, _flown(times - 1.4e9))
    assert found.lag == pytest.approx(lag, abs=0.25)
    assert found.lag_error is not None
    assert found.lag_error < 0.3
    assert found.without_lag is not None
    assert found.without_lag < found.median / 2
    assert f"by {abs(found.lag):.1f} s" in found.sentence
    assert ("lag by" in found.sentence) == (lag > 0)


def test_tags_without_lag_are_said_to_have_none() -> None:
    times = np.arange(0, 90, 3.0)
    tags = _flown(times) + np.random.default_rng(1).normal(0, 2, (30, 2))
    found = audit_tags(times, tags, _flown(times))
    assert "no lag can be told" in found.sentence
    assert found.frames == 30


def test_missing_positions_and_times_are_left_out() -> None:
    times = np.arange(0, 90, 3.0)
    positions = _flown(times)
    positions[5], times[9] = np.nan, np.nan
    velocities = track_velocities(times, positions)
    assert np.isnan(velocities[[0, 5, 9, 29]]).all()
    assert velocities[10, 1] == pytest.approx(3)
    assert audit_tags(times, np.full_like(positions, np.nan), positions).sentence.startswith("No frame has both")
    with pytest.raises(InputError, match="expected"):
        audit_tags(times, positions[:4], positions)
