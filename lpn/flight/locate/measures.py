"""Measures of located frames: errors in metres and coverage; `lpn.retrieval.field_metrics` has SDM@K, MA@m, and Dis@K."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import Float64Array
from lpn.core.errors import InputError
from lpn.core.numbers import SIGMA

WITHIN = (5, 10, 25, 50, 100)
# Shares in percent of errors that are normal along both axes, 1 - exp(-k^2 / 2), within k standard deviations.
RIGHT_CALIBRATION = {k: 100 * (1 - math.exp(-(k**2) / 2)) for k in (1, 2, 3)}
# Three right radii hold 99 % of the errors; a smaller share than this says that radii or truths are wrong.
CONFIRMED_SHARE = 90.0


@dataclass(frozen=True)
class ErrorSummary:
    """Errors of a stage against the tags.

    Attributes:
        frames: frames with a tag.
        answered: those of them with an accepted position.
        median, p90, p95: errors in metres of the answered ones that half, 90 %, and 95 % of them do not exceed, interpolated
            between photos; NaN without any.
        within: share in percent of all frames answered within so many metres; NaN without frames.
        coverage_at_zero: share in percent of all frames that can be accepted, most confident first, before the first one
            that is farther off than the limit; NaN without frames.
        limit: metres from which an accepted frame counts as false.
        calibration: share in percent of answers with a radius whose error is at most 1, 2, and 3 times the radius; empty without
            radii. Radii of normal errors are right at `RIGHT_CALIBRATION`.
    """

    frames: int
    answered: int
    median: float
    p90: float
    p95: float
    within: dict[int, float]
    coverage_at_zero: float
    limit: float
    calibration: dict[int, float]

    @property
    def calibration_shares(self) -> str:
        """The shares of `calibration` in words."""
        return _shares(self.calibration)

    def calibration_sentence(self, stage: str) -> str | None:
        """Return how many errors lie within 1, 2, and 3 radii, and how many should; None without radii."""
        if not self.calibration:
            return None
        return (
            f"Errors of the {stage} within 1, 2, and 3 of its radii ({SIGMA}): {self.calibration_shares}; "
            f"right radii, against an exact truth, have {_shares(RIGHT_CALIBRATION)}."
        )


def summarise(
    errors: npt.ArrayLike,
    radii: npt.ArrayLike | None = None,
    limit: float = 50.0,
    scores: npt.ArrayLike | None = None,
) -> ErrorSummary:
    """Summarise errors in metres (N,), NaN where the stage gave no accepted position.

    Args:
        radii: 1-sigma radii along each axis in metres, (N,), NaN where missing.
        scores: (N,), of a stage without radii. Answers are ordered by radius or by score for `coverage_at_zero`; a missing one
            comes last.

    Raises:
        InputError: if the shapes differ.
    """
    values = _vector(errors)
    answered = ~np.isnan(values)
    known = values[answered]
    median, p90, p95 = np.quantile(known, (0.5, 0.9, 0.95)).tolist() if len(known) else [math.nan] * 3
    missing = np.full(len(values), np.nan)
    own = (missing if radii is None else _vector(radii, len(values)))[answered]
    order = own if scores is None else -_vector(scores, len(values))[answered]
    known_radius = own > 0
    share = 100 / len(values) if len(values) else math.nan
    return ErrorSummary(
        len(values),
        len(known),
        median,
        p90,
        p95,
        {metres: share * int((known <= metres).sum()) for metres in WITHIN},
        share * accepted_before_false(known, order, limit),
        limit,
        {
            k: 100 * float((known[known_radius] <= k * own[known_radius]).mean())
            for k in RIGHT_CALIBRATION
            if known_radius.any()
        },
    )


def accepted_before_false(errors: Float64Array, radii: Float64Array, limit: float) -> int:
    """Return how many frames can be accepted, smallest radius first, with no error above the limit.

    Frames of one radius are accepted together or not at all.
    """
    filled = np.where(np.isnan(radii), np.inf, radii)
    false = filled[errors > limit]
    return int((filled < false.min()).sum()) if len(false) else len(errors)


def _vector(values: npt.ArrayLike, length: int | None = None) -> Float64Array:
    numbers = np.asarray(values, np.float64)
    if numbers.ndim != 1 or (length is not None and len(numbers) != length):
        raise InputError(f"The values have the shape {numbers.shape}; expected one number a frame.")
    return numbers


def _shares(calibration: dict[int, float]) -> str:
    return ", ".join(f"{share:.0f} %" for share in calibration.values())
