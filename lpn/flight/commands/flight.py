"""The command flight."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from lpn.flight.files import Flight, Frame


@dataclass
class FlightCommand:
    """Read the photos or videos of a flight with their positions, heights, and headings into a folder."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Photos with EXIF and XMP, or videos with .SRT files or subtitles inside; .csv logs; .gpx tracks; logs of autopilots, .ulg,
    .tlog, or .bin (extra live); folders of photos or videos."""
    out: Path
    """Folder to write: flight.csv, flight.json, and the frames of videos in frames. Photos stay where they are."""
    every: float = 1.0
    """Seconds from one frame of a video to the next; the sharpest of the first second from there on is taken."""
    every_metres: float | None = None
    """Metres flown from one frame of a video to the next, in place of --every."""
    gps_order: Literal["lat-lon", "lon-lat"] | None = None
    """Order of the first two values of GPS(a, b, c) in subtitles; by default told by the dialect, and a note tells of a guess."""
    fov: float | None = None
    """Horizontal field of view in degrees, for photos whose files have none."""
    pitch: float | None = None
    """Pitch in degrees, for photos whose files have none; -90 is straight down."""
    camera: Path | None = None
    """File of the camera's lens, YAML or JSON of OpenCV, ROS, or ODM, whose distortion is taken out before photos are
    matched; by default the one in DJI's photos."""
    clock_offset: float | None = None
    """Seconds to add to the photos' clock for that of a log; by default found out where it is a time zone."""

    def run(self) -> None:
        from lpn.core.errors import InputError
        from lpn.flight.files import FlightOptions, make_flight

        if not self.files:
            raise InputError("There are no files; give photos, videos, logs, tracks, or folders of them.")
        options = FlightOptions(
            self.every, self.every_metres, self.gps_order, self.fov, self.pitch, self.camera, self.clock_offset
        )
        flight = make_flight(self.files, self.out, options)
        print(summary(flight))
        print(f"The flight is in {self.out}.")


def summary(flight: Flight) -> str:
    """Return a short table of a flight's known values, and its notes."""
    from lpn.flight.files import ground_width

    frames = flight.frames
    rows = [
        ("GPS tag", _known(frames, lambda frame: frame.latitude), ""),
        ("height above ground", *_range(frames, lambda frame: frame.height_above_ground, " m")),
        ("height above take-off", *_range(frames, lambda frame: frame.height_above_takeoff, " m")),
        ("altitude", *_range(frames, lambda frame: frame.altitude, " m")),
        ("heading", _known(frames, lambda frame: frame.heading), _sources(frames)),
        ("pitch", *_range(frames, lambda frame: frame.pitch, "°")),
        ("field of view", *_range(frames, lambda frame: frame.fov, "°")),
        ("width on the ground", *_range(frames, ground_width, " m")),
        ("time", _known(frames, lambda frame: frame.time), _span(flight)),
    ]
    if lenses := _known(frames, lambda frame: None if frame.lens is None else frame.lens.fov):
        rows.insert(-2, ("lens", lenses, "its distortion is taken out before photos are matched"))
    lines = [f"{flight.name}: {len(frames)} photos"]
    lines += [f"  {name:22}{known:>6} of {len(frames)}  {values}".rstrip() for name, known, values in rows]
    return "\n".join([*lines, *(f"- {note}" for note in flight.notes)])


def _known(frames: tuple[Frame, ...], value: Callable[[Frame], float | None]) -> int:
    return sum(value(frame) is not None for frame in frames)


def _range(frames: tuple[Frame, ...], value: Callable[[Frame], float | None], unit: str) -> tuple[int, str]:
    """Return the number of known values, and their least, median, and largest."""
    known = sorted(number for frame in frames if (number := value(frame)) is not None)
    if not known:
        return 0, ""
    least, median, most = known[0], known[len(known) // 2], known[-1]
    text = (
        f"{median:.1f}{unit}" if most - least < 0.05 else f"{least:.1f} to {most:.1f}{unit}, median {median:.1f}{unit}"
    )
    return len(known), text


def _sources(frames: tuple[Frame, ...]) -> str:
    sources = [frame.heading_source for frame in frames if frame.heading_source is not None]
    return ", ".join(f"{sources.count(source)} {source}" for source in dict.fromkeys(sources))


def _span(flight: Flight) -> str:
    known = [frame.time for frame in flight.frames if frame.time is not None]
    if not known:
        return ""
    seconds = max(known) - min(known)
    span = f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"
    return f"{span} from {datetime.fromtimestamp(min(known), UTC):%Y-%m-%d %H:%M:%S} UTC" if flight.utc else span
