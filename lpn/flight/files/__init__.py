"""Flights: pictures with the camera's position, height, heading, and field of view, as far as their files have them.

    make_flight(files, "flights/monday")    # photos, or videos with subtitles; logs
    open_flight("flights/monday")           # that folder, or a folder of photos
    footprint(frame), ground_width(frame)

It imports `core` and `datasets`. `training`, `locate`, and `cli` import it. docs/flights.md shows what is read.
"""

from __future__ import annotations

from pathlib import Path

from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.flight.files.base import Flight, Frame, HeadingSource
from lpn.flight.files.cameras import footprint, ground_width
from lpn.flight.files.folder import is_flight, read_flight, write_flight
from lpn.flight.files.sources import FlightOptions, make_flight, photos_of

__all__ = [
    "Flight",
    "FlightOptions",
    "Frame",
    "HeadingSource",
    "footprint",
    "ground_width",
    "make_flight",
    "open_flight",
    "photos_of",
    "write_flight",
]


def open_flight(folder: str | Path) -> Flight:
    """Open a flight: a folder that `lpn flight` wrote, or a folder of photos.

    Raises:
        DataError: if there is no such folder, it has no photo that can be read, or its files are damaged.
    """
    folder = Path(folder)
    if folder.is_file():
        raise DataError(
            f"{printable(str(folder))} is a file; expected a folder that lpn flight wrote, or one of photos, so make one with "
            f"lpn flight {printable(str(folder))} --out FLIGHT, and give FLIGHT."
        )
    if not folder.is_dir():
        raise DataError(f"There is no flight at {folder}; expected a folder that lpn flight wrote, or one of photos.")
    if is_flight(folder):
        return read_flight(folder)
    return photos_of([folder], folder.resolve().name)
