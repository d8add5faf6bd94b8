"""Errors against sums written out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import pytest

from lpn.flight.locate.errors import RIGHT_CALIBRATION, Errors


def to_the_north(norths: Sequence[float]) -> Errors:
    """Return errors to the north; those to the east are 1 m to either side by turns."""
    return Errors.of(len(norths), [((-1.0) ** i, north, 1.0) for i, north in enumerate(norths)])


def test_figures_are_those_written_out() -> None:
    errors = Errors.of(8, [(3.0, 4.0, 2.0), (1.0, 0.0, 2.0)])
    roots = [math.sqrt(square) for square in (5, 8, 13)]
    told = errors.figures
    assert [told[name] for name in ("known", "photos", "bias_east", "bias_north")] == [8, 2, 2.0, 2.0]
    assert [told[name] for name in ("rmse_east", "rmse_north", "rmse")] == pytest.approx(roots)
    assert [told["spread_east"], told["spread_north"]] == pytest.approx([math.sqrt(2), math.sqrt(8)])
    assert (errors.median, errors.ce90, errors.ce95, errors.largest) == pytest.approx((3.0, 4.6, 4.8, 5.0))
    assert errors.calibration == {1: 50.0, 2: 50.0, 3: 100.0}
    assert errors.within == {5: 25.0, 10: 25.0, 25: 25.0, 50: 25.0, 100: 25.0}, "of all photos with a truth"
    assert errors.bias_sentence == "", "two photos tell nothing of chance"
    assert {"median", "ce95", "largest", "radii", "within"} <= told.keys()


def test_without_photos_or_radii_nothing_is_told() -> None:
    none, bare = Errors.of(3, []), Errors.of(1, [(1.0, 0.0, None)])
    assert math.isnan(none.median)
    assert none.within[5] == 0.0
    assert none.calibration == bare.calibration == {}
    assert none.figures["photos"] == 0


def test_radii_of_normal_errors_are_right() -> None:
    rng = np.random.default_rng(0)
    radii = rng.uniform(1, 9, 20_000)
    errors = Errors(20_000, rng.normal(0, 1, (20_000, 2)) * radii[:, None], radii)
    assert errors.calibration == pytest.approx(RIGHT_CALIBRATION, abs=1)


def test_a_mean_that_chance_hardly_explains_is_told_and_a_leg_errs_as_one() -> None:
    sentence = to_the_north([-3.0, -2.5, -2.9, -2.6, -2.8, -2.7, -3.0, -2.5]).bias_sentence
    assert "0.00 m east (± 0.38, no more than 3 standard errors of 8 independent photos)" in sentence
    assert "-2.75 m north (± 0.07, more than 3 standard errors" in sentence
    one_leg = to_the_north([*[0.0] * 6, *[-3.0] * 6, *[0.0] * 6])
    # The correlations of first, second, and third neighbours are 26/36, 16/36, and 6/36; the fourth is negative.
    assert one_leg.figures["independent_north"] == pytest.approx(18 / (1 + 2 * 48 / 36))
    assert "north" not in one_leg.bias_sentence
    assert to_the_north([0.1] * 9).figures["independent_north"] == 9, (
        "equal errors count each, though their mean is inexact"
    )
