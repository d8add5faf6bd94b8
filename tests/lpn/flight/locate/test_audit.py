"""The lag of tags against registered positions."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.flight.locate.audit import audit_tags, corrected_tags, track_velocities


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
    assert found.lag_error < 0.3
    assert found.without_lag < found.median / 2
    assert f"by {abs(found.lag):.1f} s" in found.sentence
    assert ("lag by" in found.sentence) == (lag > 0)
    assert found.offset == pytest.approx(5**0.5, abs=0.6)
    assert f"without the lag and a constant offset of {found.offset:.1f} m, {found.without_lag:.1f} m" in found.sentence


@pytest.mark.parametrize(("ahead", "side"), [(4.4, "ahead"), (-3.0, "behind")])
def test_a_camera_that_looks_ahead_is_not_told_as_a_lag_alone(ahead: float, side: str) -> None:
    times = np.arange(0, 120, 2.0)
    # Two legs of 5 m/s, there and back.
    x = 5 * np.where(times < 60, times, 120 - times)
    tags = np.stack([x, np.where(times < 60, 0.0, 30.0)], axis=1)
    forwards = np.where(times < 60, 1.0, -1.0)
    middles = tags + np.stack([ahead * forwards, np.zeros(len(times))], axis=1)
    middles += np.random.default_rng(0).normal(0, 0.2, middles.shape)
    found = audit_tags(times, tags, middles, middles=True)
    assert found.ahead == pytest.approx(ahead, abs=0.4)
    assert f"or the camera looks {abs(found.ahead):.1f} m {side}" in found.sentence
    assert "the camera looks" not in audit_tags(times, tags, middles).sentence


def test_tags_without_lag_are_said_to_have_none() -> None:
    times = np.arange(0, 90, 3.0)
    tags = _flown(times) + np.random.default_rng(1).normal(0, 2, (30, 2))
    found = audit_tags(times, tags, _flown(times))
    assert "the lag cannot be estimated" in found.sentence
    assert found.frames == 30


def test_a_constant_offset_that_explains_the_differences_makes_no_lag() -> None:
    """The lag of half a second is certain, but it explains little beyond the offset of 15 m."""
    times = np.arange(0, 600, 3.0)
    noise = np.random.default_rng(3).normal(0, 4, (200, 2))
    found = audit_tags(times, _flown(times - 0.5) + np.array([12.0, -9.0]) + noise, _flown(times))
    assert found.lag > max(3 * found.lag_error, 0.3)
    assert found.without_lag < 0.5 * found.median
    assert not found.has_lag
    assert "the lag cannot be estimated" in found.sentence


def test_missing_positions_and_times_are_left_out() -> None:
    times = np.arange(0, 90, 3.0)
    positions = _flown(times)
    positions[5], times[9] = np.nan, np.nan
    velocities = track_velocities(times, positions)
    assert np.isnan(velocities[[0, 5, 9, 29]]).all()
    assert velocities[10, 1] == pytest.approx(3)
    untagged = audit_tags(times, np.full_like(positions, np.nan), positions)
    assert untagged.sentence.startswith("No photo has both a GPS tag")


def test_tags_without_their_lag_are_where_they_were_taken() -> None:
    times = np.arange(0, 120, 3.0)
    tags = _flown(times - 2.0)
    moved = corrected_tags(times, tags, 2.0)
    assert np.isnan(moved[-1]).all()
    off, lagging = (np.linalg.norm(one - _flown(times), axis=1)[:-1].max() for one in (moved, tags))
    assert off < 2.5 < lagging
    times[20:] += 100
    moved = corrected_tags(times, tags, 2.0)
    assert np.flatnonzero(np.isnan(moved).any(axis=1)).tolist() == [19, 39]
    found = audit_tags(np.arange(0, 120, 3.0), tags, _flown(np.arange(0, 120, 3.0)))
    assert found.has_lag
    assert not audit_tags(times[:5], tags[:5], tags[:5]).has_lag
