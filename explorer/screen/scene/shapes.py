"""Geometry and pictures of the scene: arrays in, arrays out; no viser here."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import cast

import numpy as np
from PIL import Image, ImageDraw

from lpn.core import images
from lpn.core.arrays import AnyArray, Float32Array, Float64Array, Int64Array, UInt8Array
from lpn.drawing import captions
from lpn.drawing.theme import Colour
from lpn.models.partition import PartBox

# Colours of the screen's style sheet on dark and on light ground.
PARTS: dict[bool, tuple[Colour, ...]] = {
    True: ((242, 247, 255), (74, 144, 240), (159, 224, 234), (106, 102, 216)),
    False: ((16, 38, 63), (58, 128, 224), (11, 70, 86), (122, 114, 221)),
}
RIGHT: dict[bool, Colour] = {True: (246, 197, 83), False: (138, 102, 0)}
WRONG: dict[bool, Colour] = {True: (255, 123, 95), False: (142, 21, 18)}
INK: dict[bool, Colour] = {True: (245, 247, 249), False: (20, 24, 28)}
SOFT: dict[bool, Colour] = {True: (170, 182, 192), False: (82, 92, 102)}
GROUND: dict[bool, Colour] = {True: (22, 28, 34), False: (246, 245, 241)}
# The page's red, green, blue, and opacity of heat from weak to strong.
_HEAT = {
    True: ["1a0a28", "681870", "b62292", "f468b8", "ffb8da", "fff6fb"],
    False: ["ffffff", "f6c4de", "e26eb2", "b0288e", "68106c", "280434"],
}
_OPACITY = {True: (0, 0.4, 0.74, 0.88, 0.95, 1), False: (0, 0.6, 0.9, 0.95, 0.97, 1)}
_BARE = 0.3
# Pixels of a ribbon's picture for a unit of the scene, and the factor of its supersampling.
_RIBBON, _FINER = 160, 2
# Strokes of the signs on badges, in pixels.
_CHECK, _CROSS = [[(0, 24), (16, 40), (44, 2)]], [[(2, 2), (40, 40)], [(40, 2), (2, 40)]]
# Width of a ribbon for a share of 1, and height of its letters, in units of the scene.
_WIDTH, _LETTERS = 1.5, 0.26


def heated(picture: UInt8Array, activation: Float32Array | None, dark: bool) -> UInt8Array:
    """Return a grey picture under its heat, (H, W, 3); without heat, the picture itself."""
    if activation is None:
        return picture
    height, width = picture.shape[:2]
    grey = picture.mean(axis=2, keepdims=True) * (0.55 if dark else 0.6) + (0 if dark else 90)
    heat = np.asarray(Image.fromarray(activation).resize((width, height), Image.Resampling.BICUBIC))
    at = np.clip((heat - _BARE) / (1 - _BARE), 0, 1) ** 1.15 * 5
    steps = np.array([list(bytes.fromhex(colour)) for colour in _HEAT[dark]], np.float64)
    colours = np.stack([np.interp(at, range(6), steps[:, channel]) for channel in range(3)], axis=-1)
    share = np.interp(at, range(6), _OPACITY[dark])[..., None]
    return cast(UInt8Array, (grey * (1 - share) + colours * share).clip(0, 255).astype(np.uint8))


def rectangle(centre: Sequence[float], half: float, z: float) -> Float32Array:
    """Return the sides of a horizontal square, (4, 2, 3)."""
    corners = np.array(
        [(centre[0] + x * half, centre[1] + y * half, z) for x, y in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    )
    return sides(corners)


def sides(corners: AnyArray) -> Float32Array:
    """Return the sides of a polygon of N corners (N, 3), (N, 2, 3)."""
    return np.stack([corners, np.roll(corners, -1, axis=0)], axis=1).astype(np.float32)


def dashes(start: AnyArray, end: AnyArray, on: float, off: float) -> Float32Array:
    """Return the dashes of a line between two points (3,), (N, 2, 3)."""
    length = float(np.linalg.norm(end - start))
    ahead = (end - start) / max(length, 1e-9)
    begins = np.arange(0, max(length, 1e-9), on + off)
    ends = np.minimum(begins + on, length)
    return np.stack([start + ahead * begins[:, None], start + ahead * ends[:, None]], axis=1).astype(np.float32)


def half_sides(boxes: Sequence[PartBox]) -> list[float] | None:
    """Return the half side of each part if all are squares around the middle of a picture from -1 to 1; else None."""
    for left, top, right, bottom in boxes:
        if max(abs(left + right - 1), abs(top + bottom - 1), abs(left - top)) > 1e-6:
            return None
    return [right - left for left, _, right, _ in boxes] or None


def strips(picture: UInt8Array, half: float, hole: float) -> list[tuple[UInt8Array, float, float, float, float]]:
    """Cut a square ring out of a square picture from -1 to 1, as one square or as four strips around the hole.

    Args:
        half, hole: half sides of the ring and of its hole, which may be 0.

    Returns:
        Pixels, width, height, and the middle's x and y (y down) of each.
    """
    side = len(picture)
    first, inner = round(side * (1 - half) / 2), round(side * (1 - hole) / 2)
    last, outer = side - first, side - inner
    if not hole:
        return [(picture[first:last, first:last], 2 * half, 2 * half, 0, 0)]
    wide, middle = half - hole, (half + hole) / 2
    return [
        (picture[first:inner, first:last], 2 * half, wide, 0, -middle),
        (picture[outer:last, first:last], 2 * half, wide, 0, middle),
        (picture[inner:outer, first:inner], wide, 2 * hole, -middle, 0),
        (picture[inner:outer, outer:last], wide, 2 * hole, middle, 0),
    ]


def ribbon(
    length: float, share: float, rival: float | None, text: str, colour: Colour, soft: Colour
) -> tuple[UInt8Array, float]:
    """Draw a part's share as a ribbon, and the rival's share as dashes: RGBA pixels, and their height in units of the scene."""
    share = max(share, 0.0)  # calibrated shares may be negative
    thin = _WIDTH * share < _LETTERS  # its text stands above it
    height = max(_WIDTH * max(share, rival or 0.0, 0.12) + 0.12, (_WIDTH * share + 2.4 * _LETTERS) * thin)
    unit = _RIBBON * _FINER
    image = Image.new("RGBA", (round(length * unit), round(height * unit)), (*colour, 0))
    draw = ImageDraw.Draw(image)
    middle, across = image.height / 2, image.width
    wide = _WIDTH * share * unit / 2
    draw.rectangle((0, middle - wide, across, middle + wide), fill=(*colour, 235))
    if rival is not None:
        dash, y = across / 30, _WIDTH * rival * unit / 2
        for number in range(0, 30, 2):
            for sign in (-1, 1):
                at = middle + sign * y
                draw.line((number * dash, at, (number + 1) * dash, at), fill=(*soft, 230), width=2 * _FINER)
    ink, y = (soft, middle - wide - 0.6 * _LETTERS * unit) if thin else (_ink_on(colour), middle)
    font = captions.font(round(_LETTERS * unit))
    if thin:  # no dash strikes it through
        draw.rectangle(draw.textbbox((across / 2, y), text, font, anchor="mm"), fill=(*colour, 0))
    draw.text((across / 2, y), text, (*ink, 255), font, anchor="mm")
    small = image.resize((max(image.width // _FINER, 1), max(image.height // _FINER, 1)), Image.Resampling.LANCZOS)
    return np.asarray(small), height


def badge(text: str, colour: Colour, sign: bool | None) -> UInt8Array:
    """Draw a text on a rounded patch of its width, RGBA: with a check for True, a cross for False."""
    font, ink = captions.font(64), (*_ink_on(colour), 255)
    wide = round(ImageDraw.Draw(Image.new("L", (1, 1))).textlength(text, font))
    image = Image.new("RGBA", (max(wide + 48 + (0 if sign is None else 60), 96), 96), (*colour, 0))
    draw = ImageDraw.Draw(image)
    draw.rounded_rectangle((0, 0, image.width - 1, 95), 14, fill=(*colour, 255))
    draw.text((24 if sign is not None else (image.width - wide) // 2, 48), text, ink, font, anchor="lm")
    left = image.width - 66
    if sign is not None:
        for stroke in _CHECK if sign else _CROSS:
            draw.line([(left + x, 27 + y) for x, y in stroke], fill=ink, width=9, joint="curve")
    return np.asarray(image)


def _ink_on(colour: Colour) -> Colour:
    red, green, blue = colour
    return (14, 18, 22) if 0.299 * red + 0.587 * green + 0.114 * blue > 125 else (255, 255, 255)


def square(picture: UInt8Array, side: int) -> UInt8Array:
    """Resize a picture to `side` pixels a side."""
    return images.resize(picture, side, side)


def extruded(
    footprints: Sequence[AnyArray], grounds: Sequence[float], heights: Sequence[float]
) -> tuple[Float32Array, Int64Array]:
    """Return the vertices (V, 3) and the triangles (F, 3) of buildings: walls and flat roofs.

    Args:
        footprints: the outline of each building, (N, 2) in metres.
        grounds, heights: the ground under each building, and the building's height above it, in metres.
    """
    vertices: list[AnyArray] = []
    faces: list[AnyArray] = []
    begin = 0
    for given, ground, height in zip(footprints, grounds, heights, strict=True):
        outline = given if _area(given) > 0 else given[::-1]
        n = len(outline)
        low, high = np.c_[outline, np.full(n, ground - 1)], np.c_[outline, np.full(n, ground + height)]
        one, next_one = np.arange(n), (np.arange(n) + 1) % n
        walls = [np.c_[one, next_one, next_one + n], np.c_[one, next_one + n, one + n]]
        faces.append(np.concatenate([*walls, np.array(_ears(outline)) + n]) + begin)
        vertices.append(np.r_[low, high])
        begin += 2 * n
    return np.concatenate(vertices).astype(np.float32), np.concatenate(faces).astype(np.int64)


def _area(outline: AnyArray) -> float:
    x, y = outline[:, 0], outline[:, 1]
    return float(np.sum(x * np.roll(y, -1) - np.roll(x, -1) * y))


def _ears(outline: AnyArray) -> list[tuple[int, int, int]]:
    """Triangulate a counter-clockwise polygon by cutting off its ears."""

    def turn(a: AnyArray, b: AnyArray, c: AnyArray) -> float:
        return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))

    left, triangles = list(range(len(outline))), []
    while len(left) > 3:
        for at in range(len(left)):
            ear = left[at - 1], left[at], left[(at + 1) % len(left)]
            a, b, c = (outline[corner] for corner in ear)
            others = (outline[corner] for corner in left if corner not in ear)
            if turn(a, b, c) > 0 and not any(
                turn(a, b, p) >= 0 <= turn(b, c, p) and turn(c, a, p) >= 0 for p in others
            ):
                break
        else:
            at, ear = 0, (left[-1], left[0], left[1])  # a polygon that crosses itself has no ear
        triangles.append(ear)
        left.pop(at)
    return [*triangles, (left[0], left[1], left[2])]


def camera_axes(heading: float, tilt: float) -> Float64Array:
    """Return the right, down, and forward directions of a camera as columns, (3, 3): x is east, y is north, z is up.

    Args:
        heading, tilt: degrees clockwise from north, and above the horizon.
    """
    turn, up = math.radians(heading), math.radians(tilt)
    forward = np.array([math.cos(up) * math.sin(turn), math.cos(up) * math.cos(turn), math.sin(up)])
    right = np.array([math.cos(turn), -math.sin(turn), 0.0])
    return np.stack([right, np.cross(forward, right), forward], axis=1)


def fitting(
    points: AnyArray, axes: Float64Array, fov: float, aspect: float, room: float
) -> tuple[Float64Array, Float64Array]:
    """Return the position of a camera that sees all points, (3,), and its target, (3,).

    Args:
        points: (N, 3).
        axes: the camera's axes, see `camera_axes`.
        fov: the vertical field of view in radians.
        room: share of the picture that the points may fill.
    """
    seen = points @ axes
    middle = (seen.min(axis=0) + seen.max(axis=0)) / 2
    off = seen - middle
    limits = np.array([math.tan(fov / 2) * aspect, math.tan(fov / 2)]) * room
    away = float((np.abs(off[:, :2]) / limits - off[:, 2:]).max())
    target = axes @ middle
    return target - axes[:, 2] * away, target


def ray(axes: Float64Array, fov: float, aspect: float, x: float, y: float) -> Float64Array:
    """Return the direction from a camera through a point of its picture, (3,); x and y are shares from the upper left corner."""
    across = math.tan(fov / 2)
    return np.asarray(axes @ np.array([(2 * x - 1) * across * aspect, (2 * y - 1) * across, 1.0]), np.float64)


def on_level(origin: AnyArray, direction: AnyArray, z: float) -> Float64Array | None:
    """Return the point at which a ray meets a level plane, (3,); None if it does not."""
    if abs(direction[2]) < 1e-9 or (away := (z - origin[2]) / direction[2]) <= 0:
        return None
    return np.asarray(origin + away * direction, np.float64)
