"""A run over a flight in progress: pictures and telemetry come in and fixes go out until the flight ends."""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

from lpn.core.arrays import UInt8Array
from lpn.core.errors import LPNError
from lpn.core.files import printable
from lpn.core.numbers import heading_figure
from lpn.flight.live.frames import ArrivedPicture, LiveSource, Say
from lpn.flight.live.locator import LiveLocator
from lpn.flight.live.telemetry import LiveTelemetry
from lpn.flight.locate.camera_place import below_camera
from lpn.flight.locate.located import LocatedFrame
from lpn.flight.locate.verdict import FrameVerdict, judge

# Seconds without a frame after which the source counts as stalled.
_STALLED = 5.0
# Frames in a row without a usable place, after which the user is told.
_REFUSED = 10
# Seconds for which one read of the queue waits.
_LOOK = 0.2


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

    def line(self) -> str:
        """Return the fix as a feature of GeoJSON (RFC 7946) in one line, see docs/locate-a-flight.md."""
        answer, geometry = self.best.answer, None
        if self.latitude is not None and self.longitude is not None:
            geometry = {"type": "Point", "coordinates": [round(self.longitude, 8), round(self.latitude, 8)]}
        properties: dict[str, Any] = {
            "frame": printable(self.located.frame.name),
            **self.best.columns,
            "time": round(self.clock, 3),
            "camera": answer.camera,
            "radius": _rounded(answer.radius, 2),
            "heading": heading_figure(answer.heading),
            "error": _rounded(self.located.error(answer), 2),
            "age": round(self.age, 3),
            "dropped": self.dropped,
            "telemetry_age": _rounded(self.telemetry_age, 3),
        }
        feature = {"type": "Feature", "geometry": geometry, "properties": properties}
        return json.dumps(feature, ensure_ascii=False, allow_nan=False)


def _rounded(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


# Receives each fix of a flight.
FixOutput = Callable[[LiveFix], object]


def locate_live(
    source: LiveSource,
    telemetry: LiveTelemetry,
    locator: LiveLocator,
    outputs: Sequence[FixOutput],
    say: Say,
    idle: float | None = None,
) -> int:
    """Locate the frames of a source one after another until it ends, and return their number.

    Args:
        source: of the pictures; it is started and closed here.
        telemetry: of the pictures; it is closed here.
        locator: of the frames.
        outputs: receivers of each fix.
        say: receives sentences about oddities.
        idle: seconds without a frame after which the flight counts as ended; None waits until the source ends.
    """
    # The wall clock may jump during the flight, so it is read once.
    clock_lead = time.time() - time.monotonic()
    count = unplaced = 0
    problem, has_failed = "", False
    try:
        source.start()
        for picture in _pictures(source, say, idle):
            try:
                fix = _fix(picture, source, telemetry, locator, clock_lead)
            except LPNError as error:
                if str(error) != problem:
                    say(f"{error} The flight goes on without it.")
                problem = str(error)
                continue
            if fix is None:
                continue
            count += 1
            for output in outputs:
                try:
                    output(fix)
                except (LPNError, OSError, ValueError) as error:
                    if not has_failed:
                        say(f"An output failed ({error}); the flight goes on.")
                    has_failed = True
            unplaced = 0 if fix.best.usable else unplaced + 1
            if unplaced == _REFUSED:
                say(_without_place(fix, locator.near_border))
    finally:
        source.close()
        telemetry.close()
    return count


def _pictures(source: LiveSource, say: Say, idle: float | None) -> Iterator[ArrivedPicture]:
    """Yield the newest picture repeatedly, and tell the user when none arrives."""
    came, has_stalled = time.monotonic(), False
    while not source.ended:
        picture = source.take(_LOOK)
        waited = time.monotonic() - came
        if picture is not None:
            if has_stalled:
                say("Frames come again.")
            yield picture
            came, has_stalled = time.monotonic(), False
        elif idle is not None and waited > idle:
            say(f"No frame has come for {idle:g} s, so the flight counts as ended.")
            return
        elif waited > _STALLED and not has_stalled:
            has_stalled = True
            say(f"No frame has come for {_STALLED:g} s; the last answer grows old, and the next frame is waited for.")


def _fix(
    picture: ArrivedPicture, source: LiveSource, telemetry: LiveTelemetry, locator: LiveLocator, clock_lead: float
) -> LiveFix | None:
    """Locate a picture; None if a newer one came while the map was described, which takes long."""
    frame, telemetry_age = telemetry.value(picture)
    if frame.time is None:
        frame = replace(frame, time=picture.received)
    pixels = picture.pixels()
    if locator.begin(frame) and source.replaced():
        return None
    located = locator.locate(frame, pixels)
    best = live_answer(located)
    latitude, longitude = None, None
    if best.answer.x is not None and best.answer.y is not None:
        place = best.answer.x, best.answer.y
        latitude, longitude = locator.basemap.frame.degrees([place])[0].tolist()
    clock = picture.frame.time if picture.utc else None
    clock = picture.received + clock_lead if clock is None else clock
    age = time.monotonic() - picture.received
    return LiveFix(located, best, latitude, longitude, clock, age, source.dropped, telemetry_age, pixels)


def _without_place(fix: LiveFix, near_border: bool) -> str:
    """Return the sentence about many frames in a row without a usable place, by the last of them."""
    begin = f"{_REFUSED} frames in a row have no certain place"
    if fix.best.answer.accepted and fix.best.doubt == ["tag"]:
        return f"{begin}: its details place the last one; only its GPS tag disagrees, and may have drifted."
    last = f"{fix.best.summary}. {fix.best.reason}"
    if fix.located.stages["sequence"].code == "beyond" or near_border:
        last += " The last place is near the border of the map; the flight may have left it."
    return f"{begin}; the last one says: {last}"


def live_answer(located: LocatedFrame) -> FrameVerdict:
    """Return the verdict with its best answer, as of `lpn locate --best`: an accepted registration, else the sequence.

    It is moved below the camera where the tilt is known, see `below_camera`. The sequence's answer may be a refused one.
    """
    verdict = judge(located)
    if verdict.stage is None:
        verdict = replace(verdict, stage="sequence", answer=located.stages["sequence"])
    return replace(verdict, answer=below_camera(located.frame, verdict.answer))
