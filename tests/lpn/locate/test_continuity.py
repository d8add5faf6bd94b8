"""Registrations that one drone can have flown, against brute force."""

from __future__ import annotations

from itertools import combinations, pairwise

import numpy as np
import pytest

from lpn.core.arrays import Float64Array
from lpn.locate.continuity import top_speed, within_reach


def flown(count: int, rng: np.random.Generator) -> tuple[Float64Array, Float64Array, Float64Array]:
    """Return times, places, and radii of a drone that flies east at 8 m/s."""
    times = np.cumsum(rng.uniform(1.1, 3, count))
    return times, np.stack([8 * times, np.zeros(count)], axis=1) + rng.normal(0, 0.5, (count, 2)), np.full(count, 1.0)


@pytest.mark.parametrize("seed", range(6))
def test_the_largest_set_with_the_shortest_track_is_kept(seed: int) -> None:
    rng = np.random.default_rng(seed)
    times, places, radii = flown(9, rng)
    moved = rng.choice(9, 3, replace=False)
    places[moved] += rng.normal(0, 30, (3, 2))

    def length(chosen: tuple[int, ...]) -> float | None:
        total = 0.0
        for a, b in pairwise(chosen):
            step = float(np.linalg.norm(places[a] - places[b]))
            if step > 10 * (times[b] - times[a]) + 2 * np.sqrt(2):
                return None
            total += step
        return total

    found: dict[tuple[int, ...], float] = {}
    for size in range(9, 0, -1):
        chains = {chosen: length(chosen) for chosen in combinations(range(9), size)}
        found = {chosen: total for chosen, total in chains.items() if total is not None}
        if found:
            break
    kept = within_reach(times, places, radii, 10.0)
    assert tuple(np.flatnonzero(kept)) == min(found, key=lambda chosen: found[chosen])


def test_two_frames_that_agree_on_the_next_house_are_found_out() -> None:
    times, places, radii = flown(20, np.random.default_rng(1))
    places[8:10] += (-37.0, 4.0)
    speed = top_speed(times, places)
    assert speed is not None
    assert np.flatnonzero(~within_reach(times, places, radii, speed)).tolist() == [8, 9]


def test_a_flight_without_jumps_keeps_all_frames_also_with_whole_seconds() -> None:
    times, places, radii = flown(30, np.random.default_rng(2))
    speed = top_speed(times, places)
    assert speed == pytest.approx(1.2 * 8, rel=0.15)
    assert within_reach(times, places, radii, speed).all()
    assert within_reach(np.floor(times), places, np.full(30, 0.1), speed).all()


def test_a_few_positions_or_equal_times_tell_no_speed() -> None:
    times, places, _ = flown(7, np.random.default_rng(3))
    assert top_speed(times, places) is None
    assert top_speed(np.zeros(20), np.zeros((20, 2))) is None
    assert within_reach(np.zeros(0), np.zeros((0, 2)), np.zeros(0), 1.0).tolist() == []
