"""The command flight."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

from lpn.core.texts import counted

if TYPE_CHECKING:
    from lpn.flight.files import Flight


@dataclass
class FlightCommand:
    """Read the photos or videos of a flight with their positions, heights, and headings into a folder."""

    files: Annotated[tuple[Path, ...], tyro.conf.Positional]
    """Photos with EXIF and XMP, or videos with .SRT files or subtitles inside; .csv logs; .gpx tracks; logs of autopilots, .ulg,
    .tlog, or .bin (extra live); folders of photos or videos."""
    out: Path
    """Folder to write: flight.csv, flight.json, and the frames of videos in frames. Photos stay where they are."""
    every: float = 1.0
    """Seconds from one frame of a video to the next; within a second from each moment, the sharpest is taken."""
    every_metres: float | None = None
    """Metres flown from one frame of a video to the next, in place of --every."""
    gps_order: Literal["lat-lon", "lon-lat"] | None = None
    """Order of the first two values of GPS(a, b, c) in subtitles; by default by the dialect; a note says if it is a guess."""
    fov: float | None = None
    """Horizontal field of view in degrees, for photos whose files have none."""
    pitch: float | None = None
    """Pitch in degrees, for photos whose files have none; -90 is straight down."""
    camera: Path | None = None
    """File of the camera's lens, YAML or JSON of OpenCV, ROS, or ODM, whose distortion is taken out before photos are
    matched; by default the one in DJI's photos."""
    clock_offset: float | None = None
    """Seconds to add to the photos' times to get the log's; by default estimated, if they differ by a time zone."""

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
    sources = [frame.heading_source for frame in frames if frame.heading_source is not None]
    told = ", ".join(f"{sources.count(source)} {source}" for source in dict.fromkeys(sources))
    lens = "its distortion is taken out before photos are matched"
    columns: list[tuple[str, list[float | None], str]] = [
        ("GPS tag", [frame.latitude for frame in frames], ""),
        ("height above ground", [frame.height_above_ground for frame in frames], " m"),
        ("height above take-off", [frame.height_above_takeoff for frame in frames], " m"),
        ("altitude", [frame.altitude for frame in frames], " m"),
        ("heading", [frame.heading for frame in frames], told),
        ("pitch", [frame.pitch for frame in frames], "°"),
        ("field of view", [frame.fov for frame in frames], "°"),
        ("lens", [None if frame.lens is None else frame.lens.fov for frame in frames], lens),
        ("width on the ground", [ground_width(frame) for frame in frames], " m"),
        ("time", [frame.time for frame in frames], _span(flight)),
    ]
    lines = [f"{flight.name}: {counted(len(frames), 'photo')}"]
    for name, values, about in columns:
        known = sorted(value for value in values if value is not None)
        if known or name != "lens":
            text = _range(known, about) if about in (" m", "°") else about if known else ""
            lines.append(f"  {name:22}{len(known):>6} of {len(frames)}  {text}".rstrip())
    return "\n".join([*lines, *(f"- {note}" for note in flight.notes)])


def _range(known: list[float], unit: str) -> str:
    """Return the least, median, and largest of sorted values."""
    if not known:
        return ""
    least, median, most = known[0], known[len(known) // 2], known[-1]
    text = f"{median:.1f}{unit}"
    return text if most - least < 0.05 else f"{least:.1f} to {most:.1f}{unit}, median {text}"


def _span(flight: Flight) -> str:
    known = [frame.time for frame in flight.frames if frame.time is not None]
    if not known:
        return ""
    seconds = max(known) - min(known)
    span = f"{seconds / 60:.1f} min" if seconds >= 60 else f"{seconds:.1f} s"
    return f"{span} from {datetime.fromtimestamp(min(known), UTC):%Y-%m-%d %H:%M:%S} UTC" if flight.utc else span
