"""The error of a flight's tilts, estimated from the scatter of the camera's places about a smooth track."""

from __future__ import annotations

import math

import numpy as np

from lpn.core.arrays import Float64Array

# Share of a tilt's default error that radii keep for errors that frames have in common.
COMMON = 0.5
# Neighbours that are compared with a parabola in time, fewest groups of them, and most seconds between two.
_NEIGHBOURS = 4
_LEAST_GROUPS = 12
_GAP = 30.0
# Limit of a squared difference in variances (Huber), and the mean of the limited square for normal errors.
_CUT = 4.0
_MEAN = 2 * (1 - math.exp(-_CUT / 2))
# Resolution of the estimate in degrees.
_EXACT = 0.01


def tilt_error(
    times: Float64Array, places: Float64Array, spreads: Float64Array, heights: Float64Array, most: float
) -> float:
    """Estimate the 1-sigma error of a flight's tilts in degrees, along each axis.

    A drone flies smoothly, so its place is nearly a parabola in time over four neighbouring frames, and their third divided
    difference is pure error. Its variance is the sum of the squared coefficients times spread^2 + (height tan(tilt))^2. The tilt
    solves Huber's second proposal: the squares over their variances, limited to 4, have the mean of normal errors. An error that
    a leg's frames have in common, such as that of a camera mounted askew, stays unseen.

    Args:
        times: seconds, ascending, (N,).
        places: of the camera in metres, (N, 2).
        spreads: 1-sigma radii of the places without the tilt's error, (N,) metres.
        heights: above ground in metres, (N,).
        most: the largest result in degrees. It is returned if the places scatter more, as in a flight that turns between its
            frames, or if there are fewer than 12 groups of four frames less than 30 s apart.
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
