"""Pictures from file to network input, in the published order: rotate, resize (bicubic), normalise."""

from __future__ import annotations

import io
import struct
import warnings
from pathlib import Path
from typing import BinaryIO, cast

import cv2
import numpy as np
from PIL import Image, ImageOps, TiffImagePlugin

from lpn.core.arrays import AnyArray, Float32Array, UInt8Array
from lpn.core.errors import PictureError
from lpn.core.files import printable
from lpn.core.resources import usable_cores

# OpenCV's own messages about damaged files would add to ours.
if hasattr(cv2, "setLogLevel"):  # OpenCV 4
    cv2.setLogLevel(0)
else:
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


SUFFIXES = (".jpg", ".jpeg", ".png", ".webp", ".bmp", ".gif", ".tif", ".tiff")
KINDS = "JPEG, PNG, WebP, BMP, GIF, or TIFF"
# Pictures of other kinds, which are named where they are left out.
OTHER_SUFFIXES = (
    ".dng", ".raw", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".orf", ".rw2", ".heic", ".heif", ".avif", ".jp2", ".jxl", ".svg",
    ".psd", ".tga",
)  # fmt: skip
# Drones take pictures of up to 8192 x 6144 pixels.
MAX_PIXELS = 64_000_000
PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
# Pillow reads these where OpenCV does not: GIF before OpenCV 4.11, and TIFF with further compressions.
_BY_PILLOW = (b"GIF8", *_TIFF)
# Pillow raises these on damaged files.
_DAMAGED = (
    OSError, ValueError, SyntaxError, EOFError, RuntimeError, OverflowError, MemoryError, LookupError, TypeError, struct.error
)  # fmt: skip
# The largest of the upper 8 bits, rounded, of numbers of 12: such a picture is black to the eye.
_BLACK = 16
# OpenCV's flags by the factor that they divide width and height by.
_REDUCED = {2: cv2.IMREAD_REDUCED_COLOR_2, 4: cv2.IMREAD_REDUCED_COLOR_4, 8: cv2.IMREAD_REDUCED_COLOR_8}

_HEIC = (b"heic", b"heix", b"hevc", b"heim", b"heis", b"mif1", b"msf1")
# A number for red, green, and blue.
Triple = tuple[float, float, float]
# ImageNet's mean and standard deviation of values 0 .. 1.
MEAN: Triple = (0.485, 0.456, 0.406)
STD: Triple = (0.229, 0.224, 0.225)


def load_picture(path: str | Path) -> UInt8Array:
    """Read a picture file as upright RGB (EXIF orientation applied): (H, W, 3) uint8.

    Raises:
        PictureError: if the file does not exist or is not a readable picture.
    """
    data, name = _read(Path(path))
    return decode_picture(data, name)


def load_without_orientation(path: str | Path) -> UInt8Array:
    """Read a picture file as the released test code does: by Pillow, without its EXIF orientation; (H, W, 3) uint8 RGB.

    Raises:
        PictureError: as `load_picture`.
    """
    data, name = _read(Path(path))
    if (found := header_error(io.BytesIO(data))) is not None:
        raise PictureError(f"{name} {found}; expected a {KINDS} file of at most {MAX_PIXELS // 1_000_000} megapixels.")
    return _first_frame(data, name, KINDS)


def _read(path: Path) -> tuple[bytes, str]:
    """Return a file's bytes, and its name for messages."""
    try:
        return path.read_bytes(), printable(str(path))
    except OSError as error:
        raise PictureError(
            f"The picture {printable(str(path))} cannot be read ({error.strerror or error}); check the path."
        ) from error


def decode_picture(data: bytes, name: str, kinds: str = KINDS, side: int | None = None) -> UInt8Array:
    """Decode the bytes of a picture file, of an animation the first frame; `name` and `kinds` are used in messages only.

    Args:
        side: pixels of the longer side that the caller needs; a picture at least four times as long is decoded at 1/2, 1/4, or
            1/8 of its size, at least twice as long as needed, which saves memory. None decodes every pixel.

    Raises:
        PictureError: if they are not a picture, or one of more than 64 megapixels, or one of few bits in numbers of 16 that would
            be black.
    """
    if (flaw := header_error(io.BytesIO(data))) is not None:
        raise PictureError(f"{name} {flaw}; expected a {kinds} file of at most {MAX_PIXELS // 1_000_000} megapixels.")
    factor = 1 if side is None else _reduction(data, side)
    try:
        decoded = None if _overruns(data) else _decode(data, factor, name)
    except (cv2.error, MemoryError):
        decoded = None
    if decoded is None and data.startswith(_BY_PILLOW):
        return _first_frame(data, name, kinds, upright=True)
    if decoded is None or decoded.ndim != 3 or decoded[..., 0].size > MAX_PIXELS:
        raise PictureError(f"{name} is cut short or damaged; expected a whole {kinds} file, so copy it again.")
    return cast(UInt8Array, cv2.cvtColor(decoded, cv2.COLOR_BGR2RGB, dst=decoded))


