"""A photo's file as evidence: its digest, and the time, place, and camera that it names."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

from lpn.core.files import printable
from lpn.flight.files.photos import Photo, photo_of


@dataclass(frozen=True)
class PhotoFile:
    """A photo's file.

    Attributes:
        photo: the photo by its file.
        size: in bytes.
        digest: SHA-256 of the file in hexadecimal digits.
    """

    photo: Photo
    size: int
    digest: str

    @classmethod
    def of(cls, data: bytes, file: Path) -> Self:
        """Return the file of these bytes, which `lpn.core.images.header_error` accepts; `file` is not read."""
        return cls(photo_of(data, file), len(data), hashlib.sha256(data).hexdigest())

    @property
    def facts(self) -> list[tuple[str, str]]:
        """Names and values for display; a missing time, place, or camera is named as missing."""
        frame = self.photo.frame
        place = "not told"
        if frame.latitude is not None and frame.longitude is not None:
            place = f"{frame.latitude:.6f}, {frame.longitude:.6f} (latitude and longitude of the camera)"
        return [
            ("File", printable(frame.name)),
            ("SHA-256", self.digest),
            ("Size", f"{frame.width} × {frame.height} pixels, {self.size:,} bytes"),
            ("Taken", self._taken),
            ("Camera", printable(self.photo.camera) or "not told"),
            ("GPS tag", place),
        ]

    @property
    def _taken(self) -> str:
        utc, local = self.photo.utc, self.photo.local
        told = [] if local is None else [f"{_written(local)} by the camera's clock"]
        told += [] if utc is None else [f"{_written(utc)} UTC"]
        return ", ".join(told) or "not told"


def _written(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%d %H:%M:%S}"
