"""Answers of a flight in progress as lines of GeoJSON."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from typing import IO, Any

from lpn.core.arrays import UInt8Array
from lpn.core.files import printable
from lpn.core.numbers import heading_figure
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.verdict import FrameVerdict


@dataclass(frozen=True, eq=False)
class LiveFix:
    """The answer for one frame of a flight in progress.

    Attributes:
        located: the frame with the answers of its stages.
        best: the verdict with the answer of the registration or the sequence, moved below the camera where the tilt is known.
        latitude, longitude: WGS 84 degrees; None without a place.
        clock: time of the frame in seconds since 1970 in UTC.
        age: seconds from the frame's arrival to the answer.
        dropped: number of earlier frames that newer ones replaced.
        telemetry_age: seconds between frame and telemetry; None without telemetry.
        pixels: of the frame, RGB (H, W, 3).
    """

    located: LocatedFrame
    best: FrameVerdict
    latitude: float | None
    longitude: float | None
    clock: float
    age: float
    dropped: int
    telemetry_age: float | None = None
    pixels: UInt8Array | None = None

    @property
    def answer(self) -> StageRecord:
        """The position with its radius."""
        return self.best.answer

    @property
    def may_correct(self) -> bool:
        """True if the place may correct the vehicle's position: a contradiction by that position alone is no obstacle."""
        return self.best.usable or (self.answer.accepted and self.best.doubt == ["tag"])

    def feature(self) -> dict[str, Any]:
        """Return the fix as a feature of GeoJSON (RFC 7946), see docs/locate-a-flight.md."""
        answer, best = self.answer, self.best
        geometry = None
        if self.latitude is not None and self.longitude is not None:
            geometry = {"type": "Point", "coordinates": [round(self.longitude, 8), round(self.latitude, 8)]}
        properties = {
            "frame": printable(self.located.frame.name),
            **best.columns,
            "time": round(self.clock, 3),
            "camera": answer.camera,
            "radius": _rounded(answer.radius, 2),
            "heading": heading_figure(answer.heading),
            "error": _rounded(self.located.error(answer), 2),
            "age": round(self.age, 3),
            "dropped": self.dropped,
            "telemetry_age": _rounded(self.telemetry_age, 3),
        }
        return {"type": "Feature", "geometry": geometry, "properties": properties}

    def line(self) -> str:
        """Return the feature as one line."""
        return json.dumps(self.feature(), ensure_ascii=False, allow_nan=False)


class LineOutput:
    """GeoJSON, a line each, into a file or to the standard output."""

    def __init__(self, stream: IO[str]) -> None:
        self._stream = stream

    def send(self, fix: LiveFix) -> None:
        """Write a fix at once."""
        self._stream.write(fix.line() + "\n")
        self._stream.flush()


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)
