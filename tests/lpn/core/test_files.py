from __future__ import annotations

import errno
import os
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import msgspec
import pytest

from lpn.core.errors import OutputError
from lpn.core.files import (
    check_writable,
    distinct_names,
    fingerprint,
    first_few,
    printable,
    write_atomic,
    write_json,
    write_together,
)


def test_a_file_is_whole_however_many_write_it(tmp_path: Path) -> None:
    contents = [bytes([65 + i]) * 200_000 for i in range(8)]
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda data: write_atomic(tmp_path / "deep" / "file", data), contents * 20))
    assert (tmp_path / "deep" / "file").read_bytes() in contents
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["file"]


def test_what_cannot_be_written_is_said_and_nothing_is_left(tmp_path: Path) -> None:
    (tmp_path / "folder").mkdir()
    (tmp_path / "file").write_bytes(b"kept")
    for path in (tmp_path / "folder", tmp_path / "file" / "below"):
        for attempt in (check_writable, lambda p: write_atomic(p, b"new")):
            with pytest.raises(OutputError, match=f"{path.name} cannot be written"):
                attempt(path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "folder"]
    assert (tmp_path / "file").read_bytes() == b"kept"


@pytest.mark.parametrize(
    ("number", "remedy"), [(errno.ENOSPC, "free space or choose another place"), (errno.EROFS, "choose another place")]
)
def test_only_a_full_disk_is_told_to_be_freed(
    number: int, remedy: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refused(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr(Path, "write_bytes", refused)
    with pytest.raises(OutputError) as error:
        write_atomic(tmp_path / "file", b"new")
    assert str(error.value) == f"{tmp_path / 'file'} cannot be written ({os.strerror(number)}); {remedy}."


def test_a_fingerprint_is_of_contents_alone(tmp_path: Path) -> None:
    for name, data in (("a", b"one"), ("b", b"one"), ("c", b"two")):
        (tmp_path / name).write_bytes(data)
    a, b, c = (tmp_path / name for name in "abc")
    assert fingerprint(a) == fingerprint(b) != fingerprint(c)
    assert fingerprint(a, c) != fingerprint(c, a)
    assert fingerprint(a) != fingerprint(a, also="other options")


def test_what_killed_processes_left_is_deleted_and_what_others_write_is_not(tmp_path: Path) -> None:
    old, fresh, other, own = names = ("file.7-1.part", "file.7-2.part", "another.7-1.part", "file.1-1.part.txt")
    for name in names:
        (tmp_path / name).write_bytes(b"half")
    for name in (old, other, own):
        os.utime(tmp_path / name, (1, 1))
    write_atomic(tmp_path / "file", b"whole")
    assert {p.name for p in tmp_path.iterdir()} == {"file", fresh, other, own}


def test_names_have_the_folders_that_tell_files_apart() -> None:
    assert distinct_names([Path("runs/a/net.pth"), Path("runs/b/other.pth")]) == ["net.pth", "other.pth"]
    assert distinct_names([Path("runs/a/net.pth"), Path("runs/b/net.pth")]) == ["a/net.pth", "b/net.pth"]
    assert distinct_names([Path("1/a/net.pth"), Path("2/a/net\n.pth"), Path("3/a/net.pth")])[1] == "2/a/net?.pth"


def test_json_ends_with_a_line_feed(tmp_path: Path) -> None:
    write_json(tmp_path / "a.json", {"name": "Zürich"})
    assert (tmp_path / "a.json").read_bytes() == b'{\n "name": "Z\\u00fcrich"\n}\n'
    write_json(tmp_path / "a.json", ["Zürich"], ensure_ascii=False)
    assert (tmp_path / "a.json").read_text("utf-8") == '[\n "Zürich"\n]\n'


def test_the_first_few_are_named_and_the_others_counted() -> None:
    assert first_few(["a", "b"], 2) == "a, b"
    assert first_few(["a", "b", "c", "d"], 2) == "a, b, and 2 more"
    assert first_few([], 2) == ""


def test_json_is_read_by_any_reader(tmp_path: Path) -> None:
    value = {"caf\udce9": [float("nan"), (float("-inf"), 1.5)], "fine": {"a": None, "b": True, 3: "\u2028"}}
    write_json(tmp_path / "a.json", value)
    expected = {"caf?": [None, [None, 1.5]], "fine": {"a": None, "b": True, "3": "\u2028"}}
    assert msgspec.json.decode((tmp_path / "a.json").read_bytes()) == expected


@pytest.mark.parametrize(
    ("name", "shown"),
    [
        # A no-break space as macOS writes it, an ideographic space, a Persian word with a non-joiner, an emoji of three.
        ("Bildschirm 10.15\u202fPM.png", "Bildschirm 10.15\u202fPM.png"),
        ("\u753b\u50cf\u30001.jpg", "\u753b\u50cf\u30001.jpg"),
        ("\u0645\u06cc\u200c\u062e", "\u0645\u06cc\u200c\u062e"),
        ("\U0001f468\u200d\U0001f33e.jpg", "\U0001f468\u200d\U0001f33e.jpg"),
        # Khmer words, a soft hyphen, a letter for private use, one that Unicode may still assign, Scotland's flag.
        *[
            (text, text)
            for text in ("\u1781\u200b\u1798", "a\xadb", "\ue000", "\U000e0fff", "\U0001f3f4\U000e0067\U000e007f")
        ],
        ("a\u202egpj.exe", "a?gpj.exe"),
        ("\u061c\u200e\u200f\u202a\u202b\u202c\u202d\u2066\u2067\u2068\u2069\ufffe\uffff", "?" * 13),
        ("a\nb\x1b[31m\u2028\u2029\x85", "a?b?[31m???"),
        ("caf\udce9", "caf?"),
    ],
)
def test_names_are_shown_as_they_are_where_that_is_safe(name: str, shown: str) -> None:
    assert printable(name) == shown


def test_files_that_belong_together_are_replaced_together(tmp_path: Path) -> None:
    first, second = tmp_path / "a", tmp_path / "b"
    write_together({first: b"1", second: b"1"})
    with pytest.raises(OutputError, match="c cannot be written"):
        write_together({first: b"2", second: b"2", tmp_path / "a" / "c": b"2"})
    assert {file: file.read_bytes() for file in tmp_path.iterdir()} == {first: b"1", second: b"1"}