def _reduction(data: bytes, side: int) -> int:
    """Return 1, 2, 4, or 8: how many times smaller a picture may be decoded so that twice `side` pixels remain."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", Image.DecompressionBombWarning)
        with Image.open(io.BytesIO(data)) as header:
            longer = max(header.size)
    return max(factor for factor in (1, *_REDUCED) if factor == 1 or longer >= 2 * factor * side)


def _decode(data: bytes, factor: int, name: str) -> UInt8Array | None:
    """Return upright BGR at 1 / factor of the size, None for a damaged file."""
    bits, inverted, planar = _layout(data)
    # Only libjpeg decodes less than every pixel; OpenCV would shrink the others without anti-aliasing.
    scaled = factor > 1 and data.startswith(_JPEG)
    # OpenCV misreads 16 bits of a TIFF whose colours lie in separate planes, or whose 0 is white; 8 bits it reads right.
    whole_numbers = not (data.startswith(_JPEG) or inverted or planar)
    flags = (_REDUCED[factor] if scaled else cv2.IMREAD_COLOR) | (cv2.IMREAD_ANYDEPTH if whole_numbers else 0)
    whole = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    decoded = None if whole is None else _eight_bits(whole)
    if decoded is not None and bits == 16 and not whole_numbers:
        _check_upper_bits(decoded, inverted, name)
    if decoded is None or factor == 1 or scaled:
        return decoded
    height, width = (max(length // factor, 1) for length in decoded.shape[:2])
    return cast(UInt8Array, cv2.resize(decoded, (width, height), interpolation=cv2.INTER_AREA))


def _layout(data: bytes) -> tuple[int, bool, bool]:
    """Return the bits of a number in a TIFF or PNG, 8 for others; whether 0 is white; and whether colours are separate planes."""
    if data.startswith(PNG):
        return data[24], False, False
    if not data.startswith(_TIFF):
        return 8, False, False
    with Image.open(io.BytesIO(data)) as header:
        tags = cast(TiffImagePlugin.TiffImageFile, header).tag_v2
        bits = tags.get(TiffImagePlugin.BITSPERSAMPLE, (1,))
        several = tags.get(TiffImagePlugin.SAMPLESPERPIXEL, 1) > 1
        planar = several and tags.get(TiffImagePlugin.PLANAR_CONFIGURATION, 1) == 2
        return max(bits), tags.get(TiffImagePlugin.PHOTOMETRIC_INTERPRETATION) == 0, planar


def _eight_bits(numbers: AnyArray) -> UInt8Array | None:
    """Return whole numbers of 8 or 16 bits as 8 bits; None for other numbers.

    Sensors keep 10 or 12 bits, and programs 8, in numbers of 16, of which the upper 8 bits would be a black picture. Numbers of
    which all are below 4096 have the range of 12 bits, and those of which all are below 256 that of 8: a bound at which only a
    picture changes its range that is black in the larger one, so that all others of a sensor are equally bright.
    """
    if numbers.dtype != np.uint16:
        return cast(UInt8Array, numbers) if numbers.dtype == np.uint8 else None
    largest = int(numbers.max())
    shift = next((shift for shift in (0, 4) if largest >> shift < 256), 8)
    return (numbers >> shift).astype(np.uint8)


def _check_upper_bits(picture: UInt8Array, inverted: bool, name: str) -> None:
    """Refuse a picture of the upper 8 of 16 bits that is black, or white where 0 is white, for want of the lower ones."""
    if (255 - int(picture.min()) if inverted else int(picture.max())) <= _BLACK:
        raise PictureError(
            f"{name} has numbers of 16 bits and uses the lowest 12 at most, of which nothing would be seen, as only the upper 8 "
            "are read from this kind of file; save it with 8 bits."
        )


def _first_frame(data: bytes, name: str, kinds: str, upright: bool = False) -> UInt8Array:
    """Decode the first frame by Pillow; `upright` applies the EXIF orientation."""
    try:
        with Image.open(io.BytesIO(data)) as animation:
            frame = ImageOps.exif_transpose(animation) if upright else animation
            bits, inverted, _ = _layout(data)
            if frame.mode.startswith("I;16") and (grey := _eight_bits(np.asarray(frame).astype(np.uint16))) is not None:
                return np.repeat((255 - grey if inverted else grey)[..., None], 3, axis=2)
            picture = np.asarray(frame.convert("RGB"))
    except _DAMAGED as error:
        tiff = ", or compressed in a way that is not read here" if data.startswith(_TIFF) else ""
        raise PictureError(
            f"{name} is cut short or damaged{tiff}; expected a whole {kinds} file, so "
            + ("save it with deflate or LZW, or copy it again." if tiff else "copy it again.")
        ) from error
    if bits == 16:
        _check_upper_bits(picture, inverted, name)
    return picture


def header_error(file: BinaryIO) -> str | None:
    """Return why a picture file's header is refused, as the end of a sentence: no picture, or too large; None if it is good.

    Decompression bombs are refused here, before anything is decoded.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(file) as header:
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


