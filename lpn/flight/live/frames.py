"""Arriving pictures: a thread reads their source into a queue of one; a newer picture replaces and drops the one that waits."""

from __future__ import annotations

import os
import threading
import time
from abc import ABC, abstractmethod
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
from lpn.datasets.listed_paths import hidden_name
from lpn.flight.files.base import Frame
from lpn.flight.files.photos import read_photo
from lpn.flight.files.sources import PHOTOS
from lpn.flight.files.videos import SUFFIXES as VIDEOS
from lpn.flight.files.videos import turns_of

# Called with sentences for the user.
Say = Callable[[str], None]
# Seconds between two scans of a folder, and seconds for which an unreadable file may still be in writing.
_POLL, _UNFINISHED = 0.2, 2.0
# The pause after a scan of a folder is this many times its duration, up to this many seconds.
_BACK_OFF, _LONGEST_PAUSE = 9, 15.0
# Milliseconds without data after which a stream has stalled, and seconds between two tries to open it.
_SILENT_MS, _RETRY = 5000, 2.0


@dataclass(frozen=True, eq=False)
class ArrivedPicture:
    """A picture of a flight in progress.

    Attributes:
        frame: its name, size, and the camera's data of its file; `time` is in seconds: UTC for a photo, the position in a
            video, None for a stream.
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


class NewestPicture:
    """A queue of one: the newest picture waits, and those that it replaces are counted; thread-safe.

    Attributes:
        dropped: pictures that were replaced before anybody took them.
    """

    def __init__(self) -> None:
        self._changed = threading.Condition()
        self._waiting: ArrivedPicture | None = None
        self._ended = False
        self.dropped = 0

    def put(self, picture: ArrivedPicture) -> None:
        """Replace the waiting picture."""
        with self._changed:
            self.dropped += self._waiting is not None
            self._waiting = picture
            self._changed.notify()

    def replaced(self) -> bool:
        """Tell whether a newer picture waits; if so, count the last one that was taken as dropped."""
        with self._changed:
            self.dropped += self._waiting is not None
            return self._waiting is not None

    def end(self) -> None:
        """Mark the queue as ended: no picture will follow."""
        with self._changed:
            self._ended = True
            self._changed.notify()

    def take(self, seconds: float) -> ArrivedPicture | None:
        """Wait for the newest picture and return it; None after these seconds without one, or at the end."""
        with self._changed:
            self._changed.wait_for(lambda: self._waiting is not None or self._ended, seconds)
            picture, self._waiting = self._waiting, None
            return picture

    @property
    def waiting(self) -> bool:
        """True while a picture waits."""
        with self._changed:
            return self._waiting is not None

    @property
    def ended(self) -> bool:
        """True once no picture waits or will follow."""
        with self._changed:
            return self._ended and self._waiting is None


class LiveSource(ABC):
    """A source of pictures, read by a thread of its own.

    Args:
        say: receives sentences about what is odd.
    """

    def __init__(self, say: Say) -> None:
        self.newest = NewestPicture()
        self._say = say
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="pictures", daemon=True)

    def start(self) -> None:
        """Begin to read."""
        self._thread.start()

    def close(self) -> None:
        """Stop reading."""
        self._stop.set()
        if self._thread.ident is not None:
            self._thread.join(timeout=_RETRY)

    def _run(self) -> None:
        try:
            self._read()
        except Exception as error:  # a folder that is taken away
            self._say(f"Pictures can be read no longer ({printable(str(error))[:150]}); the flight counts as ended.")
        finally:
            self.newest.end()

    @abstractmethod
    def _read(self) -> None:
        """Put pictures until the source ends or `_stop` is set."""


class FolderPictures(LiveSource):
    """New photos of a folder, with their EXIF and XMP; photos that exist at the start are left out.

    Args:
        folder: an existing folder; its subfolders count, too.
    """

    def __init__(self, folder: Path, say: Say) -> None:
        super().__init__(say)
        self._seen = set[Path]()
        self._folder = folder
        self._seen.update(self._new_photos())
        # Files that cannot be read yet, with the time of the first try.
        self._unfinished: dict[Path, float] = {}
        if self._seen:
            say(f"{len(self._seen)} photos that were in {printable(folder.name)} before are left out.")

    def _read(self) -> None:
        pause = _POLL
        while not self._stop.wait(pause):
            began = time.monotonic()
            photos = sorted({*self._unfinished, *self._new_photos()})
            # Listing a folder of a million photos takes long.
            pause = max(_POLL, min(_BACK_OFF * (time.monotonic() - began), _LONGEST_PAUSE))
            for file in photos:
                self._take(file)

    def _new_photos(self) -> Iterator[Path]:
        """Yield unseen photos of all folders that are not hidden."""
        folders = [self._folder]
        while folders:
            with suppress(OSError):  # it was removed
                for one in os.scandir(folders.pop()):
                    if one.is_dir(follow_symlinks=False):
                        if not hidden_name(one.name):
                            folders.append(Path(one))
                    elif (
                        not one.name.startswith(".")
                        and one.name.lower().endswith(PHOTOS)
                        and (file := Path(one)) not in self._seen
                        and one.is_file()
                    ):
                        yield file

    def _take(self, file: Path) -> None:
        now = time.monotonic()
        try:
            photo = read_photo(file)
        except PictureError as error:
            if not file.exists():  # it was a temporary file
                self._unfinished.pop(file, None)
                return
            # A camera may still be writing it.
            if now - self._unfinished.setdefault(file, now) > _UNFINISHED:
                self._seen.add(file)
                del self._unfinished[file]
                self._say(f"{error} The flight goes on without it.")
            return
        self._seen.add(file)
        self._unfinished.pop(file, None)
        taken = photo.local if photo.utc is None else photo.utc
        frame = replace(photo.frame, time=taken)
        self.newest.put(ArrivedPicture(frame, now, None, photo.utc is not None, photo.turns))


class StreamPictures(LiveSource):
    """Frames of a video file at their own pace, or of an RTSP, UDP, or HTTP stream.

    A stream that stalls is opened again; a video ends.

    Args:
        source: a file, or a URL.
        fov: horizontal field of view in degrees.
    """

    def __init__(self, source: Path | str, say: Say, fov: float | None = None) -> None:
        super().__init__(say)
        self._source, self._fov = source, fov
        self._is_file = isinstance(source, Path)
        self._name = shown_name(source)
        os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # its own messages would add to ours
        self._capture = self._opened()
        if self._capture is None:
            raise InputError(f"{self._name} cannot be opened as a video or stream; check the name, and that it sends.")
        self._turns = turns_of(self._capture)
        if self._turns:
            say(f"{self._name} is turned by {90 * self._turns}° by its file, and the heading of its telemetry with it.")

    def _opened(self) -> Any:
        limits = [cv2.CAP_PROP_OPEN_TIMEOUT_MSEC, _SILENT_MS, cv2.CAP_PROP_READ_TIMEOUT_MSEC, _SILENT_MS]
        capture = cv2.VideoCapture(str(self._source), cv2.CAP_FFMPEG, [] if self._is_file else limits)
        if capture.isOpened():
            return capture
        capture.release()
        return None

    def _read(self) -> None:
        count, began = 0, time.monotonic()
        while not self._stop.is_set():
            read, picture = (False, None) if self._capture is None else self._capture.read()
            if not read or picture is None:
                if self._is_file:
                    break
                if self._capture is not None:
                    self._say(f"{self._name} has stalled; it is opened again until it sends.")
                    self._capture.release()
                self._stop.wait(_RETRY)
                self._capture = self._opened()
                continue
            position = None
            if self._is_file:
                position = self._position(count)
                self._stop.wait(max(began + position - time.monotonic(), 0))
            count += 1
            frame = Frame(f"{count:06d}", Path(), picture.shape[1], picture.shape[0], position, fov=self._fov)
            rgb = cv2.cvtColor(picture, cv2.COLOR_BGR2RGB)
            self.newest.put(ArrivedPicture(frame, time.monotonic(), rgb, turns=self._turns))
        if self._capture is not None:
            self._capture.release()

    def _position(self, count: int) -> float:
        """Return the seconds from a video's start to its last read frame."""
        rate = float(self._capture.get(cv2.CAP_PROP_FPS))
        return float(self._capture.get(cv2.CAP_PROP_POS_MSEC)) / 1000 or (count / rate if rate > 0 else 0.0)


def shown_name(source: Path | str) -> str:
    """Return a source's name for display: a file's name, or a stream's address without user and password."""
    if isinstance(source, Path) or "://" not in str(source):
        return printable(Path(str(source)).name or str(source))
    parts = urlsplit(str(source))
    return printable(f"{parts.scheme}://{parts.netloc.rpartition('@')[2]}{parts.path}")


def open_source(source: str, say: Say, fov: float | None = None) -> LiveSource:
    """Open a folder, a video file, or a stream by its address.

    Raises:
        InputError: for any other source, or one that cannot be opened.
    """
    path = Path(source)
    if path.is_dir():
        return FolderPictures(path, say)
    if "://" in source:
        return StreamPictures(source, say, fov)
    if path.is_file():
        if path.suffix.lower() not in VIDEOS:
            raise InputError(f"{printable(path.name)} is no video that is read; expected {', '.join(VIDEOS)}.")
        return StreamPictures(path, say, fov)
    raise InputError(
        f"There is no {printable(source)}; give a folder that fills, a video, or the address of a stream, such as "
        "rtsp://127.0.0.1:8554/drone."
    )
