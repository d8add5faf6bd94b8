"""A user's own photos in one tab: in memory alone, listed in the rail, and checked against a map in the background."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from itertools import count
from typing import Any

import numpy as np

from explorer import uploads
from explorer.compute.background_jobs import BackgroundJob
from explorer.compute.own_photos import OwnPhotoJobs, likely_windows, mark
from explorer.compute.worker import Worker
from explorer.feeds import Feeds
from explorer.screen.loop import ScreenMessage
from explorer.server.picture_route import EncodedPicture
from lpn.core import images
from lpn.core.errors import InputError, LPNError, PictureError
from lpn.core.files import printable
from lpn.library.analyser import OwnPicture
from lpn.library.answer import Answer

# Maximum of photos of one tab, and of bytes of all tabs.
MOST, MOST_BYTES = 200, 1_000_000_000
# Files of up to this many bytes are stored unchanged, larger ones as JPEG of this quality.
_SMALL, _QUALITY = 1_000_000, 95
# Pixels of the picture in the page, and of the thumbnail.
_SHOWN, _THUMBNAIL = 800, 108
# Maximum of names of skipped files in one sentence.
_NAMED = 3
# Seconds between two looks at a check, and concurrent checks of one tab.
_INTERVAL, _MOST_CHECKS = 0.5, 8
_NO_PIXELS = np.zeros((0, 0, 3), np.uint8)


class OwnPhotoBytes:
    """The bytes of all tabs' photos; thread-safe."""

    def __init__(self, most: int = MOST_BYTES) -> None:
        self._most, self._total, self._lock = most, 0, threading.Lock()

    def add(self, name: str, size: int) -> None:
        """Count a photo; InputError if it goes beyond the limit."""
        with self._lock:
            if self._total + size > self._most:
                raise InputError(
                    f"{name} finds no room: the server holds {self._total / 1e6:,.0f} MB of its visitors' photos, and "
                    f"{self._most / 1e6:,.0f} MB at most. Try later, or forget yours."
                )
            self._total += size

    def remove(self, size: int) -> None:
        """Subtract the bytes of forgotten photos."""
        with self._lock:
            self._total -= size


@dataclass(frozen=True, eq=False)
class _Held:
    """A photo in memory; its pixels are decoded when it is shown."""

    number: int
    picture: OwnPicture
    file: bytes
    thumbnail: bytes


