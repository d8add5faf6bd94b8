"""Pictures from file to network input, in the published order: rotate, resize (bicubic), normalise."""

from __future__ import annotations

import io
import struct
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO, cast

import cv2
import numpy as np
from PIL import Image, TiffImagePlugin

from lpn.core.arrays import AnyArray, Float32Array, UInt8Array
from lpn.core.errors import PictureError
from lpn.core.files import printable
from lpn.core.resources import usable_cores

# OpenCV's own messages about damaged videos would add to ours.
if hasattr(cv2, "setLogLevel"):  # OpenCV 4
    cv2.setLogLevel(0)
else:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)

SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".gif", ".tif", ".tiff")
KINDS = "JPEG, PNG, WebP, BMP, GIF, or TIFF"
# Pillow's names of these kinds. For others it may start a program, such as Ghostscript for an EPS file.
_FORMATS = ("JPEG", "PNG", "WEBP", "BMP", "GIF", "TIFF")
# Kinds of pictures that are not read; warnings name them.
OTHER_SUFFIXES = (
    ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".heic", ".heif", ".avif", ".jp2", ".jxl", ".svg",
    ".psd", ".tga",
)  # fmt: skip
# Drones take pictures of up to 8192 x 6144 pixels.
MAX_PIXELS = 64_000_000
PNG = b"\x89PNG\r\n\x1a\n"
# Pillow raises these on damaged files.
_DAMAGED = (
    OSError, ValueError, SyntaxError, EOFError, RuntimeError, OverflowError, MemoryError, LookupError, TypeError, struct.error
)  # fmt: skip
# If a picture of 16 bits uses the lowest 12 at most, its upper 8 bits do not exceed this, and it looks black.
_BLACK = 16
_ORIENTATION = 0x0112
# The transforms of EXIF orientations from 2 on.
_TURNS = (
    *(Image.Transpose.FLIP_LEFT_RIGHT, Image.Transpose.ROTATE_180, Image.Transpose.FLIP_TOP_BOTTOM),
    *(Image.Transpose.TRANSPOSE, Image.Transpose.ROTATE_270, Image.Transpose.TRANSVERSE, Image.Transpose.ROTATE_90),
)

# Ways to resize by OpenCV.
_OPENCV = {"linear": cv2.INTER_LINEAR_EXACT, "area": cv2.INTER_AREA}
_HEIC = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
# Three numbers for red, green, and blue.
Triple = tuple[float, float, float]
# ImageNet's mean and standard deviation of values 0 .. 1.
MEAN: Triple = (0.485, 0.456, 0.406)
STD: Triple = (0.229, 0.224, 0.225)


def load_picture(path: str | Path, upright: bool = True) -> UInt8Array:
    """Read a picture file as RGB, (H, W, 3) uint8.

    Args:
        upright: apply the EXIF orientation, which the released test code does not.

    Raises:
        PictureError: if the file does not exist or is not a readable picture.
    """
    name = printable(str(path))
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        raise PictureError(f"The picture {name} cannot be read ({error.strerror or error}); check the path.") from error
    return decode_picture(data, name, upright=upright)


