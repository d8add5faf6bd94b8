"""Arriving pictures: a thread reads their source; one picture waits, and a newer one replaces and drops it."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import cv2

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError, PictureError
from lpn.core.files import printable
from lpn.core.texts import counted
from lpn.datasets.listed_paths import hidden_name
from lpn.flight.files.base import Frame
from lpn.flight.files.photos import read_photo
from lpn.flight.files.sources import PHOTOS
from lpn.flight.files.videos import SUFFIXES as VIDEOS
from lpn.flight.files.videos import position, turns_of

# Called with sentences for the user.
Say = Callable[[str], None]
# Seconds between two scans of a folder, and seconds for which an unreadable file counts as incomplete.
_POLL, _UNFINISHED = 0.2, 2.0
# The pause after a scan of a folder is this many times its duration, up to this many seconds.
_BACK_OFF, _LONGEST_PAUSE = 9, 15.0
# Milliseconds without data after which a stream has stalled, and seconds between two tries to open it.
_SILENT_MS, _RETRY = 5000, 2.0


@dataclass(frozen=True, eq=False)
class ArrivedPicture:
    """A picture of a flight in progress.

    Attributes:
        frame: the picture's name, size, and camera data from its file. `time` is in seconds: UTC or local for a photo (see
            `utc`), the position in a video, None for a stream.
        received: its arrival in seconds of the monotonic clock.
        picture: RGB, (H, W, 3); None if it is read from the frame's file on demand, so that dropped pictures are not decoded.
        utc: whether the frame's time is UTC.
        turns: quarter turns clockwise that its file asks for.
    """

    frame: Frame
    received: float
    picture: UInt8Array | None = None
    utc: bool = False
    turns: int = 0

    def pixels(self) -> UInt8Array:
        """Return the picture; PictureError if its file cannot be read."""
        return images.load_picture(self.frame.file) if self.picture is None else self.picture


# Yields pictures until its source ends, or the event is set.
PictureReader = Callable[[threading.Event], Iterator[ArrivedPicture]]


class LiveSource:
    """A source of pictures, read in a separate thread; the newest picture waits.

    Args:
        read: yields the pictures.
        say: receives sentences about oddities.

    Attributes:
        dropped: pictures that newer ones replaced before anybody took them.
    """

    def __init__(self, read: PictureReader, say: Say) -> None:
        self.dropped = 0
        self._reader, self._say = read, say
        self._stop, self._changed = threading.Event(), threading.Condition()
        self._waiting: ArrivedPicture | None = None
        self._ended = False
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=_RETRY)

    def take(self, seconds: float) -> ArrivedPicture | None:
        """Wait for the newest picture and return it; None after these seconds without one, or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._ended, seconds)
            picture, self._waiting = self._waiting, None
            return picture

    def replaced(self) -> bool:
        """Return whether a newer picture waits; if so, the last result of `take` counts as dropped."""
        with self._changed:
            self.dropped += self._waiting is not None
            return self._waiting is not None

    @property
    def ended(self) -> bool:
        """True once no picture waits or will follow."""
        with self._changed:
            return self._ended and self._waiting is None

    def _run(self) -> None:
        try:
            for picture in self._reader(self._stop):
                with self._changed:
                    self.dropped += self._waiting is not None
                    self._waiting = picture
                    self._changed.notify()
        except Exception as error:  # a folder that is taken away
            self._say(f"Pictures can be read no longer ({printable(str(error))[:150]}); the flight counts as ended.")
        finally:
            with self._changed:
                self._ended = True
                self._changed.notify()


def folder_pictures(folder: Path, say: Say) -> PictureReader:
    """Return a reader of the new photos of a folder and its subfolders; photos that exist already are left out."""
    seen = set(_photos(folder))
    if seen:
        say(f"Left out: {counted(len(seen), 'photo')} that {printable(folder.name)} held before.")
    # Files that could not be read, by the time of the first try: a camera may still be writing them.
    unfinished: dict[Path, float] = {}

    def read(stop: threading.Event) -> Iterator[ArrivedPicture]:
        pause = _POLL
        while not stop.wait(pause):
            began = time.monotonic()
            photos = sorted(file for file in _photos(folder) if file not in seen)
            # Listing a folder of a million photos takes long.
            pause = max(_POLL, min(_BACK_OFF * (time.monotonic() - began), _LONGEST_PAUSE))
            for file in photos:
                now = time.monotonic()
                try:
                    photo = read_photo(file)
                except PictureError as error:
                    if file.exists() and now - unfinished.setdefault(file, now) > _UNFINISHED:
                        seen.add(file)
                        say(f"{error} The flight goes on without it.")
                    continue
                seen.add(file)
                unfinished.pop(file, None)
                frame = replace(photo.frame, time=photo.local if photo.utc is None else photo.utc)
                yield ArrivedPicture(frame, now, None, photo.utc is not None, photo.turns)

    return read


