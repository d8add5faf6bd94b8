"""The error of a flight's tilts, estimated from how the camera's places scatter about a smooth track."""

from __future__ import annotations

import math

import numpy as np

from lpn.core.arrays import Float64Array

# Share of the error told of a tilt that radii keep for what frames have in common.
COMMON = 0.5
# Neighbours whose places are compared with a parabola in time, groups of them at least, and seconds between two at most.
_NEIGHBOURS = 4
_LEAST_GROUPS = 12
_GAP = 30.0
# The square of a difference counts with at most this multiple of its variance (Huber), and its mean for normal errors.
_CUT = 4.0
_MEAN = 2 * (1 - math.exp(-_CUT / 2))
# Degrees to which the estimate is exact.
_EXACT = 0.01


def tilt_error(
    times: Float64Array, places: Float64Array, spreads: Float64Array, heights: Float64Array, most: float
) -> float:
    """Estimate the 1-sigma error of a flight's tilts in degrees, along each axis.

    A drone flies smoothly, so its place is nearly a parabola in time over four neighbouring frames. Their third divided
    difference is then error alone. Its variance is that of the places, spread^2 + (height tan(tilt))^2, times the squared
    coefficients. The tilt is Huber's second proposal: the squares over their variances, cut at 4, have the mean of normal
    errors. An error that the frames of a leg have in common, such as that of a camera mounted askew, is not seen.

    Args:
        times: seconds, ascending, (N,).
        places: of the camera in metres, (N, 2).
        spreads: 1-sigma radii of the places without the tilt's error, (N,) metres.
        heights: above ground in metres, (N,).
        most: the largest answer in degrees. It is the answer if the places scatter more, as those of a flight that turns between
            its frames do, and if fewer than 12 groups of four frames less than 30 s apart tell.
    """
    squares, shares = [], []
    for i in range(len(times) - _NEIGHBOURS + 1):
        group = slice(i, i + _NEIGHBOURS)
        gaps = np.diff(times[group])
        if not ((gaps > 0) & (gaps <= _GAP)).all():
            continue
        apart = times[group, None] - times[group]
        np.fill_diagonal(apart, 1)
        weights = 1 / apart.prod(axis=1)
        weights /= np.linalg.norm(weights)
        squares.append(((weights @ places[group]) ** 2).sum())
        shares.append([(weights**2) @ values[group] ** 2 for values in (spreads, heights)])
    if len(squares) < _LEAST_GROUPS:
        return most
    scatter, (own, height) = np.array(squares), np.array(shares).T

    def too_small(degrees: float) -> bool:
        variances = np.maximum(own + height * math.tan(math.radians(degrees)) ** 2, 1e-12)
        return bool(np.minimum(scatter / variances, _CUT).mean() > _MEAN)

    low, high = 0.0, most
    if too_small(high):
        return most
    while high - low > _EXACT:
        middle = (low + high) / 2
        low, high = (middle, high) if too_small(middle) else (low, middle)
    return high
