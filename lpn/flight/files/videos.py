"""Frames of a video: the sharpest of each second or flown stretch, with its telemetry.

Sharpness is the variance of the brightness's Laplacian. Frames are decoded one by one and only the best is kept, so memory does
not grow with the video's length.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np

from lpn.core.arrays import UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import printable, write_atomic
from lpn.core.progress import report_progress
from lpn.flight.files.base import Frame
from lpn.flight.files.cameras import upright_values
from lpn.flight.files.subtitles import GpsOrder, SubtitleBlock, parse_subtitles
from lpn.flight.files.telemetry import Log, Telemetry

SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi")
SUBTITLES = (".srt",)
_UNREADABLE = f"{{}} is not a video that can be read; expected {', '.join(SUFFIXES)}."
# The sharpest picture of a window of _WINDOW seconds is kept; at most _CANDIDATES of its pictures are compared.
_WINDOW, _CANDIDATES = 1.0, 12
# Times in seconds that differ by less count as equal.
_CLOSE = 1e-6
# Pictures are compared at this width.
_COMPARED_WIDTH = 640
_JPEG_QUALITY = 95
# A subtitle file belongs to another video if the durations differ by more than these seconds, and by more than this share.
_DIFFERS, _DIFFERS_SHARE = 3.0, 0.05


class VideoFrames(NamedTuple):
    """The chosen frames of a video.

    Attributes:
        frames: with times from its start.
        duration: of the video in seconds.
        start: the clock of its telemetry at its start, in seconds since 1970-01-01; None if unknown.
        notes: sentences about oddities.
    """

    frames: Sequence[Frame]
    duration: float
    start: float | None
    notes: list[str]


def read_frames(
    video: Path, folder: Path, log: Log, every: float = 1.0, every_metres: float | None = None
) -> VideoFrames:
    """Write the chosen frames of a video as JPEG files, and return them with their telemetry.

    Args:
        folder: of the JPEG files; existing frames are replaced.
        log: the video's telemetry with times from its start.
        every: seconds from one frame to the next, 0.04 or more. The sharpest frame of the following second is taken.
        every_metres: metres flown from one frame to the next, in place of `every`; needs positions.

    Raises:
        DataError: if the video cannot be read, has no frame, or has no positions for `every_metres`.
        OutputError: if a frame cannot be written.
    """
    name, telemetry = printable(video.name), Telemetry(log.entries)
    starts: Iterable[float] = (every * step for step in itertools.count())
    if every_metres is not None:
        starts = telemetry.times_by_distance(every_metres)
        if not starts:
            raise DataError(
                f"{name} has no positions, so frames cannot be chosen by metres flown; choose them by seconds."
            )
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg's messages would confuse the user
    capture = cv2.VideoCapture(str(video))
    frames, turns, times = [], turns_of(capture), [0.0]
    try:
        if not capture.isOpened():
            raise DataError(_UNREADABLE.format(name))
        for time, picture in _sharpest(capture, starts, times):
            file = folder / f"{video.stem}_{time:09.3f}s.jpg"
            encoded: np.ndarray[Any, Any] = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))[1]
            write_atomic(file, encoded.tobytes())
            frame = Frame(file.name, file, picture.shape[1], picture.shape[0], time)
            # The field of view of subtitles is across the longer side of the picture.
            values = upright_values(telemetry.at(time), turns, frame, across_longer_side=log.end is not None)
            frames.append(replace(frame, **values))
            done, total = (int(capture.get(one)) for one in (cv2.CAP_PROP_POS_FRAMES, cv2.CAP_PROP_FRAME_COUNT))
            report_progress(f"Reading {name}, frame", done, total)
        rate = capture.get(cv2.CAP_PROP_FPS)
    finally:
        capture.release()
    if not frames:
        raise DataError(f"{name} has no frame that can be read; it may be cut short.")
    duration = times[-1] + (1 / rate if rate > 0 and math.isfinite(rate) else 0.0)
    clocks = (entry.clock - entry.time for entry in telemetry.entries if entry.clock is not None)
    return VideoFrames(frames, duration, next(clocks, None), _notes(name, log, duration, frames, turns))


def _notes(name: str, log: Log, duration: float, frames: Sequence[Frame], turns: int) -> list[str]:
    """Return notes about subtitles of another duration, and about a video whose file asks for a turn."""
    notes = []
    if log.end is not None and abs(log.end - duration) > max(_DIFFERS, _DIFFERS_SHARE * duration):
        notes.append(
            f"{log.name} ends at {log.end:.0f} s and {name} at {duration:.0f} s: they are of two recordings, or one is cut; "
            "positions are doubtful."
        )
    if turns:
        sources = {frame.heading_source for frame in frames if frame.heading is not None}
        heading = ", and its heading with it." if sources else "."
        if "aircraft" in sources:
            # The gimbal may have rolled the camera; then the aircraft's heading is not the heading of the upright picture's top.
            heading += " If the gimbal itself turned the camera, the heading, which is that of the aircraft, is off by as much."
        notes.append(f"{name} is turned by {90 * turns}° by its file{heading}")
    return notes


def turns_of(capture: Any) -> int:
    """Return the quarter turns clockwise, 0 to 3, that a video's file asks for, by OpenCV's capture of it."""
    degrees = float(capture.get(cv2.CAP_PROP_ORIENTATION_META))
    return round(degrees / 90) % 4


def position(capture: Any, count: int) -> float:
    """Return the seconds of the capture's current picture, before which `count` pictures were read."""
    # Some containers store no times.
    rate = float(capture.get(cv2.CAP_PROP_FPS))
    return float(capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000 or (count / rate if rate > 0 else 0.0)


def began(video: Path) -> float | None:
    """Return a video's creation time by its file, in seconds since 1970-01-01 in UTC; None without it, or PyAV."""
    if find_spec("av") is None:
        return None
    import av

    try:
        with av.open(str(video), metadata_errors="replace") as container:
            return datetime.fromisoformat(container.metadata.get("creation_time", "")).timestamp()
    except (av.FFmpegError, OSError, ValueError, OverflowError):
        return None


def embedded_subtitles(video: Path, gps_order: GpsOrder | None = None) -> Log | None:
    """Return the telemetry in the subtitles inside a video; None if it has none.

    Raises:
        DataError: if the video cannot be read, or its subtitles are of no known dialect.
        ModuleNotFoundError: if PyAV is not installed.
    """
    import av

    unread: DataError | None = None
    try:
        with av.open(str(video), metadata_errors="replace") as container:
            for stream in container.streams.subtitles:
                blocks = list(_blocks(container, stream))
                try:
                    return parse_subtitles(blocks, f"the subtitle stream of {printable(video.name)}", gps_order)
                except DataError as error:
                    unread = unread or error  # perhaps a stream of spoken words
    except (av.FFmpegError, OSError, ValueError) as error:
        raise DataError(_UNREADABLE.format(printable(video.name))) from error
    if unread is not None:
        raise unread
    return None


def _blocks(container: Any, stream: Any) -> Iterator[SubtitleBlock]:
    for packet in container.demux(stream):
        data = bytes(packet)
        if stream.codec_context.name == "mov_text":  # the text follows its length
            data = data[2 : 2 + int.from_bytes(data[:2], "big")]
        if data and packet.pts is not None and packet.time_base is not None:
            start = float(packet.pts * packet.time_base)
            yield SubtitleBlock(
                data.decode("utf-8", "replace") + "\n", start, start + float((packet.duration or 0) * packet.time_base)
            )


def _sharpest(capture: Any, starts: Iterable[float], times: list[float]) -> Iterator[tuple[float, UInt8Array]]:
    """Yield the sharpest picture after each start with its time, and keep the time of the last picture in `times`."""
    windows = itertools.pairwise(itertools.chain(starts, [math.inf]))
    (start, end), compared = next(windows), -math.inf
    best: tuple[float, float, UInt8Array] | None = None  # sharpness, time, picture
    for count in itertools.count():
        if not capture.grab():
            break
        times[-1] = time = max(times[-1], position(capture, count))
        while time >= end - _CLOSE:
            if best is not None:
                yield best[1:]
            (start, end), compared, best = next(windows), -math.inf, None
        window = min(_WINDOW, end - start)
        inside = start - _CLOSE <= time < start + window - _CLOSE
        if not (inside or (best is None and time >= start)) or time < compared + window / _CANDIDATES - _CLOSE:
            continue
        read, picture = capture.retrieve()
        if read and picture is not None:
            compared, sharpness = time, _sharpness(picture)
            if best is None or sharpness > best[0]:
                best = sharpness, time, picture
    if best is not None:
        yield best[1:]


def _sharpness(picture: UInt8Array) -> float:
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    if grey.shape[1] > _COMPARED_WIDTH:
        size = _COMPARED_WIDTH, max(1, round(grey.shape[0] * _COMPARED_WIDTH / grey.shape[1]))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def beside(video: Path, files: Sequence[Path]) -> Path | None:
    """Return the subtitle file that has a video's name: from `files`, else from the video's folder; None if there is none."""
    spellings = (video.with_suffix(spelling) for suffix in SUBTITLES for spelling in (suffix.upper(), suffix))
    given = (file for file in files if file.stem.casefold() == video.stem.casefold())
    return next(given, None) or next((file for file in spellings if file.is_file()), None)
