"""Answers that ship with a flight over its map, as in the demo: descriptors and registrations of one model.

    located.json   model, files of map and flight, and the answers of sequence and registration for each frame
    windows/       store of the map's windows
    frames/        store of the flight's frames at the tried headings

They are used only for the same model, map, and photos. Descriptors also need the same windows and headings. Answers that do not
fit are computed again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import StoreError
from lpn.descriptors.store import Row, open_store
from lpn.flight.files import Flight
from lpn.flight.locate.located import StageRecord
from lpn.flight.locate.registered_stage import FORMAT as REGISTERED
from lpn.flight.locate.retrieval import FrameViews
from lpn.flight.maps import Map, Window
from lpn.models.base import Model

NAME, WINDOWS, FRAMES = "located.json", "windows", "frames"
FORMAT = "lpn-located/1"
# Tolerance of metres, degrees, and shares between processors.
_TOLERANCE = 2e-3

# A file's name and size.
Files = list[tuple[str, int]]


class ShippedRecord(msgspec.Struct, frozen=True):
    """The contents of located.json.

    Attributes:
        registered_by: the format of the registration that made the answers.
        fingerprint: of the model.
        map, photos: their files.
        registration, sequence: answers by the frame's name; registrations exclude the map's own error.
    """

    format: str
    registered_by: str
    fingerprint: str
    map: Files
    photos: Files
    registration: dict[str, StageRecord] = {}
    sequence: dict[str, StageRecord] = {}


@dataclass(frozen=True, eq=False)
class ShippedAnswers:
    """Answers that fit a model, a map, and a flight.

    Attributes:
        folder: of the stores.
        record: the answers.
    """

    folder: Path
    record: ShippedRecord

    @classmethod
    def open(cls, folder: Path, model: Model, basemap: Map, flight: Flight) -> ShippedAnswers | None:
        """Open the answers in a folder; None without any, or if they are of another model, map, or flight."""
        try:
            record = msgspec.json.decode((folder / NAME).read_bytes(), type=ShippedRecord)
        except (OSError, msgspec.MsgspecError, ValueError):
            return None
        found = (record.format, record.registered_by, record.fingerprint, record.map, record.photos)
        return cls(folder, record) if found == identity(model, basemap, flight) else None

    def windows(self, windows: Sequence[Window], side: int) -> Float32Array | None:
        """Return descriptors (N, n, D) of windows, see `window_rows`; None if shipped ones do not fit, or are damaged."""
        return self._descriptors(WINDOWS, window_rows(windows, side))

    def frames(self, flight: Flight, views: Sequence[FrameViews]) -> Float32Array | None:
        """Return descriptors (N, n, D) of frames, see `frame_rows`; None if shipped ones do not fit, or are damaged."""
        return self._descriptors(FRAMES, frame_rows(flight, views))

    def _descriptors(self, name: str, rows: Sequence[Row]) -> Float32Array | None:
        try:
            store = open_store(self.folder / name)
            store.check()
        except StoreError:
            return None
        fits = store.kind.fingerprint == self.record.fingerprint and _alike(store.rows, rows)
        return np.array(store.float32) if fits else None


def identity(model: Model, basemap: Map, flight: Flight) -> tuple[str, str, str, Files, Files]:
    """Return the identity of answers: formats of file and registration, the model, and the files of map and photos."""
    files = [file for sheet in basemap.sheets for file in sheet.raster.files()]
    photos = [(frame.name, frame.file.stat().st_size) for frame in flight.frames]
    return FORMAT, REGISTERED, model.fingerprint, [(file.name, file.stat().st_size) for file in files], photos


def window_rows(windows: Sequence[Window], side: int) -> list[Row]:
    """Return the rows of windows in shipped answers; `side` is the side of their pictures in pixels."""
    return [_row((window.x, window.y, window.size, window.heading), size=side) for window in windows]


def frame_rows(flight: Flight, views: Sequence[FrameViews]) -> list[Row]:
    """Return the rows of frames at their headings in shipped answers, which identify photos by name and size."""
    return [
        _row((heading, one.share), frame.name, frame.file.stat().st_size)
        for frame, one in zip(flight.frames, views, strict=True)
        for heading in one.headings
    ]


def _row(numbers: Sequence[float], name: str = "", size: int = 0) -> Row:
    """Return the row of a picture that numbers, such as metres and degrees, identify within a file."""
    return Row(" ".join([*(f"{number:.6f}" for number in numbers), name]), size, 0)


def _alike(stored: Sequence[Row], wanted: Sequence[Row]) -> bool:
    """Return whether rows are of the same pictures, up to rounding."""
    words, others = (" ".join(row.file for row in rows).split(" ") for rows in (stored, wanted))
    if [row.size for row in stored] != [row.size for row in wanted] or len(words) != len(others):
        return False
    return all(one == other or _near(one, other) for one, other in zip(words, others, strict=True))


def _near(one: str, other: str) -> bool:
    try:
        return abs(float(one) - float(other)) < _TOLERANCE
    except ValueError:
        return False
