"""Uploaded pictures: names, formats, and bounds."""

from __future__ import annotations

import io
import subprocess
import sys
from datetime import date
from pathlib import Path

import cv2
import numpy as np
import pytest
from PIL import ExifTags, Image

from explorer import uploads
from lpn.core.errors import PictureError
from tools.fixtures import small_worlds


def picture(size: int = 48, suffix: str = ".png") -> bytes:
    return cv2.imencode(suffix, cv2.resize(small_worlds.place(3), (size, size)))[1].tobytes()


@pytest.mark.parametrize(
    "name", ["../../etc/passwd.png", "C:\\x\\passwd.png", "/passwd.png", "\u202epasswd.png", "a" * 5000]
)
def test_an_uploads_name_is_reduced_to_its_last_part(name: str) -> None:
    taken = uploads.read(name, picture())
    assert not set("/\\\u202e") & set(taken.name)
    assert len(taken.name) <= 80


@pytest.mark.parametrize("suffix", [".png", ".jpg", ".webp"])
def test_a_large_picture_is_shrunk(suffix: str) -> None:
    wide = cv2.imencode(suffix, np.zeros((8, 3200, 3), np.uint8))[1].tobytes()
    assert uploads.read("a", wide).picture.shape == (4, 1600, 3)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (b"", "a.png is empty; choose another file."),
        (b"x", "JPEG, PNG, or WebP"),
        (b"<svg xmlns='http://www.w3.org/2000/svg'/>", "SVG.*JPEG, PNG, or WebP"),
        (b"\0\0\0\x18ftypheic", "HEIC.*JPEG, PNG, or WebP"),
        (picture(suffix=".jpg")[:-200], "cut short or damaged; expected a whole JPEG, PNG, or WebP file"),
        (bytes(uploads.MAX_UPLOAD + 1), "30 MB"),
        (b"\x89PNG\r\n\x1a\n" + bytes(99), "can be read; expected a JPEG, PNG, or WebP file of"),
        (picture(suffix=".jpg") + b"\xff\xda" * 500, "passes"),
        (picture(suffix=".bmp"), "JPEG, PNG, or WebP"),
    ],
)
def test_an_upload_that_is_not_a_picture_within_bounds_is_refused(content: bytes, message: str) -> None:
    with pytest.raises(PictureError, match=message):
        uploads.read("a.png", content)


@pytest.mark.skipif(sys.platform != "linux", reason="measures memory as Linux counts it, in kB")
def test_the_largest_pictures_take_little_memory(tmp_path: Path) -> None:
    """64 megapixels took 486 MB of any kind; now 141 MB as JPEG, and 366 MB as PNG, of which the pixels themselves are 192 MB."""
    Image.new("RGB", (8000, 8000), "green").save(tmp_path / "a.jpg")
    Image.new("1", (8000, 8000)).save(tmp_path / "a.png")
    program = """
import resource, sys
from explorer import uploads
peak = lambda: resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
before = peak()
for path in sys.argv[1:]:
    assert uploads.read(path, open(path, "rb").read()).picture.shape == (1600, 1600, 3)
    print(peak() - before)
"""
    files = [str(tmp_path / name) for name in ("a.jpg", "a.png")]
    jpeg, png = map(int, subprocess.check_output([sys.executable, "-c", program, *files], text=True).split())
    assert jpeg < 200
    assert png < 420


def test_an_upload_tells_the_day_on_which_it_was_taken() -> None:
    stream = io.BytesIO()
    tags = Image.Exif()
    tags.get_ifd(ExifTags.IFD.Exif)[ExifTags.Base.DateTimeOriginal] = "2014:10:19 14:00:00"
    Image.new("RGB", (8, 8)).save(stream, "JPEG", exif=tags)
    assert uploads.read("a.jpg", stream.getvalue()).day == date(2014, 10, 19)
    stream = io.BytesIO()
    Image.new("RGB", (8, 8)).save(stream, "PNG")
    assert uploads.read("a.png", stream.getvalue()).day is None
