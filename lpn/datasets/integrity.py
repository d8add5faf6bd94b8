"""Whether picture files are whole, found out before long work that needs them.

Decoding everything first would cost as much as the work itself. A file is passed when its header is a picture's and its
end is where its format says it is: the end-of-image marker of a JPEG, every chunk of a PNG with its checksum, the length
that a WebP states. Any other is decoded. So a file that is cut short, empty, or no picture at all is always found; damage in
the middle of a JPEG or WebP with both ends whole is found by `decode` alone, and only where the decoder notices.
"""

from __future__ import annotations

import io
import os
import zlib
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import BinaryIO

from PIL import Image

from lpn.core import images
from lpn.core.errors import PictureError
from lpn.core.files import printable

_AT_ONCE = 2048
DAMAGED = "is damaged"
"""What is wrong with a picture that has a header and an end and still cannot be decoded."""


def picture_error(path: Path, decode: bool = False) -> str | None:
    """What is wrong with a picture file, such as "is cut short", or None.

    Args:
        decode: decode the whole picture even where its ends are as they should be.
    """
    try:
        with path.open("rb") as file:
            return stream_error(file, decode)
    except OSError as error:
        return f"cannot be read ({error.strerror or error})"


def stream_error(file: BinaryIO, decode: bool = False) -> str | None:
    """The same of an opened file, or of bytes in memory."""
    if (found := images.header_error(file)) is not None:
        return found
    ends = _ends(file)
    if ends and not decode:
        return None
    try:
        file.seek(0)
        data = file.read()
        images.decode_picture(data, "")
        if not ends:
            # OpenCV of some versions fills the rest of a cut file with grey and says nothing.
            with Image.open(io.BytesIO(data)) as picture:
                picture.load()
    except (PictureError, OSError, ValueError, SyntaxError, EOFError):
        return DAMAGED if ends else "is cut short or damaged"
    return None


def picture_errors(
    files: Sequence[Path], decode: bool = False, report: Callable[[int], None] | None = None
) -> dict[Path, str]:
    """What is wrong with picture files, for those with which something is, in their order; see `flaw`.

    Args:
        report: told now and then how many files have been looked at.
    """
    found: dict[Path, str] = {}
    with ThreadPoolExecutor(min(32, 4 * (os.cpu_count() or 1))) as pool:
        for start in range(0, len(files), _AT_ONCE):
            some = files[start : start + _AT_ONCE]
            for position, (file, said) in enumerate(
                zip(some, pool.map(lambda f: picture_error(f, decode), some), strict=True), 1
            ):
                if said is not None:
                    found[file] = said
                if report is not None and (position % 64 == 0 or position == len(some)):
                    report(start + position)
    return found


def check_whole(files: Sequence[Path], said: str, root: Path | None = None) -> None:
    """Stop where a picture is broken, before anything is made of the others.

    Args:
        said: what the files are, such as "pictures".
        root: the folder their names are told from.

    Raises:
        PictureError: naming the first of them, each with what is wrong.
    """
    if broken := picture_errors(files):
        raise PictureError(
            f"{len(broken)} of {len(files)} {said} cannot be described: {list_errors(broken, root)}; mend or remove them."
        )


def list_errors(found: Mapping[Path, str], root: Path | None = None, most: int = 5) -> str:
    """The first of the files that `flaws` found, each with what is wrong, and how many more there are."""
    some = [
        f"{printable(str(file.relative_to(root) if root else file))} {said}"
        for file, said in list(found.items())[:most]
    ]
    return ", ".join(some) + (f", and {len(found) - most} more" if len(found) > most else "")


def _ends(file: BinaryIO) -> bool:
    """Whether a picture file goes on to the end that its format tells."""
    file.seek(0)
    start = file.read(12)
    size = file.seek(0, os.SEEK_END)
    if start.startswith(b"\xff\xd8"):
        file.seek(max(size - 64, 0))
        return file.read().rstrip(b"\0\r\n ").endswith(b"\xff\xd9")
    if start.startswith(images.PNG):
        file.seek(len(images.PNG))
        return _chunks_hold(file, size)
    if start.startswith(b"RIFF") and start[8:] == b"WEBP":
        return size >= int.from_bytes(start[4:8], "little") + 8
    return False


def _chunks_hold(file: BinaryIO, size: int) -> bool:
    while len(head := file.read(8)) == 8:
        length = int.from_bytes(head[:4], "big")
        if length > size:  # for which Python would make room first
            return False
        body = file.read(length)
        if int.from_bytes(file.read(4), "big") != zlib.crc32(body, zlib.crc32(head[4:])):
            return False
        if head[4:] == b"IEND":
            return True
    return False
