"""Errors of a flight's places against GPS tags, surveyed positions, or corrections."""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from lpn.core.arrays import Float64Array

# Limits in metres of the shares in tables and JSON.
WITHIN = (5, 10, 25, 50, 100)
# Percent of errors within k standard deviations, 1 - exp(-k^2 / 2), if errors are normal along both axes.
RIGHT_CALIBRATION = {k: 100 * (1 - math.exp(-(k**2) / 2)) for k in (1, 2, 3)}
# Minimum percentage of errors within three radii, ideally 99; a lower one shows that radii or truths are wrong.
CONFIRMED_SHARE = 90.0
# Minimum number of independent photos for a bias, and the multiple of the standard error that makes it systematic.
_LEAST_FOR_BIAS, _SYSTEMATIC = 8, 3.0
_AXES = ("east", "north")
# Metres below which errors count as equal.
_EQUAL = 1e-6


@dataclass(frozen=True, eq=False)
class Errors:
    """Errors of positions against their truths.

    Attributes:
        known: number of photos with a truth.
        offsets: position minus truth in metres east and north, (N, 2), of photos with both, in the flight's order.
        radii: 1-sigma radii of these positions in metres, (N,); NaN where unknown.
    """

    known: int
    offsets: Float64Array
    radii: Float64Array

    @classmethod
    def of(cls, known: int, rows: Iterable[tuple[float, float, float | None]]) -> Errors:
        """Make errors of rows: metres east, metres north, and the radius or None."""
        values = np.array([*rows], np.float64).reshape(-1, 3)  # None becomes NaN
        return cls(known, values[:, :2], values[:, 2])

    @property
    def photos(self) -> int:
        """Number of photos with a truth and a position."""
        return len(self.offsets)

    @cached_property
    def metres(self) -> Float64Array:
        """Distances in the plane, (N,)."""
        metres: Float64Array = np.hypot(self.offsets[:, 0], self.offsets[:, 1])
        return metres

    def quantile(self, share: float) -> float:
        """Return the quantile of the distances in metres for a share, 0 .. 1, interpolated; NaN without photos."""
        return float(np.quantile(self.metres, share)) if self.photos else math.nan

    @property
    def median(self) -> float:
        """Median of the distances; NaN without any."""
        return self.quantile(0.5)

    @property
    def ce90(self) -> float:
        """The circular error: 90 % of the distances are at most this."""
        return self.quantile(0.9)

    @property
    def ce95(self) -> float:
        """The circular error: 95 % of the distances are at most this."""
        return self.quantile(0.95)

    @property
    def largest(self) -> float:
        """The largest distance."""
        return self.quantile(1.0)

    @property
    def calibration(self) -> dict[int, float]:
        """Percent of errors within 1, 2, and 3 radii, ideally `RIGHT_CALIBRATION`; empty without radii."""
        given = self.radii > 0
        ratios = self.metres[given] / self.radii[given]
        return {k: 100 * float((ratios <= k).mean()) for k in RIGHT_CALIBRATION if len(ratios)}

    @property
    def within(self) -> dict[int, float]:
        """Percent of photos with a truth whose error is at most each limit of `WITHIN` in metres; empty without any."""
        return {metres: 100 * int((self.metres <= metres).sum()) / self.known for metres in WITHIN if self.known}

    @cached_property
    def figures(self) -> dict[str, Any]:
        """The figures for tables and JSON, in metres and percent; NaN where there are too few photos.

        Each axis has its mean (`bias`), standard deviation with N - 1 (`spread`), root mean square, and effective number of
        independent photos, because neighbours err alike. The figures include the other properties.
        """
        offsets = self.offsets if self.photos else np.full((1, 2), math.nan)
        squares = np.sqrt((offsets**2).mean(axis=0))
        axes = {
            "rmse": squares,
            "bias": offsets.mean(axis=0),
            "spread": offsets.std(axis=0, ddof=1) if self.photos > 1 else (math.nan, math.nan),
            "independent": map(_independent, self.offsets.T),
        }
        figures: dict[str, Any] = {"known": self.known, "photos": self.photos, "rmse": math.hypot(*squares)}
        figures |= {name: getattr(self, name) for name in ("median", "ce90", "ce95", "largest")}
        for name, values in axes.items():
            figures |= {f"{name}_{axis}": float(value) for axis, value in zip(_AXES, values, strict=True)}
        figures |= {"radii": int((self.radii > 0).sum()), "within": self.calibration, "within_metres": self.within}
        return figures

    @property
    def bias_sentence(self) -> str:
        """A sentence on whether the mean exceeds chance; "" with too few photos."""
        told = []
        for axis in _AXES:
            mean, spread, count = (self.figures[f"{name}_{axis}"] for name in ("bias", "spread", "independent"))
            if count >= _LEAST_FOR_BIAS:
                error = spread / math.sqrt(count)
                beyond = "more" if abs(mean) > _SYSTEMATIC * error else "no more"
                told.append(
                    f"{mean + 0.0:.2f} m {axis} (± {error:.2f}, {beyond} than {_SYSTEMATIC:g} standard errors of "
                    f"{int(count)} independent photos)"
                )
        return f"The mean is {' and '.join(told)}." if told else ""


def percents(shares: dict[int, float]) -> str:
    """Return shares in words."""
    return ", ".join(f"{share:.0f} %" for share in shares.values())


def _independent(errors: Float64Array) -> float:
    """Return the effective number of independent errors among these, (n,), in the flight's order.

    It is n / (1 + 2 sum r), with the correlations r of first, second, and further neighbours up to the first negative one.
    """
    off, n = errors - errors.mean() if len(errors) else errors, len(errors)
    if n < 2 or np.ptp(errors) < _EQUAL:
        return float(n)
    shown = np.correlate(off, off, "full")[n:] / (off @ off)
    negative = np.flatnonzero(shown <= 0)
    return max(n / (1 + 2 * float(shown[: negative[0] if len(negative) else n].sum())), 1.0)
