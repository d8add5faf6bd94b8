"""A flight, and each of its pictures with the camera's position and angles."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime
from functools import cached_property
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from lpn.core.arrays import Float64Array, UInt8Array
from lpn.core.numbers import wrap_degrees
from lpn.datasets import geo
from lpn.flight.files.lenses import Lens

HeadingSource = Literal["gimbal", "camera", "aircraft", "course"]
# Limits of the values in a flight's folder.
_Name = Annotated[str, Meta(min_length=1)]
_Pixels = Annotated[int, Meta(gt=0, lt=1_000_000)]
_Number = Annotated[float, Meta(ge=-1e12, le=1e12)]
_Turn = Annotated[float, Meta(ge=-360, le=360)]
_HalfTurn = Annotated[float, Meta(ge=-180, le=180)]


@dataclass(frozen=True)
class Frame:
    """One picture of a flight. Unknown numbers are None.

    Attributes:
        name: unique in its flight.
        file: the picture.
        width, height: its pixels, upright (EXIF orientation applied).
        time: seconds; see `Flight.utc`.
        latitude, longitude: of the camera in WGS 84 degrees.
        height_above_ground: of the camera in metres.
        height_above_takeoff: in metres above the point of take-off; on flat land this is the height above ground.
        altitude: in metres above the sea, or above the ellipsoid if the file's writer counts from it.
        heading: of the picture's top in degrees clockwise from north, 0 <= heading < 360.
        heading_source: "gimbal"; "camera", a direction of the camera in EXIF or XMP; "aircraft", whose camera may look elsewhere;
            or "course", the direction of motion. None without a heading.
        pitch: in degrees; -90 looks straight down, 0 looks at the horizon.
        roll: in degrees about the picture's upward direction; positive with the right side down. It turns a camera that looks
            straight down to the left.
        fov: horizontal field of view in degrees.
        lens: with its distortion, if a file has it and the picture is still distorted.
    """

    name: _Name
    file: Path
    width: _Pixels
    height: _Pixels
    time: _Number | None = None
    latitude: Annotated[float, Meta(ge=-90, le=90)] | None = None
    longitude: _HalfTurn | None = None
    height_above_ground: _Number | None = None
    height_above_takeoff: _Number | None = None
    altitude: _Number | None = None
    heading: Annotated[float, Meta(ge=0, le=360)] | None = None
    heading_source: HeadingSource | None = None
    pitch: _Turn | None = None
    roll: _HalfTurn | None = None
    fov: Annotated[float, Meta(ge=0.1, le=170)] | None = None
    lens: Lens | None = None

    @property
    def flying_height(self) -> float | None:
        """The height above ground in metres, else above take-off; None if both are unknown."""
        return self.height_above_takeoff if self.height_above_ground is None else self.height_above_ground

    def undistorted(self, photo: UInt8Array) -> UInt8Array:
        """Return the frame's photo, (H, W, 3) of any size, without its lens's distortion; unchanged if the lens is unknown.

        Registrations, poses, and corrections use the pixels of this picture.
        """
        return photo if self.lens is None else self.lens.undistorted(photo)


@dataclass(frozen=True)
class Flight:
    """The pictures of one flight in the order of their times.

    Attributes:
        name: of its folder.
        notes: one sentence for each oddity.
        utc: times are seconds since 1970-01-01 in UTC; otherwise, since the first picture.
    """

    name: str
    frames: tuple[Frame, ...]
    notes: tuple[str, ...] = ()
    utc: bool = False

    @cached_property
    def degrees(self) -> Float64Array:
        """Latitude and longitude of each frame, (N, 2); NaN where unknown."""
        return degrees(self.frames)

    @cached_property
    def times(self) -> Float64Array:
        """Seconds of each frame, (N,); NaN where unknown."""
        return np.array([frame.time for frame in self.frames], np.float64)

    @cached_property
    def day(self) -> date | None:
        """The day in UTC of all pictures of known time; None if it is unknown, or they are of several days."""
        times = self.times[np.isfinite(self.times)].tolist() if self.utc else []
        days = {datetime.fromtimestamp(time, UTC).date() for time in times}
        return days.pop() if len(days) == 1 else None


def degrees(frames: Sequence[Frame]) -> Float64Array:
    """Return latitude and longitude of frames, (N, 2); NaN where unknown."""
    return np.array([(frame.latitude, frame.longitude) for frame in frames], np.float64).reshape(-1, 2)


def on_earth(latitude: float, longitude: float) -> bool:
    """Return whether degrees are a position on the Earth."""
    return abs(latitude) <= 90 and abs(longitude) <= 180


def local_metres(places: Float64Array) -> Float64Array:
    """Return metres east and north of the first known latitude and longitude, (N, 2); NaN where unknown.

    Accurate to 1 % within 50 km; see `lpn.datasets.geo.on_plane`.
    """
    known = places[~np.isnan(places[:, 0])]
    if not len(known):
        return np.full_like(places, np.nan)
    north, east = geo.metres_per_degree(float(np.clip(known[:, 0].mean(), -89.0, 89.0)))
    offsets = places - known[0]
    return np.stack([wrap_degrees(offsets[:, 1]) * east, offsets[:, 0] * north], axis=1)
