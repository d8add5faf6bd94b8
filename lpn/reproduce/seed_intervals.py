"""95 % intervals over networks that differ by their random seed alone, by Student's t."""

from __future__ import annotations

from collections.abc import Sequence
from statistics import variance

_LEVEL = 0.95


def half_interval(values: Sequence[float]) -> float:
    """Return half the width of the mean's interval; 0 for one value, which says nothing about its seed."""
    if len(values) < 2:
        return 0.0
    return _quantile(len(values) - 1) * float((variance(values) / len(values)) ** 0.5)


def half_interval_of_difference(first: Sequence[float], second: Sequence[float]) -> float:
    """Return half the width of Welch's interval of the difference of two means; 0 if either has one value."""
    if len(first) < 2 or len(second) < 2:
        return 0.0
    errors = [variance(values) / len(values) for values in (first, second)]
    total = sum(errors)
    if total == 0:
        return 0.0
    freedom = total**2 / sum(
        error**2 / (len(values) - 1) for error, values in zip(errors, (first, second), strict=True)
    )
    return _quantile(freedom) * float(total**0.5)


def _quantile(freedom: float) -> float:
    from scipy.stats import t

    return float(t.ppf((1 + _LEVEL) / 2, freedom))