def decode_picture(
    data: bytes, name: str, kinds: str = KINDS, side: int | None = None, upright: bool = True
) -> UInt8Array:
    """Decode the bytes of a picture file, or an animation's first frame; only messages use `name` and `kinds`.

    Args:
        side: pixels of the longer side that the caller needs. A picture at least four times as long is decoded at 1/2, 1/4, or
            1/8 of its size, and stays at least twice as long as needed. None decodes every pixel.
        upright: see `load_picture`.

    Raises:
        PictureError: if the bytes are no picture, one of more than 64 megapixels, or one of 16 bits that would be black.
    """
    if (flaw := header_error(io.BytesIO(data))) is not None:
        raise PictureError(f"{name} {flaw}; expected a {kinds} file of at most {MAX_PIXELS // 1_000_000} megapixels.")
    try:
        with opened(io.BytesIO(data)) as file:
            tags = getattr(file, "tag_v2", {})
            sixteen = data[24] == 16 if file.format == "PNG" else 16 in tags.get(TiffImagePlugin.BITSPERSAMPLE, ())
            white_is_0 = tags.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == 0
            picture = _decoded(file, side, upright, white_is_0)
    except _DAMAGED as error:
        tiff = data.startswith((b"II", b"MM"))
        raise PictureError(
            f"{name} is cut short or damaged{', or compressed in a way that is not read here' if tiff else ''}; expected a "
            f"whole {kinds} file, so {'save it with deflate or LZW, or copy' if tiff else 'copy'} it again."
        ) from error
    if sixteen and (255 - int(picture.min()) if white_is_0 else int(picture.max())) <= _BLACK:
        raise PictureError(
            f"{name} has numbers of 16 bits and uses the lowest 12 at most; it would be black, as only the upper 8 are read, so "
            "save it with 8 bits."
        )
    return picture


