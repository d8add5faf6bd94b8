from __future__ import annotations

import numpy as np
import pytest

from lpn.core.numbers import rounded_to_sum, shown_difference, signed, upper_bound, wrap_degrees
from lpn.core.texts import counted, listed


@pytest.mark.parametrize(
    ("value", "digits", "text"), [(0.1684, 3, "+0.168"), (-0.1684, 3, "−0.168"), (-0.0001, 3, "+0.000"), (-2, 0, "−2")]
)
def test_a_sign_is_plus_or_the_minus_sign(value: float, digits: int, text: str) -> None:
    assert signed(value, digits) == text


def test_a_bound_is_never_rounded_down() -> None:
    assert [upper_bound(value) for value in (1.1024, 1.1, 0.7 + 0.1 + 0.1, 0.0)] == ["1.2", "1.1", "0.9", "0.0"]
    assert upper_bound(1.5401, 2) == "1.55"


def test_angles_are_wrapped_to_half_a_turn() -> None:
    assert [wrap_degrees(degrees) for degrees in (-540.0, -180.0, -10.0, 180.0, 350.0)] == [-180, -180, -10, -180, -10]
    np.testing.assert_array_equal(wrap_degrees(np.array([190.0, 20.0])), [-170, 20])


@pytest.mark.parametrize(
    "values", [[0.1004, 0.2004, 0.3004], [-0.0005, 0.3125, -0.3125], [1 / 3] * 3, [], [0.5745, -0.1495]]
)
def test_rounded_numbers_add_up_to_their_rounded_sum(values: list[float]) -> None:
    rounded = rounded_to_sum(values)
    assert sum(rounded) == pytest.approx(round(sum(values), 3), abs=1e-9)
    assert all(abs(one - value) < 0.001 for one, value in zip(rounded, values, strict=True))


def test_parts_add_up_to_the_difference_of_two_numbers_that_are_shown_rounded() -> None:
    far, near = 1.6406, 1.1612  # 1.641 and 1.161
    total = shown_difference(far, near)
    assert total == 0.480
    assert round(far - near, 3) == 0.479
    parts = [0.2050, 0.1004, 0.1002, 0.0738]
    assert sum(rounded_to_sum(parts, total=total)) == pytest.approx(0.480, abs=1e-9)
    assert sum(rounded_to_sum(parts)) == pytest.approx(0.479, abs=1e-9)
    assert shown_difference(2.4557, 2.4332) == 0.023


def test_numbers_beside_one_that_is_not_finite_are_rounded_one_by_one() -> None:
    np.testing.assert_array_equal(rounded_to_sum([np.nan, 0.12349, -np.inf]), [np.nan, 0.123, -np.inf])


@pytest.mark.parametrize(
    ("words", "sentence"),
    [(["a"], "a"), (["a", "b"], "a or b"), (["a", "b", "c"], "a, b, or c"), ("abcd", "a, b, c, or d")],
)
def test_a_list_ends_with_its_conjunction(words: list[str], sentence: str) -> None:
    assert listed(words, "or") == sentence
    assert listed(words) == sentence.replace("or ", "and ")


def test_a_count_has_its_noun_in_the_right_number() -> None:
    counts = [counted(number, noun) for number, noun in ((0, "file"), (1, "photo"), (1, "query"), (2300, "query"))]
    assert counts == ["0 files", "1 photo", "1 query", "2,300 queries"]
