"""A user's tags and notes on queries: `notes.csv` in the data set's folder, for the demo in the user's folder, or another file.

    path,tags,note
    test/query_drone/0005/image-01.jpeg,night blur,"Looks like the twin next door."

`path` is the query's picture, relative to the data set's folder; spaces separate tags. Users and several programs may edit
the file at once, because each change replaces one line under a lock. An apostrophe precedes a text that a spreadsheet would
compute, such as '- dark; it is no part of the note, see `lpn.core.csv_cells`.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from lpn.core.csv_cells import csv_bytes, unescape
from lpn.core.errors import DataError, InputError
from lpn.core.files import TYPED, printable
from lpn.core.lists import decoded, separated
from lpn.core.own_files import OwnFileFormat
from lpn.core.tables import Column, text_column
from lpn.datasets.listed_paths import plain_path
from lpn.datasets.metadata import NOTE, TAGS

NAME = "notes.csv"
LONGEST_TAG, MOST_TAGS, LONGEST_NOTE = 30, 20, 2000

_HEADER = ["path", TAGS, NOTE]
_TAG = re.compile(rf"\w[\w-]{{0,{LONGEST_TAG - 1}}}")
_SEPARATORS = re.compile(r"[\s,;]+")
_LINE_BREAK = re.compile("\r\n|[\r\v\f\x85\u2028\u2029]")


@dataclass(frozen=True)
class Note:
    """The annotation of one query.

    Attributes:
        tags: short words, each once, in the user's order.
        text: may have several lines.
    """

    tags: tuple[str, ...] = ()
    text: str = ""


def read_notes(file: Path) -> dict[str, Note]:
    """Read all notes, by the query's path; empty if the file does not exist.

    Raises:
        DataError: when the file is not in the format above; the message names the line.
    """
    return _FORMAT.read(file)


class ChangedNoteError(InputError):
    """A note that somebody else has changed since it was read.

    Attributes:
        stored: the current note.
    """

    def __init__(self, stored: Note) -> None:
        self.stored = stored
        words = " ".join((*stored.tags, stored.text)).strip()
        now = f"it is now {printable(' '.join(words.split()))[:200]!r}" if words else "it is now empty"
        super().__init__(f"Somebody else has changed this note meanwhile: {now}; save again to replace it.")


def set_note(
    file: Path, path: str, tags: str | Iterable[str], text: str, before: Note | None = None
) -> dict[str, Note]:
    """Replace one query's annotation on disk and keep all others; an empty annotation removes its line.

    Args:
        file: the notes, usually `notes.csv` in the data set's folder.
        path: the query's picture, relative to the data set's folder.
        tags: words, or one text of words separated by spaces or commas.
        text: the note.
        before: the annotation to replace; None replaces any.

    Returns:
        All notes after the change.

    Raises:
        ChangedNoteError: when the stored annotation differs from `before`; it is not changed.
        InputError: when a tag is not a short word, there are too many tags, or the note is too long.
        DataError: when the existing file is damaged; it is not changed.
        OutputError: when the file cannot be written.
    """
    note = Note(parse_tags(tags), typed(text))
    _check_path(path)
    if len(note.text) > LONGEST_NOTE:
        raise InputError(f"The note has {len(note.text)} letters; expected {LONGEST_NOTE} at most.")

    def change(notes: dict[str, Note]) -> dict[str, Note]:
        stored = notes.pop(plain_path(path), Note())
        if before is not None and stored not in (Note(before.tags, typed(before.text)), note):
            raise ChangedNoteError(stored)
        return notes if note == Note() else notes | {plain_path(path): note}

    return _FORMAT.change(file, change)


def add_tags(file: Path, paths: Sequence[str], tags: str | Iterable[str]) -> dict[str, Note]:
    """Add tags to the annotations of several queries on disk, in one change; notes and other tags stay.

    Returns:
        All notes after the change.

    Raises:
        LPNError: as `set_note`, and InputError without a tag; then nothing has changed.
    """
    added = parse_tags(tags)
    if not added:
        raise InputError("There is no tag; write a word, such as night.")
    for path in paths:
        _check_path(path)

    def change(notes: dict[str, Note]) -> dict[str, Note]:
        for path in map(plain_path, paths):
            before = notes.get(path, Note())
            notes[path] = Note(parse_tags((*before.tags, *added)), before.text)
        return notes

    return _FORMAT.change(file, change)


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


def _check_path(path: str) -> None:
    if not path or printable(path) != path:
        raise InputError(
            f"The query's path is {printable(path)!r}; expected the path of the picture relative to the data set's "
            "folder, in printable UTF-8, so rename the file."
        )


def columns(notes: Mapping[str, Note], paths: Sequence[str]) -> list[Column]:
    """Return the columns `tags` and `note` for a table with these rows."""
    rows = [notes.get(plain_path(path), Note()) for path in paths]
    return [text_column(TAGS, [" ".join(note.tags) for note in rows]), text_column(NOTE, [note.text for note in rows])]


def _decode(content: bytes, file: Path) -> dict[str, Note]:
    try:
        rows = separated(decoded(content, str(file)), str(file), strict=True).rows
        lines = [[unescape(value) for value in values] for _, values in rows]
    except DataError as error:
        raise DataError(f"{file} is not a CSV file in UTF-8; correct it, or move it away.") from error
    notes: dict[str, Note] = {}
    header: list[str] | None = None
    for number, values in enumerate(lines, 1):
        if header is None:
            header = [value.strip().lower() for value in values]
            if header != _HEADER:
                raise DataError(
                    f"The first line of {file} is {printable(','.join(values))[:100]}; expected {','.join(_HEADER)}, so correct "
                    "it, or move the file away."
                )
            continue
        path = plain_path(values[0])
        if len(values) != len(_HEADER) or not path or path in notes:
            problem = "has no path" if not path else f"is a duplicate for {printable(path)}"
            problem = f"has the wrong number of values, {len(values)}" if len(values) != len(_HEADER) else problem
            raise DataError(
                f"Entry {number - 1} of {file} {problem}; expected one line per query, with {','.join(_HEADER)}."
            )
        try:
            notes[path] = Note(parse_tags(values[1]), typed(values[2]))
        except InputError as error:
            raise DataError(f"Entry {number - 1} of {file} cannot be used: {error}") from error
    return notes


def _encode(notes: dict[str, Note]) -> bytes:
    rows = ([path, " ".join(note.tags), note.text] for path, note in sorted(notes.items()))
    return csv_bytes([_HEADER, *rows], own=True)


def typed(text: str) -> str:
    """Normalise a user's text: line feeds as line breaks, no characters that are not `printable`, and no surrounding space."""
    return printable(_LINE_BREAK.sub("\n", text), TYPED, "").strip()


_FORMAT = OwnFileFormat("notes", _decode, _encode, dict, "shorten other notes first")
