"""Reads uploaded pictures within limits of bytes, pixels, time, and memory."""

from __future__ import annotations

import threading
from datetime import UTC, datetime
from pathlib import Path

from explorer.compute.own_photos import CameraPicture
from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.errors import PictureError
from lpn.core.files import printable
from lpn.flight.files.photos import photo_of

# Bytes of a photo.
MAX_UPLOAD = 30_000_000
# Kinds of files that visitors may send: fewer decoders than for a data set's own pictures.
KINDS = "JPEG, PNG, or WebP"
# Uploads are shrunk to this many pixels a side, so that rotating them stays quick. Those of 6,400 pixels a side and more are
# decoded at a fraction of their size; smaller ones, such as photos of 20 megapixels, at full size.
MAX_SIDE = 1600
_MAX_NAME = 80
# Maximum number of scans of a progressive JPEG; 1 and 10 are usual. A scan needs few bytes but the time of a whole picture.
_MAX_SCANS = 100

# Limits the memory of decoding for all browsers: the largest JPEG takes 140 MB, the largest PNG or
# WebP 370 MB and up to 5 s of a core.
_READING = threading.BoundedSemaphore(2)


def read(name: str, content: bytes) -> CameraPicture:
    """Decode an uploaded file; nothing is written to disk.

    Args:
        name: the untrusted file name; its last part is shown in the page.

    Raises:
        PictureError: when the file is not a JPEG, PNG, or WebP, or is too large.
    """
    name = printable(name.replace("\\", "/").rsplit("/", 1)[-1][:_MAX_NAME]) or "your picture"
    if not content:
        raise PictureError(f"{name} is empty; choose another file.")
    if len(content) > MAX_UPLOAD:
        raise PictureError(f"{name} has {len(content) / 1e6:.0f} MB; up to 30 MB are taken, so make it smaller.")
    if not (
        content.startswith((b"\xff\xd8", b"\x89PNG\r\n\x1a\n")) or (content[:4], content[8:12]) == (b"RIFF", b"WEBP")
    ):
        flaw = images.other_kind(content[:512]) or "is not a picture that can be read"
        raise PictureError(f"{name} {flaw}; expected a {KINDS} file.")
    if content.startswith(b"\xff\xd8") and (scans := content.count(b"\xff\xda")) > _MAX_SCANS:
        raise PictureError(f"{name} is written in {scans:,} passes; expected at most {_MAX_SCANS}, so save it anew.")
    picture = decode(name, content)
    with _READING:
        photo = photo_of(content, Path(name))
        taken = photo.local if photo.utc is None else photo.utc
        day = None if taken is None else datetime.fromtimestamp(taken, UTC).date()
        frame = photo.frame
        place = None if frame.latitude is None or frame.longitude is None else (frame.latitude, frame.longitude)
        return CameraPicture(name, picture, place, day=day, facts=tuple(photo.facts(content)), frame=frame)


def decode(name: str, content: bytes) -> UInt8Array:
    """Return the pixels of a picture's file, (H, W, 3), at most `MAX_SIDE` a side; PictureError if it is unreadable."""
    with _READING:
        return images.shrink(images.decode_picture(content, name, KINDS, MAX_SIDE), MAX_SIDE)
