"""Numbers and angles in every spelling that people and programs have, and what is none."""

from __future__ import annotations

import numpy as np
import pytest

from lpn.core.errors import DataError
from lpn.flight.files.values import angle, decoded, number, plain, seem_radians


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("-70.5", -70.5),
        ("−70.5", -70.5),
        ("W: 70.5", -70.5),
        ("70.5W", -70.5),
        ("8.5 East", 8.5),
        ("W: -117.-9605", -117.9605),
        ("47° 18' 4.44\" N", 47.301233333333336),
        ("47 deg 18' 4.44\" S", -47.301233333333336),
        ("47 deg 18.074' N", 47.301233333333336),
        ("W 106d 18m 22.644s", -106.30629),
        ("47:18:4.44", 47.301233333333336),
        ("4718.074 N", 47.301233333333336),
        ("47,18.074N", 47.301233333333336),
        ("47.3012°", 47.3012),
        ("E -117.5", None),
        ("47,301", None),
        ("47.3 18", None),
        ("47 61 N", None),
        ("N/A", None),
        ("nan", None),
    ],
)
def test_angles_are_read_in_every_spelling(text: str, expected: float | None) -> None:
    assert angle(text) == (None if expected is None else pytest.approx(expected, abs=1e-9))


def test_a_letter_must_fit_and_a_decimal_comma_must_be_meant() -> None:
    assert angle("70.5 W", "NS") is None
    assert angle("47,301", "NS", comma=True) == 47.301


@pytest.mark.parametrize(
    ("text", "points", "commas"),
    [
        ("45.2 m", 45.2, 45.2),
        ("100 ft", 30.48, 30.48),
        ("1,234.5", 1234.5, 1234.5),
        ("1.234,5", 1234.5, 1234.5),
        ("1,234", 1234.0, 1.234),
        ("12,5", 12.5, 12.5),
        ("1 234.5", 1234.5, 1234.5),
        ("12,5,1", None, None),
        ("512.3 m Below Sea Level", -512.3, -512.3),
        ("+76.19", 76.19, 76.19),
        ("73.7 deg", 73.7, 73.7),
        ("4.7e2", 470.0, 470.0),
        ("12 fathoms", None, None),
        ("1_0", None, None),
        ("inf", None, None),
    ],
)
def test_a_number_is_read_whole_or_not_at_all(text: str, points: float | None, commas: float | None) -> None:
    assert number(text) == (None if points is None else pytest.approx(points))
    assert number(text, comma=True) == (None if commas is None else pytest.approx(commas))


def test_signs_of_other_alphabets_and_tags_become_plain() -> None:
    assert plain('<font size="28">GPS（47.3，8.5）−1º</font>') == " GPS(47.3,8.5)-1° "


@pytest.mark.parametrize("encoding", ["utf-8", "utf-8-sig", "utf-16", "utf-16-le", "utf-16-be", "cp1252"])
def test_text_of_every_common_encoding_is_read(encoding: str) -> None:
    assert decoded("Höhe (°)\n1;2\n".encode(encoding), "a").replace("\ufeff", "") == "Höhe (°)\n1;2\n"


def test_a_binary_file_is_no_text() -> None:
    with pytest.raises(DataError, match=r"a\.csv is no text"):
        decoded(b"\x00\x01\x02\x00\x00\x05abc", "a.csv")


def test_radians_are_told_from_degrees_by_where_and_how_close_they_are() -> None:
    latitudes, longitudes = np.array([0.825562, 0.825563]), np.array([0.148374, 0.148375])
    assert seem_radians(latitudes, longitudes, ["0.825562", "0.825563"])
    assert not seem_radians(latitudes, longitudes, ["0.8", "0.8"])
    assert not seem_radians(latitudes * 60, longitudes, ["49.53372", "49.53378"])
    assert not seem_radians(np.array([0.82, 0.83]), longitudes, ["0.820000", "0.830000"])
