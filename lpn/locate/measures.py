"""Measures of located frames: errors in metres, coverage, and the field's SDM@K, MA@m, and Dis@K."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float64Array
from lpn.core.errors import InputError

WITHIN = (5, 10, 25, 50, 100)
# Decay of DenseUAV's SDM, per degree, and of GTA-UAV's, per metre.
DENSEUAV_DECAY = 5000.0
GTA_UAV_DECAY = 0.001
# The radius in metres that DenseUAV's evaluation uses.
_EARTH = 6_378_137.0


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


def recall_at(hits: npt.ArrayLike, k: int) -> float:
    """Return the share in percent of queries with a hit among the first k of their ranked tiles; hits: (Q, R) bool.

    Raises:
        InputError: if k is not between 1 and R.
    """
    values: BoolArray = np.asarray(hits, bool)
    _check_depth(values.shape, k)
    return float(100 * values[:, :k].any(axis=1).mean()) if len(values) else 0.0


def sdm_at(distances: npt.ArrayLike, k: int, decay: float) -> Float64Array:
    """Return SDM@K of each query: sum of (K - i) exp(-decay d_i) over i < K, divided by the sum of K - i, (Q,).

    With distances in degrees and `DENSEUAV_DECAY` it is DenseUAV's (Dai et al., 2023), with metres and `GTA_UAV_DECAY` that of
    GTA-UAV (Ji et al., 2024).

    Args:
        distances: from each query to its ranked tiles, nearest in score first, (Q, R).

    Raises:
        InputError: if k is not between 1 and R.
    """
    values = np.asarray(distances, np.float64)
    _check_depth(values.shape, k)
    weights = np.arange(k, 0, -1, dtype=np.float64)
    return cast(Float64Array, np.exp(-decay * values[:, :k]) @ weights / weights.sum())


def distance_at(distances: npt.ArrayLike, k: int) -> Float64Array:
    """Return Dis@K of each query: the mean distance of its first k tiles, (Q,).

    Raises:
        InputError: if k is not between 1 and R.
    """
    values = np.asarray(distances, np.float64)
    _check_depth(values.shape, k)
    return cast(Float64Array, values[:, :k].mean(axis=1))


def accuracy_within(top_distances: npt.ArrayLike, metres: float) -> float:
    """Return MA@m: the share in percent of queries whose top answer is nearer than m metres; top_distances: (Q,)."""
    values = _vector(top_distances)
    return float(100 * (values < metres).mean()) if len(values) else 0.0


def degree_distances(queries: npt.ArrayLike, tiles: npt.ArrayLike) -> Float64Array:
    """Return DenseUAV's distance in degrees between latitude and longitude (..., 2), in single precision as released."""
    a, b = np.asarray(queries, np.float32), np.asarray(tiles, np.float32)
    return cast(Float64Array, np.sqrt(((a - b) ** 2).sum(axis=-1)).astype(np.float64))


def great_circle(queries: npt.ArrayLike, tiles: npt.ArrayLike) -> Float64Array:
    """Return the haversine distance in metres between latitude and longitude in degrees (..., 2), as DenseUAV's MA@m uses it."""
    a, b = np.radians(np.asarray(queries, np.float64)), np.radians(np.asarray(tiles, np.float64))
    half = np.sin((b - a) / 2) ** 2
    chord = half[..., 0] + np.cos(a[..., 0]) * np.cos(b[..., 0]) * half[..., 1]
    return cast(Float64Array, 2 * _EARTH * np.arcsin(np.sqrt(np.clip(chord, 0, 1))))


def _vector(values: npt.ArrayLike, length: int | None = None) -> Float64Array:
    found = np.asarray(values, np.float64)
    if found.ndim != 1 or (length is not None and len(found) != length):
        raise InputError(f"The values have the shape {found.shape}; expected one number a frame.")
    return found


def _check_depth(shape: tuple[int, ...], k: int) -> None:
    if len(shape) != 2 or not 1 <= k <= shape[1]:
        raise InputError(
            f"K is {k} and the ranked tiles have the shape {shape}; expected (queries, tiles) and K in 1 .. tiles."
        )