def _overruns(data: bytes) -> bool:
    """Return whether a PNG chunk claims to be longer than the file; OpenCV would allocate as much memory, up to 2 GB."""
    position = len(PNG)
    while data.startswith(PNG) and position + 8 <= len(data):
        if data[position + 4 : position + 8] == b"IEND":
            return False
        position += 12 + int.from_bytes(data[position : position + 4], "big")
        if position > len(data):
            return True
    return False


def other_kind(start: bytes) -> str | None:
    """Name a kind of file that is often mistaken for a supported picture, by its first 512 bytes; None for others."""
    start = start.lstrip(b"\xef\xbb\xbf \t\r\n")
    if start[4:8] == b"ftyp" and start[8:12] in _HEIC:
        return "is a HEIC picture, which phones take; save it as JPEG"
    if start.startswith(b"<svg") or (start.startswith((b"<?xml", b"<!--", b"<!DOCTYPE svg")) and b"<svg" in start):
        return "is a drawing (SVG), not a photo; save it as PNG"
    return None


def use_all_cores() -> None:
    """Let OpenCV use every core of this process, by threads that start now.

    OpenCV starts one thread fewer than it is told, so on two cores one core would stay idle. All threads of the process share
    them. If one that yields (`lpn.core.resources.yield_cores`) started them, they would yield to the others for ever.
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
    """Rotate as `rotate` does, to the nearest pixel, as the released test code does (Pillow's default)."""
    if degrees % 360 == 0:
        return picture
    return np.asarray(Image.fromarray(picture).rotate(degrees, Image.Resampling.NEAREST))


def shrink_to(picture: UInt8Array, side: float, box: tuple[float, float, float, float] | None = None) -> UInt8Array:
    """Crop a picture to its box, and shrink it, keeping its aspect ratio, as if the whole picture's longer side became `side`.

    It is never enlarged. Pillow crops (black beyond the edge) and shrinks by Lanczos, as the released transfer does.
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

    Above 1 its middle is cut out, (h, w, 3), so that it is interpolated once only, at the size of the network's input. Below 1
    it is shrunk on its own canvas, bicubic with anti-aliasing, and the border is black, (H, W, 3).
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

    `name` is used in the message only.

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
            f"The box {left}, {top}, {right}, {bottom} marks nothing of {name}, which is {width} x {height} pixels; expected "
            "left, top, right, bottom in pixels within it."
        )
    return np.ascontiguousarray(cut)


def resize(picture: UInt8Array, height: int, width: int) -> UInt8Array:
    """Bicubic resize with anti-aliasing to (height, width, 3), without crop, as the published code does."""
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BICUBIC))


def resize_linear(picture: UInt8Array, height: int, width: int) -> UInt8Array:
    """Bilinear resize without anti-aliasing to (height, width, 3): OpenCV's INTER_LINEAR_EXACT, equal on every machine."""
    if picture.shape[:2] == (height, width):
        return picture
    return cast(UInt8Array, cv2.resize(picture, (width, height), interpolation=cv2.INTER_LINEAR_EXACT))


def resize_bilinear(picture: UInt8Array, height: int, width: int) -> UInt8Array:
    """Bilinear resize with anti-aliasing to (height, width, 3): Pillow's."""
    if picture.shape[:2] == (height, width):
        return picture
    return np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BILINEAR))


def resize_area(picture: UInt8Array, height: int, width: int) -> UInt8Array:
    """Resize to (height, width, 3) by the mean over the area of each pixel: OpenCV's INTER_AREA, bilinear where it enlarges."""
    if picture.shape[:2] == (height, width):
        return picture
    return cast(UInt8Array, cv2.resize(picture, (width, height), interpolation=cv2.INTER_AREA))


def polar(picture: UInt8Array, height: int, width: int) -> UInt8Array:
    """Unroll a north-up square tile around its centre, as SAFA does, into a panorama's shape: (height, width, 3).

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
    """Enlarge cells (rows, columns) to pixels (height, width), each with its cell's value."""
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
