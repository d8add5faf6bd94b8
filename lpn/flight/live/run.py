"""A run over a flight in progress: pictures and telemetry come in and answers go out until the flight ends."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Protocol

from lpn.core.errors import LPNError
from lpn.flight.live.frames import ArrivedPicture, LiveSource, Say
from lpn.flight.live.locator import LiveLocator
from lpn.flight.live.outputs import LiveFix
from lpn.flight.live.telemetry import LiveTelemetry
from lpn.flight.locate.camera_place import below_camera
from lpn.flight.locate.located import LocatedFrame
from lpn.flight.locate.verdict import FrameVerdict, judge
from lpn.flight.locate.words import AGAINST

# Seconds without a frame after which the source counts as stalled.
_STALLED = 5.0
# Frames in a row without a usable place, or with one against their tags, after which the user is told.
_REFUSED = 10
# Seconds for which one read of the queue waits.
_LOOK = 0.2


class FixOutput(Protocol):
    """A receiver of the fixes of a flight."""

    def send(self, fix: LiveFix) -> None:
        """Take a fix."""


class LiveRun:
    """A loop that locates the frames of a source one after another.

    Args:
        source: of the pictures; it is started and closed here.
        telemetry: of the pictures; it is closed here.
        locator: of the frames.
        outputs: receivers of each fix.
        say: receives sentences about oddities.
        idle: seconds without a frame after which the run ends; None waits until the source ends.
        stop: ends the run once it is set.
    """

    def __init__(
        self,
        source: LiveSource,
        telemetry: LiveTelemetry,
        locator: LiveLocator,
        outputs: Sequence[FixOutput],
        say: Say,
        idle: float | None = None,
        stop: threading.Event | None = None,
    ) -> None:
        self._source, self._telemetry, self._locator, self._outputs = source, telemetry, locator, outputs
        self._say, self._idle = say, idle
        self._stop = stop or threading.Event()
        # The wall clock may jump during the flight, so it is read once.
        self._clock_lead = time.time() - time.monotonic()
        # Frames in a row without a usable place, by state, and frames that only their tags contradict.
        self._unplaced, self._apart = Counter[str](), 0
        self._failed: set[int] = set()
        self._problem = ""

    def run(self) -> int:
        """Locate frames until the source ends, nothing has come for `idle` seconds, or the run is stopped.

        Returns:
            The number of frames.
        """
        count = 0
        try:
            self._source.start()
            for picture in self._pictures():
                if (fix := self._fix(picture)) is not None:
                    count += 1
                    self._send(fix)
                    self._watch(fix)
        finally:
            self._source.close()
            self._telemetry.close()
        return count

    def _pictures(self) -> Iterator[ArrivedPicture]:
        """Yield the newest picture repeatedly, and tell the user when none arrives."""
        came, stalled = time.monotonic(), False
        while not self._stop.is_set() and not self._source.newest.ended:
            picture = self._source.newest.take(_LOOK)
            waited = time.monotonic() - came
            if picture is not None:
                if stalled:
                    self._say("Frames come again.")
                yield picture
                came, stalled = time.monotonic(), False
            elif self._idle is not None and waited > self._idle:
                self._say(f"No frame has come for {self._idle:g} s, so the flight counts as ended.")
                return
            elif waited > _STALLED and not stalled:
                stalled = True
                self._say(
                    f"No frame has come for {_STALLED:g} s; the last answer grows old, and the next frame is waited for."
                )

    def _fix(self, picture: ArrivedPicture) -> LiveFix | None:
        frame, telemetry_age = self._telemetry.value(picture)
        if frame.time is None:
            frame = replace(frame, time=picture.received)
        try:
            pixels = picture.pixels()
            # Describing the map takes long, so the first frame may be old by then.
            if self._locator.begin(frame) and self._source.newest.replaced():
                return None
            located = self._locator.locate(frame, pixels)
        except LPNError as error:
            if str(error) != self._problem:
                self._say(f"{error} The flight goes on without it.")
            self._problem = str(error)
            return None
        for note in self._locator.take_notes():
            self._say(note)
        best = live_answer(located)
        answer, latitude, longitude = best.answer, None, None
        if answer.x is not None and answer.y is not None:
            latitude, longitude = self._locator.basemap.frame.degrees([(answer.x, answer.y)])[0].tolist()
        clock = (
            picture.frame.time
            if picture.utc and picture.frame.time is not None
            else picture.received + self._clock_lead
        )
        age = time.monotonic() - picture.received
        return LiveFix(
            located, best, latitude, longitude, clock, age, self._source.newest.dropped, telemetry_age, pixels
        )

    def _send(self, fix: LiveFix) -> None:
        for i, output in enumerate(self._outputs):
            try:
                output.send(fix)
            except (LPNError, OSError, ValueError) as error:
                if i not in self._failed:
                    self._say(f"An output failed ({error}); the flight goes on.")
                self._failed.add(i)

    def _watch(self, fix: LiveFix) -> None:
        """Tell the user when many frames in a row have no usable place, or another one than their tags."""
        self._apart = self._apart + 1 if fix.may_correct and not fix.best.usable else 0
        if self._apart == _REFUSED:
            self._say(
                f"{_REFUSED} frames in a row are placed, and their GPS tags alone disagree. Tags may have drifted, so that holds "
                "none of these places back."
            )
        if fix.may_correct:
            self._unplaced.clear()
            return
        self._unplaced[fix.best.state] += 1
        if self._unplaced.total() != _REFUSED:
            return
        were = f"{_REFUSED} frames in a row were {' or '.join(sorted(self._unplaced, reverse=True))}"
        if fix.best.state != "refused":
            self._say(f"{were}; the last one is placed, but {' and '.join(AGAINST[one] for one in fix.best.doubt)}.")
        elif fix.located.stages["sequence"].code == "beyond" or self._locator.near_border:
            self._say(f"{were} near the border of the map; the flight may have left it.")
        else:
            self._say(f"{were}; the last says: {fix.best.reason}")


def live_answer(located: LocatedFrame) -> FrameVerdict:
    """Return the verdict with its best answer, as of `lpn locate --best`: an accepted registration, else the sequence's.

    It is moved below the camera where the tilt is known, see `below_camera`. The sequence's answer may be a refused one.
    """
    verdict = judge(located)
    if verdict.stage is None:
        verdict = replace(verdict, stage="sequence", answer=located.stages["sequence"])
    return replace(verdict, answer=below_camera(located.frame, verdict.answer))
