from __future__ import annotations

import numpy as np
import pytest

from lpn.core.numbers import signed, wrap_degrees


@pytest.mark.parametrize(
    ("value", "digits", "text"), [(0.1684, 3, "+0.168"), (-0.1684, 3, "−0.168"), (-0.0001, 3, "+0.000"), (-2, 0, "−2")]
)
def test_a_sign_is_plus_or_the_minus_sign(value: float, digits: int, text: str) -> None:
    assert signed(value, digits) == text


def test_angles_are_wrapped_to_half_a_turn() -> None:
    assert [wrap_degrees(degrees) for degrees in (-540.0, -180.0, -10.0, 180.0, 350.0)] == [-180, -180, -10, -180, -10]
    np.testing.assert_array_equal(wrap_degrees(np.array([190.0, 20.0])), [-170, 20])
