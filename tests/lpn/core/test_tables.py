from __future__ import annotations

import contextlib
import csv
import io
import time

import numpy as np
import pytest

from lpn.core.errors import InputError
from lpn.core.tables import Table, number_column, text_column

NAMES = ["0003", "0001/02", "0001/01", "0002"]


@pytest.fixture
def table() -> Table:
    columns = [
        text_column("name", NAMES),
        number_column("rank", [2, 1, np.nan, 2]),
        number_column("margin", [-0.125, 0.5, np.nan, 1 / 3]),
        text_column("District", ["Dock 3", "Old and new", "", "dock 3"]),
        text_column("note", ["=1+1", "-x", "@a", 'a "b", c\nd']),
    ]
    return Table([f"q/{name}.jpg" for name in NAMES], columns)


def test_sorting_is_stable_and_puts_the_unknown_last(table: Table) -> None:
    rows = table.rows()
    assert table.sort(rows, "rank").tolist() == [1, 0, 3, 2]
    assert table.sort(rows, "RANK", descending=True).tolist() == [0, 3, 1, 2]
    assert table.sort(rows[::-1], "rank").tolist() == [1, 3, 0, 2]
    assert table.sort(rows, "name").tolist() == [2, 1, 3, 0]
    assert table.sort(rows, "district").tolist() == [0, 3, 1, 2]
    assert table.sort(rows, "district", descending=True).tolist() == [1, 0, 3, 2]
    assert table.sort(rows[:0], "name").tolist() == []


@pytest.mark.parametrize(
    ("where", "expected"),
    [
        ("", [0, 1, 2, 3]),
        ("rank > 1", [0, 3]),
        ("rank>=1 and margin<=.5", [0, 1, 3]),
        ("rank != 2", [1]),
        ("rank = none", [2]),
        ("rank != none", [0, 1, 3]),
        ("margin < -1e-1", [0]),
        ("district = dock 3", [0, 3]),
        ('District = "old and new" AND rank=1', [1]),
        ("district != dock 3", [1, 2]),
        ("margin = −0.125", [0]),
        ("district = none", [2]),
        ("name ~ 0001", [1, 2]),
        ("name !~ 0001 and district ~ DOCK", [0, 3]),
        ('note = "=1+1"', [0]),
        ("name ~ 0001 and rank > 1", []),
        (" \trank\n>\n1  AND\tname!=0003 ", [3]),
        ('name !~ "x and rank > 9" and rank>1', [0, 3]),
        ('note ~ " and " and rank = 1', []),
    ],
)
def test_filters_choose_rows(table: Table, where: str, expected: list[int]) -> None:
    assert table.filter(table.rows(), where).tolist() == expected
    assert table.filter(table.rows()[::-1], where).tolist() == expected[::-1]


@pytest.mark.parametrize(
    ("where", "said"),
    [
        ("rank", "cannot be read"),
        ("> 1", "cannot be read"),
        ("rank > 1 and", 'nothing before or after an "and"'),
        ("rank > 1 and and rank > 2", "no column 'and rank'"),
        ("rank >", "nothing to compare"),
        ("rank > 1 > 0", "cannot be read"),
        ("hue = 1", "no column 'hue'; the columns are name, rank, margin, District, note"),
        ("rank ~ 1", "rank holds numbers"),
        ("rank > high", "rank holds numbers"),
        ("rank = nan", "rank holds numbers"),
        ("name > 1", "name holds texts"),
        ('name = "a', "cannot be read"),
        ('name = "a" b', "cannot be read"),
        ('name = "a"and rank = 1', "cannot be read"),
        ('name = "a" and "b"', "cannot be read"),
        ('"name" = a', "cannot be read"),
        ("rank =! 2", "cannot be read"),
        (" and rank = 2", 'nothing before or after an "and"'),
        ('"', "cannot be read"),
        ("rank = \ud800", "= ? does not fit"),
        ("x" * 1001, "1000 at most"),
    ],
)
def test_a_filter_with_a_mistake_is_one_sentence(table: Table, where: str, said: str) -> None:
    with pytest.raises(InputError) as error:
        table.filter(table.rows(), where)
    assert said in str(error.value)
    assert "\n" not in str(error.value)
    str(error.value).encode()


def test_no_filter_of_the_longest_takes_long(table: Table) -> None:
    pieces = (" ", "a", "=", "<", "!", '"', '" "', "and", " and ", "\t", 'and"', "a ", "= ", '="')
    texts = [one * 1000 for one in pieces]
    for first in pieces:
        for second in pieces:
            texts += [(first + second) * 500, first * 330 + "a" + second * 330 + "=" + first * 330 + "<"]
            joined = first * 330 + "and" + second * 330 + '"'
            texts += [joined, "a=" + joined + " " * 330]
    texts.append(" " * 330 + "a" + " " * 330 + "=" + " " * 330 + "<")
    for text in texts:
        start = time.process_time()
        with contextlib.suppress(InputError):
            table.filter(table.rows(), text[:1000])
        assert time.process_time() - start < 1, text


def test_search(table: Table) -> None:
    rows = table.rows()
    assert table.search(rows, " 0001/ ").tolist() == [1, 2]
    assert table.search(rows[::-1], "").tolist() == [3, 2, 1, 0]


def test_exported_rows_are_read_back_and_run_no_formula(table: Table) -> None:
    text = table.to_csv(np.array([3, 0, 2])).decode()
    read = list(csv.DictReader(io.StringIO(text, newline="")))
    assert [row["path"] for row in read] == ["q/0002.jpg", "q/0003.jpg", "q/0001/01.jpg"]
    assert float(read[0]["margin"]) == pytest.approx(1 / 3, abs=1e-9)
    assert [row["margin"] for row in read[1:]] == ["-0.125", ""]
    assert [row["note"] for row in read] == ['a "b", c\nd', "'=1+1", "'@a"]
    assert table.to_csv(table.rows()[:0]).decode() == "path,name,rank,margin,District,note\n"


def test_columns_must_fit(table: Table) -> None:
    assert table.with_columns([number_column("rank", [4, 4, 4, 4])]).column("rank").values.tolist() == [4, 4, 4, 4]
    assert [table.column("margin").text(i) for i in range(4)] == ["−0.125", "0.5", "", "0.3333"]
    with pytest.raises(InputError, match="4 rows each"):
        table.with_columns([number_column("x", [1])])