def _decoded(file: Image.Image, side: int | None, upright: bool, white_is_0: bool) -> UInt8Array:
    """Return the pixels of a file, the upper 8 of 16 bits; see `decode_picture`."""
    width, height = file.size
    factor = next((n for n in (8, 4, 2) if side is not None and max(width, height) >= 2 * n * side), 1)
    if factor > 1:  # only JPEG can skip pixels
        file.draft(None, (max(width // factor, 1), max(height // factor, 1)))
    reduced = file.size != (width, height)
    file.load()  # this applies TIFF's orientation
    frame, orientation = file, 1
    if upright:
        with suppress(*_DAMAGED):  # damaged EXIF does not damage the pixels
            orientation = file.getexif().get(_ORIENTATION, 1)
    if orientation in range(2, 9):
        frame = frame.transpose(_TURNS[orientation - 2])
    if frame.mode.startswith("I"):
        grey = (np.asarray(frame) >> 8).astype(np.uint8)
        frame = Image.fromarray(255 - grey if white_is_0 else grey)
    colours = frame.convert("RGB")
    return np.array(colours if reduced or factor == 1 else colours.reduce(factor))


@contextmanager
def opened(file: BinaryIO) -> Iterator[Image.Image]:
    """Open a picture of one of the read kinds by Pillow, without its warnings about metadata; errors are Pillow's."""
    with warnings.catch_warnings(action="ignore"), Image.open(file, formats=_FORMATS) as picture:
        yield picture


def header_error(file: BinaryIO) -> str | None:
    """Return the error of a picture file's header, as the end of a sentence; None if it is good.

    Decompression bombs are refused here, before anything is decoded.
    """
    try:
        with opened(file) as header:
            width, height = header.size
            heights = header.format == "TIFF" and header.mode in ("I", "F")
    except Image.DecompressionBombError:
        return "has far too many pixels to be read"
    except _DAMAGED:
        file.seek(0)
        return other_kind(file.read(512)) or "is not a picture that can be read"
    if width * height > MAX_PIXELS:
        return f"has {width} x {height} pixels, too many to be read"
    if heights:
        return "has numbers with signs or decimals in place of colours, as heights of the ground have, so save it with 8 bits"
    return None


def other_kind(start: bytes) -> str | None:
    """Name a file kind that is often mistaken for a supported picture, by its first 512 bytes; None for others."""
    start = start.lstrip(b"\xef\xbb\xbf \t\r\n")
    if start[4:8] == b"ftyp" and start[8:12] in _HEIC:
        return "is a HEIC picture, which phones take; save it as JPEG"
    if start.startswith(b"<svg") or (start.startswith((b"<?xml", b"<!--", b"<!DOCTYPE svg")) and b"<svg" in start):
        return "is a drawing (SVG), not a photo; save it as PNG"
    return None


def use_all_cores() -> None:
    """Let OpenCV use every core of this process, by threads that start now.

    OpenCV starts one thread fewer than requested, so on two cores one core would stay idle. All threads of the process share
    OpenCV's. If a thread that yields (`lpn.core.resources.yield_cores`) started them, they would yield for ever.
    """
    cores = usable_cores()
    cv2.setNumThreads(cores + 1 if cores > 1 else 1)
    cv2.GaussianBlur(np.zeros((512, 512, 3), np.uint8), (0, 0), 2)


def jpeg(picture: UInt8Array, quality: int) -> bytes:
    """Encode a picture (H, W, 3) as a JPEG file; `quality` is 0 to 100."""
    _, data = cv2.imencode(".jpg", picture[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, quality])
    return data.tobytes()


def rotate(picture: UInt8Array, degrees: float) -> UInt8Array:
    """Rotate a picture counter-clockwise about its centre on its own canvas, corners black, bicubic (Table IV)."""
    if degrees % 360 == 0:
        return picture
    height, width = picture.shape[:2]
    matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, 1.0)
    return cast(UInt8Array, cv2.warpAffine(picture, matrix, (width, height), flags=cv2.INTER_CUBIC))


def rotate_nearest(picture: UInt8Array, degrees: float) -> UInt8Array:
    """Rotate like `rotate`, but to the nearest pixel, as the released test code does (Pillow's default)."""
    if degrees % 360 == 0:
        return picture
    return np.asarray(Image.fromarray(picture).rotate(degrees, Image.Resampling.NEAREST))


def shrink_to(picture: UInt8Array, side: float, box: tuple[float, float, float, float] | None = None) -> UInt8Array:
    """Crop a picture to its box, and shrink it by the factor that makes the whole picture's longer side `side` pixels.

    It is never enlarged, and keeps its aspect ratio. Pillow crops (black beyond the edge) and shrinks by Lanczos, as released.
    """
    shown = Image.fromarray(picture)
    longer = max(shown.size)
    if box is not None:
        left, top, right, bottom = (round(edge) for edge in box)
        shown = shown.crop((left, top, right, bottom))
    limit = side * max(shown.size) / longer
    shown.thumbnail((limit, limit), Image.Resampling.LANCZOS)
    return np.asarray(shown)


def roll(panorama: UInt8Array, degrees: float) -> UInt8Array:
    """Rotate a full-circle panorama counter-clockwise by rolling its columns to the left."""
    return np.roll(panorama, -round(degrees / 360 * panorama.shape[1]), axis=1)


def zoom(picture: UInt8Array, scale: float) -> UInt8Array:
    """Zoom about a picture's centre at its own resolution, in whole pixels: (H, W, 3) uint8.

    Above 1 its middle is cut out, (h, w, 3), so that it is interpolated only once, at the size of the network's input. Below 1 it
    is shrunk on its own canvas, bicubic with anti-aliasing, and the border is black, (H, W, 3).
    """
    height, width = picture.shape[:2]
    if scale == 1:
        return picture
    margin = 1 - 1 / scale if scale > 1 else 1 - scale
    x, y = (min(round(side * margin / 2), (side - 1) // 2) for side in (width, height))
    if scale > 1:
        return cast(UInt8Array, np.ascontiguousarray(picture[y : height - y, x : width - x]))
    canvas = np.zeros_like(picture)
    canvas[y : height - y, x : width - x] = resize(picture, height - 2 * y, width - 2 * x)
    return canvas


def shift(picture: UInt8Array, right: int, down: int = 0) -> UInt8Array:
    """Shift a picture right and down (left and up if negative) on its own canvas; uncovered pixels are black."""
    if right == 0 and down == 0:
        return picture
    height, width = picture.shape[:2]
    moved = np.zeros_like(picture)
    moved[max(down, 0) : height + down, max(right, 0) : width + right] = picture[
        max(-down, 0) : height - down, max(-right, 0) : width - right
    ]
    return moved


def crop(picture: UInt8Array, box: tuple[float, float, float, float] | None, name: str = "the picture") -> UInt8Array:
    """Crop a picture to (left, top, right, bottom), rounded to whole pixels and clipped; None keeps the whole picture.

    Only messages use `name`.

    Raises:
        PictureError: if the crop is empty.
    """
    if box is None:
        return picture
    height, width = picture.shape[:2]
    left, top, right, bottom = (round(side) for side in box)
    cut = picture[max(top, 0) : max(bottom, 0), max(left, 0) : max(right, 0)]
    if cut.size == 0:
        raise PictureError(
            f"The box {left}, {top}, {right}, {bottom} contains no pixel of {name}, which is {width} x {height} pixels; expected "
            "left, top, right, bottom in pixels within it."
        )
    return np.ascontiguousarray(cut)


def resize(picture: UInt8Array, height: int, width: int, how: str = "bicubic") -> UInt8Array:
    """Resize to (height, width, 3) without crop.

    Args:
        how: "bicubic" (as in the published code) or "bilinear", both by Pillow with anti-aliasing; or by OpenCV "linear"
            (without anti-aliasing, equal on every machine) or "area" (the mean over the area of each pixel).
    """
    if picture.shape[:2] == (height, width):
        return picture
    if how in _OPENCV:
        return cast(UInt8Array, cv2.resize(picture, (width, height), interpolation=_OPENCV[how]))
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling[how.upper()]))


def polar(picture: UInt8Array, height: int, width: int) -> UInt8Array:
    """Unroll a north-up square tile around its centre into a panorama's shape, as SAFA does: (height, width, 3).

    Row i, column j samples a tile of side S at S/2 (height - 1 - i) / height pixels from the middle, in the direction
    360 j / width degrees clockwise from south. North is in the middle column, the middle in the bottom row. As released, the
    middle is pixel (S/2, S/2), half a pixel south-east of the true centre.
    """
    side = min(picture.shape[:2])
    radius = side / 2 * (height - 1 - np.arange(height)) / height
    angle = 2 * np.pi * np.arange(width) / width
    columns = picture.shape[1] / 2 - radius[:, None] * np.sin(angle)
    rows = picture.shape[0] / 2 + radius[:, None] * np.cos(angle)
    warped = cv2.remap(
        picture, columns.astype(np.float32), rows.astype(np.float32), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return cast(UInt8Array, warped)


def enlarge(cells: AnyArray, height: int, width: int) -> AnyArray:
    """Enlarge cells (rows, columns) to pixels (height, width) with the values of their cells."""
    rows = np.arange(height) * cells.shape[0] // height
    columns = np.arange(width) * cells.shape[1] // width
    return cast(AnyArray, cells[rows[:, None], columns[None, :]])


def shrink(picture: UInt8Array, side: int) -> UInt8Array:
    """Shrink a picture, keeping its aspect ratio, until no side is longer than `side` pixels."""
    height, width = picture.shape[:2]
    factor = side / max(height, width)
    return picture if factor >= 1 else resize(picture, max(round(height * factor), 1), max(round(width * factor), 1))


def normalise(picture: UInt8Array, mean: Triple = MEAN, std: Triple = STD) -> Float32Array:
    """Normalise by mean and standard deviation of values 0 .. 1, ImageNet's by default: (H, W, 3) uint8 to (3, H, W) float32."""
    planes = np.empty((3, *picture.shape[:2]), np.float32)
    scales, offsets = scale_and_offset(mean, std)
    for channel, plane in enumerate(planes):
        np.multiply(picture[..., channel], scales[channel], out=plane, dtype=np.float32)
        plane += offsets[channel]
    return planes


def scale_and_offset(mean: Triple = MEAN, std: Triple = STD) -> tuple[Float32Array, Float32Array]:
    """Return the scale and offset, (3,) each, that normalise a value 0 .. 255 of each channel: value * scale + offset."""
    means, stds = np.array(mean, np.float32), np.array(std, np.float32)
    return (1.0 / (255.0 * stds)).astype(np.float32), (-means / stds).astype(np.float32)


def prepare(picture: UInt8Array, size: tuple[int, int]) -> Float32Array:
    """Resize to (height, width) and normalise: (3, height, width) float32, ready for a model."""
    return normalise(resize(picture, *size))
