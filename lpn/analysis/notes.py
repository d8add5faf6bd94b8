"""A person's tags and notes on queries, in `notes.csv` in the data set's folder or in another file.

    path,tags,note
    test/query_drone/0005/image-01.jpeg,night blur,"Looks like the twin next door."

`path` is the query's picture, relative to the data set's folder; spaces separate tags. The file may be edited by hand, and by
several programs at once, since each change replaces one line under a lock.
"""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lpn.core.errors import DataError, InputError, OutputError
from lpn.core.files import check_writable, exclusive_lock, printable, write_atomic
from lpn.core.shutdown import uninterrupted
from lpn.core.tables import Column, text_column
from lpn.datasets.metadata import NOTE, TAGS

NAME = "notes.csv"
LONGEST_TAG, MOST_TAGS, LONGEST_NOTE = 30, 20, 2000

_HEADER = ["path", TAGS, NOTE]
_TAG = re.compile(rf"\w[\w-]{{0,{LONGEST_TAG - 1}}}")
_SEPARATORS = re.compile(r"[\s,;]+")
_MAX_BYTES = 50_000_000


@dataclass(frozen=True)
class Note:
    """The annotation of one query.

    Attributes:
        tags: short words, each once, in the order given.
        text: may have several lines.
    """

    tags: tuple[str, ...] = ()
    text: str = ""


def read_notes(file: Path) -> dict[str, Note]:
    """Read all notes, by the query's path; empty if the file does not exist.

    Raises:
        DataError: when the file is not in the format above; the message names the line.
    """
    try:
        if not file.exists():
            return {}
        if file.stat().st_size > _MAX_BYTES:
            raise DataError(
                f"{file} has more than {_MAX_BYTES // 1_000_000} MB; which is too large for notes; move it away."
            )
        text = file.read_text(encoding="utf-8-sig")
        return _parse(csv.reader(io.StringIO(text, newline=""), strict=True), file)
    except OSError as error:
        raise DataError(f"{file} cannot be read ({error.strerror or error}); check that it is readable.") from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise DataError(f"{file} is not a CSV file in UTF-8; correct it, or move it away.") from error


def set_note(file: Path, path: str, tags: str | Iterable[str], text: str) -> dict[str, Note]:
    """Replace one query's annotation on disk and keep all others; an empty annotation removes its line.

    Args:
        file: the notes, usually `notes.csv` in the data set's folder.
        path: the query's picture, relative to the data set's folder.
        tags: words, or one text of words separated by spaces or commas.
        text: the note.

    Returns:
        All notes after the change.

    Raises:
        InputError: when a tag is not a short word, there are too many tags, or the note is too long.
        DataError: when the existing file is damaged; it is not changed.
        OutputError: when the file cannot be written.
    """
    note = Note(parse_tags(tags), _clean(text))
    if not path or not path.isprintable():
        raise InputError(
            f"The query's path is {printable(path)!r}; expected the path of the picture relative to the data set's "
            "folder, in printable UTF-8, so rename the file."
        )
    if len(note.text) > LONGEST_NOTE:
        raise InputError(f"The note has {len(note.text)} letters; expected {LONGEST_NOTE} at most.")
    check_writable(file)
    try:
        with exclusive_lock(file.parent, wait=True), uninterrupted():
            notes = read_notes(file)
            notes.pop(path, None)
            if note != Note():
                notes[path] = note
            write_atomic(file, _to_csv(notes))
    except OSError as error:
        raise OutputError(
            f"{file} cannot be written ({error.strerror or error}); choose another place for notes."
        ) from error
    return notes


def parse_tags(tags: str | Iterable[str]) -> tuple[str, ...]:
    """Return tags as words, without duplicates.

    Raises:
        InputError: when a tag has characters other than letters, digits, "-", and "_", or is too long, or there are too many
            tags.
    """
    words = _SEPARATORS.split(tags) if isinstance(tags, str) else tags
    unique = tuple(dict.fromkeys(word for word in words if word))
    for word in unique:
        if not _TAG.fullmatch(word):
            raise InputError(
                f"The tag {printable(word)[:60]!r} is not a word of at most {LONGEST_TAG} letters, digits, - and _; rename it."
            )
    if len(unique) > MOST_TAGS:
        raise InputError(f"There are {len(unique)} tags; expected {MOST_TAGS} at most.")
    return unique


def columns(notes: Mapping[str, Note], paths: Sequence[str]) -> list[Column]:
    """Return the columns `tags` and `note` for a table with these rows."""
    rows = [notes.get(path, Note()) for path in paths]
    return [text_column(TAGS, [" ".join(note.tags) for note in rows]), text_column(NOTE, [note.text for note in rows])]


def _parse(lines: Iterable[list[str]], file: Path) -> dict[str, Note]:
    notes: dict[str, Note] = {}
    header: list[str] | None = None
    for number, values in enumerate((values for values in lines if values), 1):
        if header is None:
            header = [value.strip().lower() for value in values]
            if header != _HEADER:
                raise DataError(
                    f"The first line of {file} is {printable(','.join(values))[:100]}; expected {','.join(_HEADER)}, so correct "
                    "it, or move the file away."
                )
            continue
        path = values[0].strip().removeprefix("./")
        if len(values) != len(_HEADER) or not path or path in notes:
            problem = "has no path" if not path else f"is a duplicate for {printable(path)}"
            problem = f"has {len(values)} values" if len(values) != len(_HEADER) else problem
            raise DataError(
                f"Entry {number - 1} of {file} {problem}; expected one line per query, with {','.join(_HEADER)}."
            )
        try:
            notes[path] = Note(parse_tags(values[1]), _clean(values[2]))
        except InputError as error:
            raise DataError(f"Entry {number - 1} of {file} cannot be used: {error}") from error
    return notes


def _to_csv(notes: dict[str, Note]) -> bytes:
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(_HEADER)
    writer.writerows([path, " ".join(note.tags), note.text] for path, note in sorted(notes.items()))
    return text.getvalue().encode("utf-8", "replace")


def _clean(text: str) -> str:
    """Remove control characters other than line breaks and tabs, which CSV cannot represent."""
    lines = text.replace("\r\n", "\n").replace("\r", "\n")
    return "".join(c for c in lines if c.isprintable() or c in "\n\t").strip()
