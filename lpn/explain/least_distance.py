"""The point of a polyhedron that is nearest to the origin: least-distance programming by Lawson and Hanson.

    minimise |x|  subject to  rows @ x >= least

is solved through the non-negative least squares problem min over u >= 0 of |E u - f| with E = [rows^T; least^T] and
f = (0, .., 0, 1): with the residual r = f - E u, x = -r[:-1] / r[-1] (Solving Least Squares Problems, chapter 23). An active
set of at most as many rows as x has numbers, plus one, is kept; of thousands of rows only one is looked at closely per step.
"""

from __future__ import annotations

from typing import cast

import numpy as np

from lpn.core.arrays import Float64Array

_TOLERANCE = 1e-12
_STEPS = 1000


def shortest(rows: Float64Array, least: Float64Array, limit: float) -> Float64Array | None:
    """The shortest x (d,) with rows (m, d) @ x >= least (m,), or None when there is none of length `limit` or less.

    Every u >= 0 proves a bound: |x|^2 >= 1 / |r|^2 - 1 for all x that fulfil the rows. Without such x it grows beyond any
    limit, so that infeasible rows and those that only a longer x fulfils are told by the same sound test.
    """
    columns = np.concatenate([rows.T, least[None]])
    columns = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    target = np.zeros(len(columns))
    target[-1] = 1.0
    active: list[int] = []
    shares, residual = np.zeros(0), target
    for _ in range(_STEPS):
        if (residual @ residual) * (1 + limit**2) < 1:
            return None
        violated = residual @ columns
        violated[active] = -np.inf
        entering = int(np.argmax(violated)) if len(violated) else -1
        if entering < 0 or violated[entering] <= _TOLERANCE:
            break
        active, shares = _enter(columns, target, [*active, entering], np.append(shares, 0.0))
        previous, residual = residual, target - columns[:, active] @ shares
        if residual @ residual >= previous @ previous:  # rounding: nothing more is to be gained
            break
    return cast(Float64Array, -residual[:-1] / residual[-1])


def _enter(
    columns: Float64Array, target: Float64Array, active: list[int], shares: Float64Array
) -> tuple[list[int], Float64Array]:
    """Least squares over the active columns, giving up those whose share would not stay above zero."""
    while active:
        wanted = cast(Float64Array, np.linalg.lstsq(columns[:, active], target, rcond=None)[0])
        falling = wanted <= 0
        if not falling.any():
            return active, wanted
        # The step is nought where rounding would have the entering column fall, which starts from zero; it then leaves again.
        step = float(np.min(shares[falling] / np.maximum(shares[falling] - wanted[falling], 1e-300)))
        shares = np.maximum(shares + step * (wanted - shares), 0.0)
        kept = (shares > 0) & ~(falling & (shares <= shares[falling].min()))
        active, shares = [index for index, keep in zip(active, kept, strict=True) if keep], shares[kept]
    return active, shares
