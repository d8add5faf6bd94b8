"""Cells of CSV files: no spreadsheet computes one, and each is read back as it was."""

from __future__ import annotations

import csv
import io
from random import Random

import pytest

from lpn.core.csv_cells import csv_bytes, escape_formula, unescape
from lpn.core.files import printable
from lpn.core.lists import separated


@pytest.mark.parametrize(
    ("text", "cell"),
    [
        ('=HYPERLINK("http://a.example")', '\'=HYPERLINK("http://a.example")'),
        ("@SUM(1)", "'@SUM(1)"),
        ("+41 79 123", "'+41 79 123"),
        ("- dark\n- again", "'- dark\n'- again"),
        ("-33.4 -70.6", "'-33.4 -70.6"),
        ("-2+3+cmd|' /C calc'!A0", "'-2+3+cmd|' /C calc'!A0"),
        ("\t=1+1", "'\t'=1+1"),
        ("\r=1+1", "'\r'=1+1"),
        ("\uff1d1+1", "'\uff1d1+1"),
        # In a list whose values are separated by semicolons, these are cells of their own.
        ("a;=1+1", "a;'=1+1"),
        ("a\n=1+1", "a\n'=1+1"),
        ("'=1", "''=1"),
        ("'quoted'", "'quoted'"),
        ("a-b, c = d", "a-b, c = d"),
        ("", ""),
    ],
)
def test_what_a_spreadsheet_would_compute_is_a_text(text: str, cell: str) -> None:
    assert escape_formula(text) == cell
    assert unescape(cell) == text


@pytest.mark.parametrize("number", ["-5.5", "-.5", "+3", "-1e-05", "12", "-5.5;-6", "-7."])
def test_numbers_stay_numbers(number: str) -> None:
    assert escape_formula(number) == number


def test_any_text_is_read_back() -> None:
    rng, letters = Random(36), "=+-@'\t\r\n;,\"a1. \uff1d5e\x0b\u2028\0"
    rows = [["".join(rng.choices(letters, k=rng.randrange(8))) for _ in range(4)] for _ in range(2000)]
    data = csv_bytes(rows, own=True)
    assert list(csv.reader(io.StringIO(data.decode(), newline=""))) == [list(map(escape_formula, row)) for row in rows]
    read = [[unescape(cell) for cell in values] for _, values in separated("a,b,c,d\n" + data.decode(), "a").rows][1:]
    assert read == [row for row in rows if any(map(str.strip, row))]
    # A table for other programs has no characters that control a terminal, see `printable`.
    shown = [[printable(cell, "\n\t") for cell in row] for row in rows]
    assert csv_bytes(rows) == csv_bytes(shown, own=True)
    assert not {"\r", "\x0b", "\u2028", "\0"} & set(csv_bytes(rows).decode())


def test_numbers_unknown_values_and_other_bytes() -> None:
    assert csv_bytes([["a\r b", None, -0.25, -3, True]], own=True) == b'"a\r b",,-0.25,-3,True\n'
    assert csv_bytes([["a\r b", None, -0.25, -3, True]]) == b"a? b,,-0.25,-3,True\n"
    assert csv_bytes([["\u200f(1)\x07"]], keep="\u200f") == "\u200f(1)?\n".encode()
    assert csv_bytes([["caf\udce9"]]) == b"caf?\n"
    assert csv_bytes([["caf\udce9"]], own=True) == b"caf\xe9\n"
    assert list(separated('a,"b\nc"\n\nd\n', "a").rows) == [(2, ["a", "b\nc"]), (4, ["d"])]


def test_a_long_text_takes_no_time() -> None:
    for text in ("'" * 500_000, ";'" * 250_000, ";" + "9" * 500_000, "=" * 500_000):
        assert unescape(escape_formula(text)) == text