def _photos(folder: Path) -> Iterator[Path]:
    """Yield the photos of all folders that are not hidden; a folder that cannot be listed is tried again at the next scan."""
    folders = [folder]
    while folders:
        with suppress(OSError):
            for one in os.scandir(folders.pop()):
                if one.is_dir(follow_symlinks=False):
                    if not hidden_name(one.name):
                        folders.append(Path(one))
                elif not one.name.startswith(".") and one.name.lower().endswith(PHOTOS) and one.is_file():
                    yield Path(one)


def stream_pictures(source: Path | str, say: Say, fov: float | None = None) -> PictureReader:
    """Return a reader of the frames of a video file at its recorded pace, or of an RTSP, UDP, or HTTP stream.

    A stream that stalls is opened again; a video ends.

    Args:
        source: a file, or a URL.
        fov: horizontal field of view in degrees.

    Raises:
        InputError: if it cannot be opened.
    """
    name, is_file = shown_name(source), isinstance(source, Path)
    os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # FFmpeg's messages would confuse the user
    limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _SILENT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _SILENT_MS]

    def opened() -> Any:
        return cv2.VideoCapture(str(source), cv2.CAP_FFMPEG, [] if is_file else limits)

    capture = opened()
    if not capture.isOpened():
        raise InputError(f"{name} cannot be opened as a video or stream; check the name, and that it sends.")
    turns = turns_of(capture)
    if turns:
        say(f"{name} asks for a turn of {90 * turns}°; the heading of its telemetry is turned equally.")

    def read(stop: threading.Event) -> Iterator[ArrivedPicture]:
        nonlocal capture
        count, began = 0, time.monotonic()
        seconds: float | None = None
        while not stop.is_set():
            was_open = capture.isOpened()
            got, picture = capture.read()
            if not got or picture is None:
                if is_file:
                    break
                if was_open:
                    say(f"{name} has stalled; it is reopened every few seconds until pictures arrive.")
                capture.release()
                stop.wait(_RETRY)
                capture = opened()
                continue
            if is_file:
                seconds = position(capture, count)
                stop.wait(max(began + seconds - time.monotonic(), 0))
            count += 1
            frame = Frame(f"{count:06d}", Path(), picture.shape[1], picture.shape[0], seconds, fov=fov)
            rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
            yield ArrivedPicture(frame, time.monotonic(), rgb, turns=turns)
        capture.release()

    return read


def shown_name(source: Path | str) -> str:
    """Return a source's name for display: a file's name, or a stream's address without user and password."""
    if isinstance(source, Path) or "://" not in str(source):
        return printable(Path(str(source)).name or str(source))
    parts = urlsplit(str(source))
    return printable(f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}")


def open_source(source: str, say: Say, fov: float | None = None) -> LiveSource:
    """Open a folder, a video file, or a stream by its address.

    Args:
        say: receives sentences about oddities.
        fov: horizontal field of view of a video or stream in degrees.

    Raises:
        InputError: for any other source, or one that cannot be opened.
    """
    path = Path(source)
    if path.is_dir():
        return LiveSource(folder_pictures(path, say), say)
    if "://" in source:
        return LiveSource(stream_pictures(source, say, fov), say)
    if path.is_file():
        if path.suffix.lower() not in VIDEOS:
            raise InputError(f"{printable(path.name)} is not a supported video; expected {', '.join(VIDEOS)}.")
        return LiveSource(stream_pictures(path, say, fov), say)
    raise InputError(
        f"There is no {printable(source)}; give a folder that receives photos, a video, or the address of a stream, such as "
        "rtsp://127.0.0.1:8554/drone."
    )
