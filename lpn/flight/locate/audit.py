"""An audit of a flight's tags against its registered positions: their lag and their error."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import cast

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.numbers import upper_bound

# An unknown position.
UNKNOWN = (math.nan, math.nan)
# Minimum of frames for the estimate of a lag.
MIN_FRAMES = 8
# Maximum of seconds between neighbours that give a velocity.
_GAP = 30.0
# Multiples of the robust spread beyond which a frame counts less (Huber).
_HUBER = 1.345


@dataclass(frozen=True)
class TagAudit:
    """Tags against registered positions.

    Attributes:
        frames: number of frames with both.
        median, largest: metres between tag and registered position.
        lag: seconds by which tags are late; if it cannot be estimated, it and all figures below are NaN.
        lag_error: its standard error in seconds.
        without_lag: median residual in metres after the lag and a constant offset are subtracted.
        offset: length of that constant offset in metres, from positions to tags; it may be the map's error.
        without_offset: median residual in metres after the best constant offset alone is subtracted.
        ahead: metres flown in the lag at the median speed. A camera that looks as far ahead (behind, if
            negative) explains the tags as well. NaN if the positions are the camera's.
    """

    frames: int
    median: float
    largest: float
    lag: float = math.nan
    lag_error: float = math.nan
    without_lag: float = math.nan
    offset: float = math.nan
    without_offset: float = math.nan
    ahead: float = math.nan

    @property
    def has_lag(self) -> bool:
        """True if the tags have a constant lag that clearly exceeds its error and explains their differences."""
        # A lag within its error, or without an improvement over a constant offset, does not count.
        return abs(self.lag) >= max(3 * self.lag_error, 0.3) and self.without_lag <= 0.9 * self.without_offset

    @property
    def sentence(self) -> str:
        """The finding in one sentence."""
        if not self.frames:
            return "No photo has both a GPS tag and a registered position, so the tags were not checked."
        off = f"up to {upper_bound(self.largest)} m off, {self.median:.1f} m in the median"
        if not self.has_lag:
            return f"The GPS tags of {self.frames} photos are {off}, against registered positions; the lag cannot be estimated."
        word = "lag" if self.lag > 0 else "are early"
        tilted = " and"
        if not math.isnan(self.ahead):
            side = "ahead" if self.ahead > 0 else "behind"
            tilted = f", or the camera looks {abs(self.ahead):.1f} m {side}; they"
        return (
            f"The GPS tags {word} by {abs(self.lag):.1f} s (± {self.lag_error:.1f}){tilted} are {off}, against "
            f"registered positions of {self.frames} photos; without the lag and a constant offset of {self.offset:.1f} m, "
            f"{self.without_lag:.1f} m remain in the median, which neither explains."
        )


def audit_tags(times: Float64Array, tags: Float64Array, positions: Float64Array, middles: bool = False) -> TagAudit:
    """Compare tags with registered positions, and estimate the lag of the tags.

    A tag that is late by s seconds has the place of s seconds before: tag - position = -s v + offset. A robust fit over
    the velocities v of the registered track gives s.

    Args:
        times: seconds, (N,); NaN where unknown.
        tags, positions: metres east and north, (N, 2); NaN rows where there is none.
        middles: True if positions are the pictures' middles; a camera that looks ahead then resembles a lag.
    """
    differences = tags - positions
    off = np.linalg.norm(differences, axis=1)
    known = ~np.isnan(off)
    if not known.any():
        return TagAudit(0, math.nan, math.nan)
    audit = TagAudit(int(known.sum()), float(np.median(off[known])), float(off[known].max()))
    velocities = track_velocities(times, positions)
    used = known & ~np.isnan(velocities).any(axis=1)
    if used.sum() < MIN_FRAMES:
        return audit
    v, d = velocities[used], differences[used]
    # Unknowns: minus the lag, and the offset east and north. Rows: all differences east, then all north.
    design = np.column_stack([v.T.ravel(), np.repeat(np.eye(2), len(v), axis=0)])
    values = d.T.ravel()
    solution, errors = _robust_fit(design, values)
    constant, _ = _robust_fit(design[:, 1:], values)
    return replace(
        audit,
        lag=float(-solution[0]),
        lag_error=float(errors[0]),
        without_lag=float(np.median(np.linalg.norm(d - solution[0] * v - solution[1:], axis=1))),
        offset=float(np.linalg.norm(solution[1:])),
        without_offset=float(np.median(np.linalg.norm(d - constant, axis=1))),
        ahead=float(-solution[0] * np.median(np.linalg.norm(v, axis=1))) if middles else math.nan,
    )


def corrected_tags(times: Float64Array, tags: Float64Array, lag: float) -> Float64Array:
    """Return tags without a constant lag, (N, 2): each place is taken `lag` seconds later, interpolated linearly.

    A place is NaN if a tag before or after it is missing, or these are more than 30 seconds apart. The audit's offset is not
    subtracted, because it may be the map's error.

    Args:
        times: seconds, (N,); NaN where unknown.
        tags: metres east and north, (N, 2); NaN rows where there is none.
        lag: seconds by which tags are late.
    """
    moved, known = np.full(tags.shape, np.nan), _in_time(times, tags)
    if len(known) < 2:
        return moved
    at = times[known]
    after = np.clip(np.searchsorted(at, at + lag), 1, len(known) - 1)
    inside = (at + lag >= at[0]) & (at + lag <= at[-1]) & (at[after] - at[after - 1] <= _GAP)
    for axis in (0, 1):
        moved[known[inside], axis] = np.interp(at + lag, at, tags[known, axis])[inside]
    return moved


def track_velocities(times: Float64Array, positions: Float64Array) -> Float64Array:
    """Return velocities in metres a second, (N, 2), from the neighbours before and after; NaN without near ones."""
    velocities, known = np.full(positions.shape, np.nan), _in_time(times, positions)
    for before, here, after in zip(known, known[1:], known[2:], strict=False):
        elapsed = times[after] - times[before]
        if 0 < elapsed <= 2 * _GAP:
            velocities[here] = (positions[after] - positions[before]) / elapsed
    return velocities


def _in_time(times: Float64Array, places: Float64Array) -> Int64Array:
    """Return the indices of known times and places (N, 2), in the order of time."""
    known = np.flatnonzero(~np.isnan(times) & ~np.isnan(places).any(axis=1))
    return known[np.argsort(times[known], kind="stable")]


def _robust_fit(design: Float64Array, values: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Fit by least squares with Huber's weights; return the solution and its standard errors."""
    weights = np.ones(len(values))
    for _ in range(20):
        scaled = design * weights[:, None]
        gram = scaled.T @ design + 1e-9 * np.eye(design.shape[1])
        solution = np.linalg.solve(gram, scaled.T @ values)
        residuals = values - design @ solution
        spread = 1.4826 * float(np.median(np.abs(residuals))) + 1e-9
        weights = np.minimum(1.0, _HUBER * spread / np.maximum(np.abs(residuals), 1e-12))
    free = max(len(values) - design.shape[1], 1)
    variance = float((weights * residuals**2).sum()) / free
    return cast(Float64Array, solution), cast(Float64Array, np.sqrt(variance * np.diag(np.linalg.inv(gram))))
