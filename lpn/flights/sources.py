"""A flight from its files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from lpn.core.errors import DataError, PictureError
from lpn.core.files import printable
from lpn.flights.base import Flight
from lpn.flights.photos import Photo, read_photo, set_times
from lpn.flights.quality import flight_notes, with_courses

_NAMED = 5


def flight_of_photos(files: Sequence[Path], name: str) -> Flight:
    """Return the flight of photos; those that cannot be read are left out, and a note names them.

    Raises:
        DataError: if no photo can be read.
    """
    photos, broken = [], []
    for file in files:
        try:
            photos.append(read_photo(file))
        except PictureError as error:
            broken.append(str(error))
    if not photos:
        raise DataError(
            f"None of {len(files)} photos can be read; the first: {broken[0] if broken else 'there is none.'}"
        )
    named = _with_names(photos)
    frames, is_utc, notes = set_times(named)
    frames, course_notes = with_courses(frames)
    notes += flight_notes(frames, [photo.oddities for photo in named]) + course_notes
    if broken:
        more = f" {len(broken) - _NAMED} more are left out, too." if len(broken) > _NAMED else ""
        notes.append(f"{len(broken)} of {len(files)} photos are left out: {' '.join(broken[:_NAMED])}{more}")
    return Flight(name, tuple(frames), tuple(notes), is_utc)


def _with_names(photos: Sequence[Photo]) -> list[Photo]:
    """Make names unique: those that several photos have get their folders below the common one."""
    counts = Counter(photo.frame.name for photo in photos)
    if len(counts) == len(photos):
        return list(photos)
    files = [photo.frame.file.resolve() for photo in photos]
    common = os.path.commonpath([file.parent for file in files])
    names = [file.relative_to(common).as_posix() for file in files]
    if len(set(names)) < len(names):
        twice = next(name for name, count in Counter(names).items() if count > 1)
        raise DataError(f"{printable(twice)} is given twice; give each photo once.")
    return [replace(photo, frame=replace(photo.frame, name=name)) for photo, name in zip(photos, names, strict=True)]
