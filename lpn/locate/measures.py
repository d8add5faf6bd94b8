"""Measures of located frames: errors in metres and coverage; `lpn.retrieval.field_metrics` has SDM@K, MA@m, and Dis@K."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError

WITHIN = (5, 10, 25, 50, 100)


@dataclass(frozen=True)
class ErrorSummary:
    """Errors of a stage against the tags.

    Attributes:
        frames: frames with a tag.
        answered: those of them with an accepted position.
        median, p90: errors in metres of the answered ones; NaN without any.
        within: share in percent of all frames answered within so many metres.
        coverage_at_zero: share in percent of all frames that can be accepted, most confident first, before the first one
            that is farther off than the limit.
        limit: metres from which an accepted frame counts as false.
    """

    frames: int
    answered: int
    median: float
    p90: float
    within: dict[int, float]
    coverage_at_zero: float
    limit: float


def summarise(
    errors: npt.ArrayLike, radii: npt.ArrayLike | None = None, limit: float = 50.0, within: Sequence[int] = WITHIN
) -> ErrorSummary:
    """Summarise errors in metres (N,), NaN where the stage gave no accepted position.

    Args:
        radii: 1-sigma radii, or another measure of doubt, (N,), by which answers are ordered for `coverage_at_zero`; a missing
            one comes last.

    Raises:
        InputError: if the shapes differ.
    """
    values = _vector(errors)
    answered = ~np.isnan(values)
    known = values[answered]
    order = np.zeros(len(known)) if radii is None else _vector(radii, len(values))[answered]
    share = 100 / max(len(values), 1)
    return ErrorSummary(
        len(values),
        len(known),
        float(np.median(known)) if len(known) else float("nan"),
        float(np.quantile(known, 0.9)) if len(known) else float("nan"),
        {metres: share * int((known <= metres).sum()) for metres in within},
        share * accepted_before_false(known, order, limit),
        limit,
    )


def accepted_before_false(errors: Float64Array, radii: Float64Array, limit: float) -> int:
    """Return how many frames can be accepted, smallest radius first, with no error above the limit.

    Frames of one radius are accepted together or not at all.
    """
    filled = np.where(np.isnan(radii), np.inf, radii)
    false = filled[errors > limit]
    return int((filled < false.min()).sum()) if len(false) else len(errors)


def _vector(values: npt.ArrayLike, length: int | None = None) -> Float64Array:
    found = np.asarray(values, np.float64)
    if found.ndim != 1 or (length is not None and len(found) != length):
        raise InputError(f"The values have the shape {found.shape}; expected one number a frame.")
    return found
