"""Numbers for readers, and angles within half a turn."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from lpn.core.arrays import Float64Array

_Degrees = TypeVar("_Degrees", float, "Float64Array")
# Decimal places of scores, squared distances, and their shares.
_DIGITS = 3
# The confidence of each radius of a place, in words.
SIGMA = "1 sigma along each axis"


def signed(value: float, digits: int = _DIGITS) -> str:
    """Format a number with a sign, "+" or the minus sign "−" (U+2212), and some decimal places; zero is positive."""
    text = f"{value:+.{digits}f}"
    return text.replace("-", "−") if float(text) else f"+{0:.{digits}f}"


def rounded_to_sum(values: Sequence[float], total: float | None = None) -> list[float]:
    """Round numbers to three decimal places so that they add up to their rounded sum, by the largest remainders.

    If any is not finite, each is rounded separately.

    Args:
        total: the displayed sum if it is rounded in another way; it may differ by one unit of the last decimal place.
    """
    if not all(map(math.isfinite, values)):
        return [round(float(value), _DIGITS) for value in values]
    scale = 10**_DIGITS
    exact = [float(value) * scale for value in values]
    rounded = [math.floor(value) for value in exact]
    shown = math.fsum(map(float, values)) if total is None else total
    missing = round(round(shown, _DIGITS) * scale) - sum(rounded)
    by_remainder = sorted(range(len(exact)), key=lambda i: rounded[i] - exact[i])
    for i in by_remainder[: max(missing, 0)]:
        rounded[i] += 1
    return [value / scale for value in rounded]


def shown_difference(one: float, other: float) -> float:
    """Return the difference of two numbers as displayed: 1.641 less 1.161 is 0.480, even if it is 0.4794 unrounded."""
    return round(round(one, _DIGITS) - round(other, _DIGITS), _DIGITS)


def distance(metres: float) -> str:
    """Format a distance: in whole metres, from 10 km on in whole kilometres."""
    return f"{metres:,.0f} m" if metres < 10_000 else f"{metres / 1000:,.0f} km"


def upper_bound(value: float, digits: int = 1) -> str:
    """Format a bound, such as the metres within which errors lie, rounded up to some decimal places."""
    # A float may lie a little above its decimal; that must not round it up.
    return f"{math.ceil(round(value * 10**digits, 6)) / 10**digits:,.{digits}f}"


def error_figure(metres: float) -> str:
    """Format an error in metres with one decimal place; below 10 cm, with two significant digits."""
    return f"{metres:.1f}" if metres >= 0.1 or metres == 0 else f"{metres:.2g}"


def heading_figure(degrees: float | None) -> float | None:
    """Round a heading to one decimal place from 0.0 to 359.9; 359.97 becomes 0.0. None if it is unknown or not finite."""
    return None if degrees is None or not math.isfinite(degrees) else round(degrees, 1) % 360


def wrap_degrees(degrees: _Degrees) -> _Degrees:
    """Return an angle from -180 up to 180 degrees."""
    return (degrees + 180) % 360 - 180
