"""Frames of a video: the sharpest of each second or flown stretch, with its telemetry.

Sharpness is the variance of the brightness's Laplacian. Frames are decoded one by one and only the best is kept, so memory does
not grow with the video's length.
"""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from datetime import datetime
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from lpn.core.arrays import UInt8Array
from lpn.core.errors import DataError
from lpn.core.files import printable, write_atomic
from lpn.flight.files.base import Frame
from lpn.flight.files.cameras import upright_values
from lpn.flight.files.subtitles import GpsOrder, SubtitleBlock, Subtitles, parse_subtitles
from lpn.flight.files.telemetry import VALUES, Telemetry

SUFFIXES = (".mp4", ".mov", ".m4v", ".mkv", ".avi")
SUBTITLES = (".srt",)
# The sharpest picture of a window of _WINDOW seconds is kept; at most _CANDIDATES of its pictures are compared.
_WINDOW, _CANDIDATES = 1.0, 12
# Pictures are compared at this width.
_COMPARED_WIDTH = 640
_JPEG_QUALITY = 95
# A subtitle file belongs to another video if the durations differ by more than these seconds, and by more than this share.
_DIFFERS, _DIFFERS_SHARE = 3.0, 0.05


@dataclass(frozen=True)
class VideoFrames:
    """The chosen frames of a video, with times from its start.

    Attributes:
        duration: of the video in seconds.
        turns: quarter turns clockwise that the video's file asks for; they turn the heading, too.
    """

    frames: tuple[Frame, ...]
    duration: float
    turns: int = 0


def read_frames(
    video: Path,
    folder: Path,
    every: float = 1.0,
    every_metres: float | None = None,
    telemetry: Telemetry | None = None,
    across_longer_side: bool = False,
) -> VideoFrames:
    """Write the chosen frames of a video as JPEG files, and return them with their telemetry.

    Args:
        folder: of the JPEG files; existing frames are replaced.
        every: seconds from one frame to the next, 0.04 or more. The sharpest frame of the following second is taken.
        every_metres: metres flown from one frame to the next, in place of `every`; needs positions.
        telemetry: of the video.
        across_longer_side: see `lpn.flight.files.cameras.upright_values`.

    Raises:
        DataError: if the video cannot be read, has no frame, or has no positions for `every_metres`.
        OutputError: if a frame cannot be written.
    """
    starts: Iterator[float] = (every * step for step in itertools.count())
    if every_metres is not None:
        start_times = telemetry.times_by_distance(every_metres) if telemetry is not None else []
        if not start_times:
            raise DataError(
                f"{printable(video.name)} has no positions, so frames cannot be chosen by metres flown; choose them by seconds."
            )
        starts = iter(start_times)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its own messages would add to ours
    capture = cv2.VideoCapture(str(video))
    try:
        if not capture.isOpened():
            raise DataError(f"{printable(video.name)} is not a video that can be read; expected {', '.join(SUFFIXES)}.")
        turns = turns_of(capture)
        frames, end = _chosen(capture, video, folder, starts, telemetry)
        rate = capture.get(cv2.CAP_PROP_FPS)
    finally:
        capture.release()
    if not frames:
        raise DataError(f"{printable(video.name)} has no frame that can be read; it may be cut short.")
    duration = end + (1 / rate if rate > 0 and math.isfinite(rate) else 0.0)
    for i, frame in enumerate(frames):
        told = {name: getattr(frame, name) for name in VALUES}
        frames[i] = replace(frame, **upright_values(told, turns, frame, across_longer_side))
    return VideoFrames(tuple(frames), duration, turns)


def turns_of(capture: Any) -> int:
    """Return the quarter turns clockwise, 0 to 3, that a video's file asks for, by OpenCV's capture of it."""
    degrees = float(capture.get(cv2.CAP_PROP_ORIENTATION_META))
    return round(degrees / 90) % 4


def mismatch(subtitles: Subtitles, name: str, video: Path, duration: float) -> str | None:
    """Return a note if subtitles do not fit a video of `duration` seconds; None if they do."""
    off = abs(subtitles.end - duration)
    if off <= max(_DIFFERS, _DIFFERS_SHARE * duration):
        return None
    return (
        f"{printable(name)} ends at {subtitles.end:.0f} s and {printable(video.name)} at {duration:.0f} s: they are of two "
        "recordings, or one is cut; positions are doubtful."
    )


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


def embedded_subtitles(video: Path, gps_order: GpsOrder | None = None) -> Subtitles | None:
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
        raise DataError(
            f"{printable(video.name)} is not a video that can be read; expected {', '.join(SUFFIXES)}."
        ) from error
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


def _chosen(
    capture: Any, video: Path, folder: Path, starts: Iterator[float], telemetry: Telemetry | None
) -> tuple[list[Frame], float]:
    frames: list[Frame] = []
    best: tuple[float, float, UInt8Array] | None = None  # sharpness, time, picture
    start, following, time, compared = next(starts), next(starts, math.inf), 0.0, -math.inf
    rate, count = capture.get(cv2.CAP_PROP_FPS), 0
    while capture.grab():
        # Some containers have no times of their own.
        position = capture.get(cv2.CAP_PROP_POS_MSEC) / 1000 or (count / rate if rate > 0 else 0.0)
        time, count = max(time, position), count + 1
        while time >= following - 1e-6:
            if best is not None:
                frames.append(_written(best, video, folder, telemetry))
            best, start, following, compared = None, following, next(starts, math.inf), -math.inf
        window = min(_WINDOW, following - start)
        inside = start - 1e-6 <= time < start + window - 1e-6
        if not (inside or (best is None and time >= start)) or time < compared + window / _CANDIDATES - 1e-6:
            continue
        read, picture = capture.retrieve()
        if not read or picture is None:
            continue
        compared = time
        sharpness = _sharpness(picture)
        if best is None or sharpness > best[0]:
            best = sharpness, time, picture
    if best is not None:
        frames.append(_written(best, video, folder, telemetry))
    return frames, time


def _sharpness(picture: UInt8Array) -> float:
    grey = cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY)
    if grey.shape[1] > _COMPARED_WIDTH:
        size = _COMPARED_WIDTH, max(1, round(grey.shape[0] * _COMPARED_WIDTH / grey.shape[1]))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return float(cv2.Laplacian(grey, cv2.CV_32F).var())


def _written(best: tuple[float, float, UInt8Array], video: Path, folder: Path, telemetry: Telemetry | None) -> Frame:
    _, time, picture = best
    name = f"{video.stem}_{time:09.3f}s.jpg"
    encoded: np.ndarray[Any, Any] = cv2.imencode(".jpg", picture, (cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY))[1]
    write_atomic(folder / name, encoded.tobytes())
    values: dict[str, Any] = {} if telemetry is None else telemetry.at(time)
    return Frame(name, folder / name, picture.shape[1], picture.shape[0], time, **values)


def beside(video: Path, files: Sequence[Path]) -> Path | None:
    """Return the subtitle file that has a video's name: from `files`, else from the video's folder; None if there is none."""
    spellings = (video.with_suffix(spelling) for suffix in SUBTITLES for spelling in (suffix.upper(), suffix))
    given = (file for file in files if file.stem.casefold() == video.stem.casefold())
    return next(given, None) or next((file for file in spellings if file.is_file()), None)
