from __future__ import annotations

import dataclasses
import multiprocessing
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from lpn.core.errors import DataError, InputError, OutputError
from lpn.tasks import notes
from lpn.tasks.notes import LONGEST_NOTE, MOST_TAGS, Note, add_tags, columns, read_notes, set_note


def test_notes_are_kept_and_read_back(tmp_path: Path) -> None:
    file = tmp_path / "notes.csv"
    assert read_notes(file) == {}
    set_note(file, "b/2.jpg", "night,  blur night", 'Two "lines",\r\nof text\x00\x07 ')
    all_notes = set_note(file, "a/1.jpg", ["twin"], "=1+1")
    expected = {"a/1.jpg": Note(("twin",), "=1+1"), "b/2.jpg": Note(("night", "blur"), 'Two "lines",\nof text')}
    assert all_notes == read_notes(file) == expected
    assert file.read_text().startswith("path,tags,note\na/1.jpg,twin,'=1+1\n")
    tags, texts = columns(all_notes, ["b/2.jpg", "c.jpg"])
    assert (tags.name, tags.values.tolist()) == ("tags", ["night blur", ""])
    assert texts.values.tolist() == ['Two "lines",\nof text', ""]
    assert set_note(file, "b/2.jpg", "", " ") == {"a/1.jpg": Note(("twin",), "=1+1")}
    assert list(tmp_path.iterdir()) == [file]


def test_a_change_leaves_the_letters_of_other_notes(tmp_path: Path) -> None:
    """Also the spaces of French, the joiners of Persian, the marks of Hebrew, and letters that Unicode may still assign."""
    file = tmp_path / notes.NAME
    text = "\U0001fae8 \u1781\u200b\u1798\u17d2\u1798\u17c2 \ue000 so\xadft \U000e0fff a\u00a0! \u06cc\u200c\u062e \u200f(1)"
    file.write_text(f"path,tags,note\na.jpg,,{text}\n", "utf-8")
    assert notes.set_note(file, "b.jpg", "x", "other")["a.jpg"].text == text
    assert text in file.read_text("utf-8")


def test_a_file_edited_by_hand_is_read(tmp_path: Path) -> None:
    file = tmp_path / "notes.csv"
    file.write_bytes('\ufeffPath,Tags,Note\r\n./a.jpg,"x; y",ü\r\n\r\n'.encode())
    assert read_notes(file) == {"a.jpg": Note(("x", "y"), "ü")}


def _write_many(file: Path, name: str) -> None:
    for i in range(15):
        set_note(file, f"{name}/{i}.jpg", name, str(i))


def test_two_processes_and_two_threads_keep_each_others_notes(tmp_path: Path) -> None:
    file = tmp_path / "notes.csv"
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_write_many, args=(file, name)) for name in ("one", "two")]
    for process in processes:
        process.start()
    with ThreadPoolExecutor(2) as pool:
        list(pool.map(lambda name: _write_many(file, name), ("three", "four")))
    for process in processes:
        process.join()
        assert process.exitcode == 0
    assert len(read_notes(file)) == 60


@pytest.mark.parametrize(
    ("data", "said"),
    [
        (b"path,tags\n", "expected path,tags,note"),
        (b"path,tags,note\na.jpg,x\n", "Entry 1 of .* has the wrong number of values, 2;"),
        (b"path,tags,note\na,x,\na,y,\n", "Entry 2 of .* duplicate for a"),
        (b"path,tags,note\n,x,\n", "Entry 1 of .* has no path"),
        (b"path,tags,note\na,(x),\n", "Entry 1 of .* cannot be used"),
        (b"path,tags,note\na,x,\xff\n", "is not a CSV file in UTF-8"),
        (b'path,tags,note\na,x,"open\n', "is not a CSV file in UTF-8"),
    ],
)
def test_a_damaged_file_is_one_sentence_and_stays(tmp_path: Path, data: bytes, said: str) -> None:
    file = tmp_path / "notes.csv"
    file.write_bytes(data)
    with pytest.raises(DataError, match=said):
        set_note(file, "b.jpg", "x", "")
    assert file.read_bytes() == data


@pytest.mark.parametrize(
    ("path", "tags", "text", "said"),
    [
        ("a.jpg", "=cmd", "", "'=cmd' is not a word"),
        ("a.jpg", "x" * 31, "", "at most 30"),
        ("a.jpg", " ".join(f"t{i}" for i in range(21)), "", "21 tags"),
        ("a.jpg", ["two words"], "", "'two words' is not a word"),
        ("a.jpg", "", "x" * (LONGEST_NOTE + 1), "2001 letters"),
        ("", "", "x", "path is ''"),
        ("a\nb", "", "x", "path is 'a.b'"),
        ("caf\udce9.webp", "", "x", r"path is 'caf\?\.webp'.* so rename the file"),
    ],
)
def test_what_is_no_note_is_refused(tmp_path: Path, path: str, tags: str, text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        set_note(tmp_path / "notes.csv", path, tags, text)
    assert list(tmp_path.iterdir()) == []


def test_no_file_is_saved_that_could_not_be_read_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "notes.csv"
    kept = set_note(file, "a.jpg", "x", "")
    small = dataclasses.replace(notes._FORMAT, max_bytes=file.stat().st_size + 50)
    monkeypatch.setattr(notes, "_FORMAT", small)
    with pytest.raises(InputError, match="shorten other notes first"):
        set_note(file, "b.jpg", "", "y" * 60)
    assert read_notes(file) == kept


def test_a_place_that_is_no_file_is_one_sentence(tmp_path: Path) -> None:
    (tmp_path / "notes.csv").mkdir()
    with pytest.raises(OutputError, match="cannot be written"):
        set_note(tmp_path / "notes.csv", "a.jpg", "x", "")
    with pytest.raises(DataError, match="cannot be read"):
        read_notes(tmp_path / "notes.csv")


def test_tags_are_added_to_several_queries_in_one_change_or_to_none(tmp_path: Path) -> None:
    file = tmp_path / "notes.csv"
    set_note(file, "a.jpg", "night", "kept")
    expected = {"a.jpg": Note(("night", "twin", "roof"), "kept"), "b.jpg": Note(("twin", "roof"))}
    assert add_tags(file, ["b.jpg", "a.jpg"], "twin, roof") == expected
    assert add_tags(file, ["a.jpg"], "twin") == read_notes(file) == expected
    many = " ".join(f"t{i}" for i in range(MOST_TAGS))
    for tags, message in (("", "There is no tag"), ("no/word", "no/word"), (many, "expected 20 at most")):
        with pytest.raises(InputError, match=message):
            add_tags(file, ["new.jpg", "a.jpg"], tags)
    with pytest.raises(InputError, match="rename the file"):
        add_tags(file, ["a\n.jpg"], "x")
    assert read_notes(file) == expected
