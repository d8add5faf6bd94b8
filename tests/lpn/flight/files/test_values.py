"""Numbers, angles, and times as programs write them, and texts that are none."""

from __future__ import annotations

import pytest

from lpn.core.errors import DataError
from lpn.flight.files.values import Moment, angle, decoded, moment, moment_in, number


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-70.5", -70.5), ("−70.5", -70.5), ("W: 70.5", -70.5), ("70.5W", -70.5), ("W: -70.5", -70.5),
        ("47,18,4.44N", 47.301233333333336), ("33,51.0S", -33.85), ("47,78.0N", None),
        ("47° 18' 4.44\" N", 47.301233333333336), ("47 deg 18' 4.44\" S", -47.301233333333336),
        ("47 deg 18.074' N", 47.301233333333336), ("47:18:4.44", 47.301233333333336), ("47,18.074N", 47.301233333333336),
        ("47.3012°", 47.3012), ("E -117.5", None), ("47,301", None), ("47.3° 18'", None), ("47° 61' N", None), ("N/A", None),
        ("nan", None), ("N 47 N", None),
    ],
)  # fmt: skip
def test_an_angle_is_read_whole_or_not_at_all(text: str, expected: float | None) -> None:
    assert angle(text) == (None if expected is None else pytest.approx(expected, abs=1e-9))


def test_a_letter_must_fit_and_a_decimal_comma_must_be_meant() -> None:
    assert angle("70.5 W", "NS") is None
    assert angle("47,301 N", "NS", comma=True) == 47.301


@pytest.mark.parametrize(
    ("text", "points", "commas"),
    [
        ("45.2 m", 45.2, 45.2), ("100 ft", 30.48, 30.48), ("-8759/100", -87.59, -87.59), ("1/0", None, None), ("0/0", None, None),
        (".5", 0.5, 0.5), ("", None, None), ("nan", None, None),
        ("1,234.5", None, None), ("1,234", None, 1.234), ("12,5 m", None, 12.5), ("512.3 m Below Sea Level", -512.3, -512.3),
        ("+76.19", 76.19, 76.19), ("73.7 deg", 73.7, 73.7), ("4.7e2", 470.0, 470.0), ("12 fathoms", None, None),
        ("1_0", None, None), ("1e999", None, None), ("1e+999", None, None), ("inf", None, None),
    ],
)  # fmt: skip
def test_a_number_is_read_whole_or_not_at_all(text: str, points: float | None, commas: float | None) -> None:
    assert number(text) == (None if points is None else pytest.approx(points))
    assert number(text, comma=True) == (None if commas is None else pytest.approx(commas))


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("2024:05:01 12:00:00", Moment(1714564800.0, False)),
        ("2024-05-01T14:00:00.500+02:00", Moment(1714564800.5, True)),
        ("2024-05-01T12:00:00Z", Moment(1714564800.0, True)),
        ("2024/05/01 12:00:00 UTC", Moment(1714564800.0, True)),
        ("2024-05-01 12:00:00,250,500", Moment(1714564800.2505, False)),
        ("5/13/2024 12:00 PM", Moment(1715601600.0, False)),
        ("13/5/2024 12:00:00", Moment(1715601600.0, False)),
        ("5/1/2024 12:00:00 AM", Moment(1714521600.0, False)),
        ("01.05.2024 12:00:00", Moment(1714564800.0, False)),
        ("2024-05-01", None),
        ("2024-05-01 12:00:00+25:00", None),
        ("2024-13-01 12:00:00", None),
        ("2024-05-01 25:00:00", None),
    ],
)
def test_a_moment_is_read_in_every_spelling(text: str, expected: Moment | None) -> None:
    assert moment(text) == expected
    assert moment_in(f"FrameCnt: 1\n{text}\nISO:100") == expected


def test_the_day_comes_first_where_the_file_says_so() -> None:
    assert moment("5/1/2024 12:00:00", day_first=True) == Moment(1704456000.0, False)


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_text_of_every_common_encoding_is_read(encoding: str) -> None:
    assert decoded("Höhe (°)\n1;2\n".encode(encoding), "a") == "Höhe (°)\n1;2\n"


def test_a_binary_file_is_no_text() -> None:
    with pytest.raises(DataError, match=r"a\.csv is no text"):
        decoded(b"\x00\x01\x02\x00\x00\x05abc", "a.csv")
