"""Least-distance programming by Lawson and Hanson: the point of a polyhedron that is nearest to the origin.

    minimise |x|  subject to  rows @ x >= least

is solved through the non-negative least squares problem min over u >= 0 of |E u - f| with E = [rows^T; least^T] and
f = (0, .., 0, 1): with the residual r = f - E u, x = -r[:-1] / r[-1] (Solving Least Squares Problems, chapter 23). The active
set holds at most one row more than x has numbers, so that thousands of rows cost little.
"""

from __future__ import annotations

from typing import cast

import numpy as np

from lpn.core.arrays import Float64Array

_TOLERANCE = 1e-12
_STEPS = 1000


def shortest(rows: Float64Array, least: Float64Array, limit: float) -> Float64Array | None:
    """The shortest x (d,) with rows (m, d) @ x >= least (m,); None when there is none of length `limit` or less.

    Every u >= 0 proves the bound |x|^2 >= 1 / |r|^2 - 1 for all feasible x. When no x is feasible the bound grows without
    limit, so that one sound test covers both cases of None.
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
        if residual @ residual >= previous @ previous:  # only rounding errors are left
            break
    return cast(Float64Array, -residual[:-1] / residual[-1])


def _enter(
    columns: Float64Array, target: Float64Array, active: list[int], shares: Float64Array
) -> tuple[list[int], Float64Array]:
    """Solve least squares over the active columns, dropping those whose share would not stay above zero."""
    while active:
        wanted = cast(Float64Array, np.linalg.lstsq(columns[:, active], target, rcond=None)[0])
        falling = wanted <= 0
        if not falling.any():
            return active, wanted
        # Rounding may make the entering column, which starts from zero, fall; the step is then zero, and it leaves again.
        step = float(np.min(shares[falling] / np.maximum(shares[falling] - wanted[falling], 1e-300)))
        shares = np.maximum(shares + step * (wanted - shares), 0.0)
        remaining = (shares > 0) & ~(falling & (shares <= shares[falling].min()))
        active = [index for index, remains in zip(active, remaining, strict=True) if remains]
        shares = shares[remaining]
    return active, shares
