"""Places against tags: their share, their mean, and the legs of the flight."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from lpn.core.arrays import Float64Array
from lpn.flights import Frame
from lpn.locate.located import LocatedFrame, StageRecord
from lpn.locate.tag_errors import TagOffsets, tag_errors


def errors(tags: Sequence[tuple[float, float] | None], off: Float64Array) -> TagOffsets | None:
    """Return the errors of places that lie so many metres east and north of their tags; NaN for no place."""
    frames, answers = list[LocatedFrame](), list[StageRecord | None]()
    for i, (tag, (east, north)) in enumerate(zip(tags, off.tolist(), strict=True)):
        known = None if tag is None else np.array(tag, np.float64)
        frames.append(LocatedFrame(Frame(f"{i}.jpg", Path(f"{i}.jpg"), 8, 6), known))
        x, y = (0.0, 0.0) if tag is None else tag
        answers.append(None if np.isnan(east) else StageRecord("accepted", "", x + east, y + north))
    return tag_errors(frames, answers)


def test_the_median_and_the_share_are_of_the_photos_that_have_both() -> None:
    tags = [(float(i), 0.0) for i in range(22)]
    off = np.column_stack([np.arange(22.0), np.zeros(22)])
    off[21] = np.nan
    known = errors([*tags[:20], None, tags[21]], off)
    assert known is not None
    assert known.offsets.photos == 20
    assert known.offsets.median == pytest.approx(9.5)
    assert known.offsets.ce95 == pytest.approx(np.quantile(np.arange(20.0), 0.95))
    assert errors([None, (0.0, 0.0)], np.array([[1.0, 0.0], [np.nan, np.nan]])) is None


def test_a_leg_ends_where_the_flight_turns_and_goes_on_where_it_stands() -> None:
    north = [(0.0, 10.0 * i) for i in range(5)]
    back = [(30.0, 40.0 - 10.0 * i) for i in range(5)]
    off = np.array([(0.0, 6.0)] * 5 + [(0.0, -6.0)] * 5)
    known = errors([*north, *back], off)
    assert known is not None
    # The photos at the turn are of neither leg.
    assert [(leg.first, leg.last, round(leg.azimuth) % 360) for leg in known.legs] == [(0, 3, 0), (6, 9, 180)]
    assert [(leg.east, leg.north) for leg in known.legs] == [(0.0, 6.0), (0.0, -6.0)]
    hover = errors([(0.1 * i, 0.0) for i in range(6)], off[:6])
    assert hover is not None
    assert hover.legs == []
    stands = errors([*north, *[(0.0, 40.2)] * 3, *[(0.0, 50.0 + 10.0 * i) for i in range(4)]], np.zeros((12, 2)))
    assert stands is not None
    assert [(leg.first, leg.last) for leg in stands.legs] == [(0, 11)]
    # A video has several frames of each tag.
    repeated = errors([(0.0, 10.0 * (i // 4)) for i in range(16)], np.tile([2.0, 0.0], (16, 1)))
    assert repeated is not None
    assert [(leg.first, leg.last, leg.east) for leg in repeated.legs] == [(0, 15, 2.0)]


@pytest.mark.parametrize("scatter", [0.7, 1.5, 3.0])
def test_a_hovering_drone_flies_no_leg(scatter: float) -> None:
    for seed in range(20):
        tags = np.random.default_rng(seed).normal(0.0, scatter, (60, 2))
        known = errors([(east, north) for east, north in tags.tolist()], np.zeros((60, 2)))
        assert known is not None
        assert known.legs == []


@pytest.mark.parametrize("scatter", [0.3, 1.5])
def test_scattered_tags_hide_no_leg(scatter: float) -> None:
    """Legs of 100 m go there and back, with photos 5 to 20 m apart at uneven steps."""
    generator = np.random.default_rng(0)
    ways = [np.cumsum(generator.uniform(5.0, 20.0, 9)) for _ in range(5)]
    tags = np.concatenate([[(30.0 * i, way if i % 2 == 0 else 100.0 - way) for way in ways[i]] for i in range(5)])
    tags += generator.normal(0.0, scatter, tags.shape)
    known = errors([(east, north) for east, north in tags.tolist()], np.zeros(tags.shape))
    assert known is not None
    flown = [round(leg.azimuth / 180) % 2 for leg in known.legs]
    assert flown == [0, 1, 0, 1, 0]
    assert all(leg.last - leg.first >= 5 for leg in known.legs)


def test_a_correction_by_hand_is_no_gps_tag() -> None:
    answer = StageRecord("accepted", "", 3.0, 0.0)
    frame = LocatedFrame(
        Frame("0.jpg", Path("0.jpg"), 8, 6), np.zeros(2), by_hand=StageRecord("accepted", "", 50.0, 0.0, camera=True)
    )
    known = tag_errors([frame], [answer])
    assert known is not None
    assert known.offsets.median == 3.0


def test_a_leg_of_few_places_is_not_told() -> None:
    off = np.full((5, 2), np.nan)
    off[:2] = 3.0
    known = errors([(0.0, 10.0 * i) for i in range(5)], off)
    assert known is not None
    assert known.legs == []
    off[4] = 6.0
    known = errors([(0.0, 10.0 * i) for i in range(5)], off)
    assert known is not None
    assert [(leg.first, leg.last, leg.east) for leg in known.legs] == [(0, 4, 4.0)]
