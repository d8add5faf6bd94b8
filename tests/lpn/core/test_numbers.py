from __future__ import annotations

import pytest

from lpn.core.numbers import signed


@pytest.mark.parametrize(
    ("value", "digits", "text"), [(0.1684, 3, "+0.168"), (-0.1684, 3, "−0.168"), (-0.0001, 3, "+0.000"), (-2, 0, "−2")]
)
def test_a_sign_is_plus_or_the_minus_sign(value: float, digits: int, text: str) -> None:
    assert signed(value, digits) == text