class OwnPhotos:
    """One tab's own photos; thread-safe.

    Args:
        held_bytes: counts the bytes of all tabs.
        send: hands a message to the page.
    """

    def __init__(self, held_bytes: OwnPhotoBytes, send: Callable[[ScreenMessage], None]) -> None:
        self._bytes, self._send, self._lock = held_bytes, send, threading.RLock()
        self._held: dict[str, _Held] = {}
        self._numbers = count()
        self._opened: OwnPicture | None = None
        # The file being received, and the skipped files of its batch.
        self._incoming: tuple[str, int, bytearray] | None = None
        self._left_out: list[tuple[str, str]] = []
        self._taken, self._shows_next = 0, True
        # Folders of pictures and thumbnails by the feeds that serve them.
        self._folders: dict[Feeds, tuple[str, str]] = {}
        self._checks: dict[str, BackgroundJob[Any]] = {}
        self._checked: tuple[OwnPhotoJobs, OwnPicture, Answer] | None = None
        self._marked: ScreenMessage = {}
        self._worker = Worker(self._follow)

    def __contains__(self, key: str) -> bool:
        return key in self._held

    def announce(self, arguments: Mapping[str, Any]) -> None:
        """Expect the bytes of a file: `name`, `size`, and whether it is the `first` of several that are sent one by one."""
        name, size = arguments.get("name"), arguments.get("size")
        if not isinstance(name, str) or not isinstance(size, int) or isinstance(size, bool):
            return
        if arguments.get("first", True):
            self._left_out, self._shows_next = [], True
        self._incoming = name, size, bytearray()
        if not 0 < size <= uploads.MAX_UPLOAD:
            self._incoming = None
            shown = printable(name)[:80]
            said = f"has {size / 1e6:.0f} MB; up to 30 MB are taken." if size else "is empty; choose another file."
            self._leave_out(shown, f"{shown} {said}")

    def receive(self, part: bytes) -> str | None:
        """Take a part of the announced file; return the key of a photo to show, once its file is complete."""
        if self._incoming is None:
            return None
        name, size, content = self._incoming
        content += part
        if len(content) < size:
            return None
        self._incoming = None
        try:
            key = self._hold(name, bytes(content[:size]))
        except LPNError as error:
            self._leave_out(printable(name)[:80], str(error))
            return None
        self._taken += 1
        shows, self._shows_next = self._shows_next, False
        return key if shows else None

    def refuse(self, sentence: str) -> None:
        """Refuse the incoming file with a sentence."""
        if self._incoming is not None:
            name, self._incoming = self._incoming[0], None
            self._leave_out(printable(name)[:80], sentence)

    def find(self, key: str) -> OwnPicture | None:
        """Return a decoded photo; None for an unknown key."""
        with self._lock:
            held = self._held.get(key)
            if held is not None and (self._opened is None or self._opened.key != key):
                self._opened = replace(held.picture, picture=uploads.decode(held.picture.name, held.file))
            return None if held is None else self._opened

    def step(self, key: str, by: int) -> str:
        """Return the key of the photo that is `by` places after another in the list; empty beyond its ends."""
        keys = list(self._held)
        place = keys.index(key) + by
        return keys[place] if 0 <= place < len(keys) else ""

    def address(self, feeds: Feeds, key: str) -> str:
        """Return the address of a photo's picture, relative to the page; empty if it was forgotten."""
        held = self._held.get(key)
        return "" if held is None else f"{self._published(feeds)[0]}{held.number}"

    def message(self, feeds: Feeds) -> ScreenMessage:
        """Return the list for the rail, and the number of files, accepted or skipped."""
        with self._lock:
            photos = [[one.number, key, one.picture.name] for key, one in self._held.items()]
        thumbnails = self._published(feeds)[1] if photos else ""
        return {"yours": {"photos": photos, "thumbnails": thumbnails, "taken": self._taken}}

    def forget(self) -> None:
        """Forget all photos, and end their checks."""
        with self._lock:
            self._bytes.remove(sum(_size(one) for one in self._held.values()))
            self._held, self._opened = {}, None
            for job in self._checks.values():
                job.leave(self)
            self._checks, self._checked = {}, None

    def leave(self) -> None:
        """Forget all: the tab has gone."""
        self._worker.stop()
        self.forget()
        for feeds in list(self._folders):
            feeds.leave(self)

    def check(self, jobs: OwnPhotoJobs | None, picture: OwnPicture | None, analysis: Answer) -> None:
        """Compare the shown photo with a map, and send its mark and each change; checks of other photos go on."""
        with self._lock:
            self._checked = None if jobs is None or picture is None else (jobs, picture, analysis)
            if jobs is not None and self._checked is None and self._checks:
                jobs.show_none(self)
        if self._checked is not None:
            self._worker.wake()

    def _follow(self) -> float | None:
        with self._lock:
            if self._checked is None or self._checked[1].key not in self._held:
                return None
            jobs, picture, analysis = self._checked
            windows = likely_windows(analysis.task, analysis.ranking.order.tolist())
            job = self._checks[picture.key] = jobs.join(picture, windows, self)
            going = [key for key, one in self._checks.items() if one is not job and not one.wait(0)]
            for key in going[: max(len(going) - _MOST_CHECKS, 0)]:
                self._checks.pop(key).leave(self)
        ended = job.wait(0)  # read first, so that the mark is then final
        sign, text, why = mark(job, analysis.task, analysis.matches[0].index)
        marked = {"own": picture.key, "sign": sign, "text": text, "why": why}
        if marked != self._marked:
            self._marked = marked
            self._send({"mark": marked})
        return None if ended else _INTERVAL

    def _hold(self, name: str, content: bytes) -> str:
        """Read a file, and store its photo; LPNError gives the reason of a failure."""
        if len(self._held) >= MOST:
            raise PictureError(f"{printable(name)[:80]} is left out: a tab takes {MOST} photos at most.")
        read = uploads.read(name, content)
        small = len(content) <= _SMALL
        file = content if small else images.jpeg(read.picture, _QUALITY)
        thumbnail = images.jpeg(images.shrink(read.picture, _THUMBNAIL), 80)
        key = secrets.token_hex(4)
        held = _Held(next(self._numbers), replace(read, key=key, picture=_NO_PIXELS), file, thumbnail)
        self._bytes.add(read.name, _size(held))
        with self._lock:
            self._held[key] = held
        return key

    def _leave_out(self, name: str, sentence: str) -> None:
        """Report the skipped files of a batch: a single file by its sentence, several by their names."""
        self._taken += 1
        self._left_out.append((name, sentence))
        if len(self._left_out) > 1:
            names = ", ".join(name for name, _ in self._left_out[:_NAMED])
            more = " and others" if len(self._left_out) > _NAMED else ""
            sentence = f"{len(self._left_out)} files are no photos that can be read: {names}{more}."
        self._send({"error": sentence})

    def _published(self, feeds: Feeds) -> tuple[str, str]:
        with self._lock:
            if feeds not in self._folders:
                self._folders[feeds] = (
                    feeds.address + feeds.publish(self, "own", self._picture),
                    feeds.address + feeds.publish(self, "own thumbnails", self._thumbnail),
                )
            return self._folders[feeds]

    def _numbered(self, number: int) -> _Held | None:
        with self._lock:
            return next((one for one in self._held.values() if one.number == number), None)

    def _picture(self, number: int) -> EncodedPicture | None:
        held = self._numbered(number)
        if held is None:
            return None
        pixels = uploads.decode(held.picture.name, held.file)
        return EncodedPicture(images.jpeg(images.shrink(pixels, _SHOWN), 88), "image/jpeg")

    def _thumbnail(self, number: int) -> EncodedPicture | None:
        held = self._numbered(number)
        return None if held is None else EncodedPicture(held.thumbnail, "image/jpeg")


def _size(held: _Held) -> int:
    return len(held.file) + len(held.thumbnail)
