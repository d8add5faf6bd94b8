"""A person's corrected places of frames, in `corrections.csv` beside a flight, whose other files are not changed.

    frame,latitude,longitude,top left,top right,bottom right,bottom left
    DJI_0018.JPG,46.84260512,-91.99455804,46.84281 -91.99501,46.84297 -91.99430,46.84240 -91.99410,46.84224 -91.99481

`latitude` and `longitude` are of the picture's middle on the ground; the other columns have its corners, in WGS 84 degrees. The
file may be edited by hand, and by several programs at once: each change replaces one line under a lock. It is UTF-8, and other
bytes of a file's name are preserved. Text that a spreadsheet would compute is quoted by an apostrophe, such as '-33.4 -70.6; see
`lpn.core.csv_cells`.
"""

from __future__ import annotations

import codecs
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.csv_cells import csv_bytes, unescape
from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.homography import apply_homography, corner_pixels, four_point_homography
from lpn.core.lists import separated
from lpn.core.own_files import OwnFileFormat
from lpn.flight.maps import LocalFrame

NAME = "corrections.csv"
_HEADER = ["frame", "latitude", "longitude", "top left", "top right", "bottom right", "bottom left"]
# Limits of a corrected picture: side in metres, area in square metres, and sine of the angle at a corner.
_MIN_SIDE, _MAX_SIDE, _MIN_AREA, _MIN_SINE = 0.1, 20_000.0, 1.0, 0.01


@dataclass(frozen=True, eq=False)
class Correction:
    """A person's place of a frame's picture.

    Attributes:
        middle: latitude and longitude of the picture's middle on the ground, (2,).
        corners: latitude and longitude of its corners, (4, 2): top left, top right, bottom right, bottom left.
    """

    middle: Float64Array
    corners: Float64Array

    @classmethod
    def of(cls, corners: Float64Array, frame: LocalFrame) -> Correction:
        """Make a correction of corners in metres of a map's frame, (4, 2).

        Raises:
            InputError: if no camera above the ground could take such a picture.
        """
        if not _possible(corners):
            raise InputError(
                "The tie points turn the photo over, fold it, or make it too small or too large; move them back into the order "
                "in which the photo shows them."
            )
        return cls(frame.degrees([ground_middle(corners)])[0], frame.degrees(corners))

    def homography(self, frame: LocalFrame, width: int, height: int) -> Float64Array:
        """Return the matrix from pixels of a picture of this size to metres of a map's frame, (3, 3)."""
        return four_point_homography(corner_pixels(width, height), frame.xy(*self.corners.T))


def ground_middle(corners: Float64Array) -> Float64Array:
    """Return the place of a picture's middle on the ground, (2,), by the places of its corners, (4, 2)."""
    return apply_homography(four_point_homography(corner_pixels(1, 1), corners), (0, 0))


def _possible(corners: Float64Array, slack: float = 1.0) -> bool:
    """Return whether a camera above the ground could see these corners in metres, (4, 2); `slack` >= 1 loosens the limits."""
    after, before = np.roll(corners, -1, axis=0) - corners, corners - np.roll(corners, 1, axis=0)
    turns = before[:, 0] * after[:, 1] - before[:, 1] * after[:, 0]
    sides = np.linalg.norm(after, axis=1)
    if not (_MIN_SIDE / slack <= sides.min() and sides.max() <= _MAX_SIDE * slack):
        return False
    # Seen from above, the corners of a picture run clockwise.
    sines = -turns / (sides * np.roll(sides, 1))
    return bool((sines >= _MIN_SINE / slack).all() and -turns.sum() / 4 >= _MIN_AREA / slack)


def read_corrections(file: Path) -> dict[str, Correction]:
    """Read all corrections, by the frame's name; empty if the file does not exist.

    Raises:
        DataError: if the file is not in the format above; the message names the entry.
    """
    return _FORMAT.read(file)


def set_correction(
    file: Path, name: str, correction: Correction | None, known: Mapping[str, Correction] | None = None
) -> dict[str, Correction]:
    """Replace one frame's correction on disk; None removes its line.

    Args:
        file: usually `corrections.csv` in the flight's folder.
        name: of the frame.
        known: the corrections that the person has seen; None overwrites any.

    Returns:
        All corrections after the change.

    Raises:
        InputError: if the frame's correction differs from the known one; the file is not changed.
        DataError: if the existing file is damaged; it is not changed.
        OutputError: if the file cannot be written.
    """

    def change(corrections: dict[str, Correction]) -> dict[str, Correction]:
        stored, seen = ({name: all_of[name]} if name in all_of else {} for all_of in (corrections, known or {}))
        if known is not None and _encode(stored) != _encode(seen):
            raise InputError("Somebody else has corrected this photo meanwhile; save again to replace that.")
        corrections.pop(name, None)
        return corrections if correction is None else corrections | {name: correction}

    return _FORMAT.change(file, change)


def _decode(content: bytes, file: Path) -> dict[str, Correction]:
    text = content.removeprefix(codecs.BOM_UTF8).decode("utf-8", "surrogateescape")
    rows = separated(text, str(file), strict=True).rows
    if (header := next(rows, (0, []))[1]) != _HEADER:
        first = printable(",".join(header))[:100] or "empty"
        raise DataError(f"The first line of {file} is {first}; expected {','.join(_HEADER)}, so correct it.")
    by_name: dict[str, Correction] = {}
    for number, row in rows:
        name, *cells = map(unescape, row)
        line, photo = f"Line {number} of {file}", printable(name)[:100]
        try:
            places = np.array([cells[:2], *(corner.split() for corner in cells[2:])], np.float64)
        except ValueError:
            places = np.zeros(0)
        if places.shape != (5, 2) or not (np.abs(places) <= (90, 180)).all() or not name:
            raise DataError(
                f"{line} is {printable(','.join(row))[:100]}; expected {','.join(_HEADER)}, each corner as latitude and "
                "longitude with a space between them."
            )
        middle, corners = places[0], places[1:]
        if not _possible(LocalFrame(*corners[0].tolist()).xy(*corners.T), slack=1.25):
            raise DataError(
                f"{line} has corners that turn the photo {photo} over, fold it, or make it too small or too large; correct them, "
                "or remove the line."
            )
        if name in by_name:
            raise DataError(f"{line} is the second line for the photo {photo}; remove one of them.")
        by_name[name] = Correction(middle, corners)
    return by_name


def _encode(corrections: Mapping[str, Correction]) -> bytes:
    rows = [_HEADER]
    for name, one in sorted(corrections.items()):
        latitude, longitude = one.middle.tolist()
        corners = [f"{a:.9f} {b:.9f}" for a, b in one.corners.tolist()]
        rows.append([name, f"{latitude:.9f}", f"{longitude:.9f}", *corners])
    return csv_bytes(rows, own=True)


_FORMAT = OwnFileFormat("corrections", _decode, _encode, dict, "remove some of them")
