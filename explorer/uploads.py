"""Reads uploaded pictures within limits of bytes, pixels, time, and memory."""

from __future__ import annotations

import threading

from explorer.server.message_filter import MAX_UPLOAD
from lpn.analysis.analyser import OwnPicture
from lpn.core import images
from lpn.core.errors import PictureError
from lpn.core.files import printable

# Uploads are shrunk to this many pixels a side, so that rotating them stays quick.
_MAX_SIDE = 1600
_MAX_NAME = 80
# Scans of a progressive JPEG; usual are 1 and 10. A scan needs few bytes but the time of a whole picture.
_MAX_SCANS = 100

# Limits the memory of decoding for all browsers: the largest picture takes 430 MB and up to 5 s of a core.
_READING = threading.BoundedSemaphore(2)


def read(name: str, content: bytes) -> OwnPicture:
    """Decode an uploaded file; nothing is written to disk.

    Args:
        name: the untrusted file name; its last part is shown in the page.

    Raises:
        PictureError: when the file is not a JPEG, PNG, or WebP, or is too large.
    """
    name = printable(name.replace("\\", "/").rsplit("/", 1)[-1][:_MAX_NAME]) or "your picture"
    if not content or len(content) > MAX_UPLOAD:
        problem = f"has {len(content) / 1e6:.0f} MB" if content else "is empty, or too large"
        raise PictureError(f"{name} {problem}; up to 30 MB are taken, so make it smaller.")
    if not (
        content.startswith((b"\xff\xd8", b"\x89PNG\r\n\x1a\n")) or (content[:4], content[8:12]) == (b"RIFF", b"WEBP")
    ):
        raise PictureError(f"{name} is not a picture that can be read; expected a JPEG, PNG, or WebP file.")
    if content.startswith(b"\xff\xd8") and (scans := content.count(b"\xff\xda")) > _MAX_SCANS:
        raise PictureError(f"{name} is written in {scans:,} passes; expected at most {_MAX_SCANS}, so save it anew.")
    with _READING:
        return OwnPicture(name, images.shrink(images.decode_picture(content, name), _MAX_SIDE))
