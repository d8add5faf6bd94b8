"""The places of a flight's photos against their GPS tags."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.surveyed import SurveyedErrors, summarise_offsets


def tag_errors(frames: Sequence[LocatedFrame], answers: Sequence[StageRecord | None]) -> SurveyedErrors | None:
    """Return the errors of a flight's places against its GPS tags, whatever a person corrected; None if no photo has both.

    Args:
        answers: the place of each frame; None where it does not count.
    """
    off = [
        (answer.x - located.tag[0], answer.y - located.tag[1])
        for located, answer in zip(frames, answers, strict=True)
        if answer is not None and answer.x is not None and answer.y is not None and located.tag is not None
    ]
    return summarise_offsets(np.array(off), np.empty(0)) if off else None
