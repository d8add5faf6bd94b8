"""A picture that somebody sends: what is taken, and how it is read within bounds of bytes, pixels, time, and memory."""

from __future__ import annotations

import threading

from explorer.server.message_filter import MAX_UPLOAD
from lpn.analysis.analyser import OwnPicture
from lpn.core import images
from lpn.core.errors import PictureError
from lpn.core.files import printable

LARGEST_SIDE = 1600
"""Uploads are shrunk to this many pixels a side, so that turning them stays quick."""
LONGEST_NAME = 80
MOST_SCANS = 100
"""Passes a JPEG may be written in; usual are 1 and 10. Each costs the time of the whole picture, and next to no bytes."""

_READING = threading.BoundedSemaphore(2)
"""Of all browsers' pictures, so many are decoded at a time: the largest takes 430 MB meanwhile, and up to 5 s of a processor."""


def read(name: str, content: bytes) -> OwnPicture:
    """The picture of an uploaded file, which is not written anywhere.

    Args:
        name: as the browser says, so anything; what is kept of it is shown only.

    Raises:
        PictureError: when it is no JPEG, PNG, or WebP, or too large a one.
    """
    name = printable(name.replace("\\", "/").rsplit("/", 1)[-1][:LONGEST_NAME]) or "your picture"
    if not content or len(content) > MAX_UPLOAD:
        found = "is empty, or too large" if not content else f"has {len(content) / 1e6:.0f} MB"
        raise PictureError(f"{name} {found}; up to 30 MB are taken, so make it smaller.")
    if not (
        content.startswith((b"\xff\xd8", b"\x89PNG\r\n\x1a\n")) or (content[:4], content[8:12]) == (b"RIFF", b"WEBP")
    ):
        raise PictureError(f"{name} is not a picture that can be read; expected a JPEG, PNG, or WebP file.")
    if content.startswith(b"\xff\xd8") and (scans := content.count(b"\xff\xda")) > MOST_SCANS:
        raise PictureError(f"{name} is written in {scans:,} passes; expected at most {MOST_SCANS}, so save it anew.")
    with _READING:
        return OwnPicture(name, images.shrink(images.decode_picture(content, name), LARGEST_SIDE))
