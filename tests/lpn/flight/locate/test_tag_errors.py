"""Places against tags: their median and their share."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from lpn.core.arrays import Float64Array
from lpn.flight.files import Frame
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.surveyed import SurveyedErrors
from lpn.flight.locate.tag_errors import tag_errors


def errors(tags: Sequence[tuple[float, float] | None], off: Float64Array) -> SurveyedErrors | None:
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
    assert known.photos == 20
    assert known.median == pytest.approx(9.5)
    assert known.ce95 == pytest.approx(np.quantile(np.arange(20.0), 0.95))
    assert errors([None, (0.0, 0.0)], np.array([[1.0, 0.0], [np.nan, np.nan]])) is None


def test_a_correction_by_hand_is_no_gps_tag() -> None:
    answer = StageRecord("accepted", "", 3.0, 0.0)
    frame = LocatedFrame(
        Frame("0.jpg", Path("0.jpg"), 8, 6), np.zeros(2), by_hand=StageRecord("accepted", "", 50.0, 0.0, camera=True)
    )
    known = tag_errors([frame], [answer])
    assert known is not None
    assert known.median == 3.0
