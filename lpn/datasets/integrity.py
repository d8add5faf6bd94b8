"""Check picture files before long work that needs them.

Decoding every file would cost as much as the work itself. A file passes if its header is valid and its end fits:
the end-of-image marker of a JPEG, the last chunk of a PNG, the stated length of a WebP. Other files are decoded. Truncated
and empty files are always found. Damage inside a picture is found only with `decode`, and only if the decoder notices.
"""

from __future__ import annotations

import io
import os
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path
from typing import BinaryIO

from lpn.core import images
from lpn.core.errors import PictureError
from lpn.core.files import first_few, printable
from lpn.core.views import views_of
from lpn.datasets.base import Dataset, Picture

# Files between two reports of progress.
_BATCH = 256
# The end of a JPEG, and the last chunk of a PNG: its type and its constant checksum.
_ENDS = {b"\xff\xd8": b"\xff\xd9", images.PNG: b"IEND\xaeB`\x82"}
# The error of a picture that has a valid header and end but cannot be decoded.
DAMAGED = "is damaged"


def picture_error(path: Path, decode: bool = False) -> str | None:
    """Return the error of a picture file, such as "is cut short", or None.

    Args:
        decode: decode the picture even if its header and end are valid.
    """
    try:
        with path.open("rb") as file:
            return stream_error(file, decode)
    except OSError as error:
        return f"cannot be read ({error.strerror or error})"


def stream_error(file: BinaryIO, decode: bool = False) -> str | None:
    """Return the error of an open file or of bytes in memory, as `picture_error` does."""
    if (error_text := images.header_error(file)) is not None:
        return error_text
    end_valid = _end_valid(file)
    if end_valid and not decode:
        return None
    try:
        file.seek(0)
        data = file.read()
        images.decode_picture(data, "")
        if not end_valid:  # Pillow decodes a PNG whose last chunks are missing
            with images.opened(io.BytesIO(data)) as picture:
                picture.verify()
    except (PictureError, OSError, SyntaxError):
        return DAMAGED if end_valid else "is cut short or damaged"
    return None


def picture_errors(
    files: Sequence[Path], decode: bool = False, on_progress: Callable[[int], None] | None = None
) -> dict[Path, str]:
    """Return the errors of broken picture files, in their order; see `picture_error`.

    Args:
        on_progress: called now and then with the number of checked files.
    """
    errors: dict[Path, str] = {}
    with ThreadPoolExecutor(min(32, 4 * (os.cpu_count() or 1))) as pool:
        for start in range(0, len(files), _BATCH):
            some = files[start : start + _BATCH]
            found = zip(some, pool.map(partial(picture_error, decode=decode), some), strict=True)
            errors |= {file: error for file, error in found if error is not None}
            if on_progress is not None:
                on_progress(start + len(some))
    return errors


def check_whole(files: Sequence[Path], what: str, root: Path | None = None) -> None:
    """Refuse broken pictures.

    Args:
        what: the plural noun for the files, such as "pictures".
        root: names in the message are relative to this folder.

    Raises:
        PictureError: naming the first broken files with their errors.
    """
    if broken := picture_errors(files):
        raise PictureError(
            f"{len(broken)} of {len(files)} {what} cannot be described: {list_errors(broken, root)}; mend or remove them."
        )


def list_errors(errors: Mapping[Path, str], root: Path | None = None) -> str:
    """Return the first broken files with their errors, and the number of further ones."""
    some = [f"{printable(str(file.relative_to(root) if root else file))} {error}" for file, error in errors.items()]
    return first_few(some, 5)


def _end_valid(file: BinaryIO) -> bool:
    """Return whether a picture file's end fits its format."""
    file.seek(0)
    start = file.read(12)
    size = file.seek(0, os.SEEK_END)
    for begin, end in _ENDS.items():
        if start.startswith(begin):
            file.seek(max(size - 64, 0))
            return file.read().rstrip(b"\0\r\n ").endswith(end)
    if start.startswith(b"RIFF") and start[8:] == b"WEBP":
        return size >= int.from_bytes(start[4:8], "little") + 8
    if start.startswith((b"II*\0", b"MM\0*")):
        return _strips_valid(file, size)
    return False


def _strips_valid(file: BinaryIO, size: int) -> bool:
    """Return whether the strips or tiles of a TIFF's first picture lie within the file."""
    file.seek(0)
    with images.opened(file) as picture:
        tags = dict(getattr(picture, "tag_v2", {}))
    for offsets, counts in ((273, 279), (324, 325)):
        if offsets in tags and len(tags[offsets]) == len(tags.get(counts, ())):
            return all(begin + count <= size for begin, count in zip(tags[offsets], tags[counts], strict=True))
    return False


def check_test_split(dataset: Dataset, tasks: Sequence[str]) -> None:
    """Check a test split before long work, so that the evaluation at its end does not fail.

    Raises:
        InputError: when the data set lacks one of the tasks, but has others.
        PictureError: when a picture of the split is damaged.
        DataError: when there is no task, the test split is incomplete, or a picture lacks a position that its metrics need.
    """
    if missing := [task for task in tasks if task not in dataset.tasks()]:
        raise dataset.lacks_task(missing[0])
    lists = lists_of(dataset, tasks)
    files = list(dict.fromkeys(picture.path for pictures in lists.values() for picture in pictures))
    check_whole(files, f"test pictures of {dataset.root.name}", dataset.root)
    check_positions(dataset, [picture for pictures in lists.values() for picture in pictures])


def check_positions(dataset: Dataset, pictures: Sequence[Picture]) -> str:
    """Return the source of the test pictures' positions, "" without any; DataError if one picture lacks its position."""
    positions = dataset.positions()
    if positions is not None:
        positions.of(pictures)
    if dataset.measured_by is not None:
        dataset.coordinates(pictures)
        return "the lists and the tiles' names" if positions is None else positions.source
    return "" if positions is None else positions.source


def lists_of(dataset: Dataset, tasks: Sequence[str]) -> dict[str, list[Picture]]:
    """Return the lists of pictures of some tasks, by keys such as "query drone" and "gallery satellite"."""
    queries = dict.fromkeys(views_of(task)[0] for task in tasks)
    galleries = dict.fromkeys(views_of(task)[1] for task in tasks)
    return {f"query {view}": dataset.queries(view) for view in queries} | {
        f"gallery {view}": dataset.gallery(view) for view in galleries
    }
