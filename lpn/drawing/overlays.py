"""What is drawn into pictures: part boundaries, heatmaps, captions. Arrays in, arrays out."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from functools import lru_cache
from typing import cast

import cv2
import numpy as np
from PIL import Image, ImageDraw, ImageFont

from lpn.core import images
from lpn.core.arrays import Float32Array, FloatingArray, Int64Array, UInt8Array
from lpn.models.partition import Partition

Colour = tuple[int, int, int]

# Okabe and Ito's colours, told apart with any colour vision; n above 8 starts over.
PART_COLOURS: tuple[Colour, ...] = (
    (230, 159, 0),
    (86, 180, 233),
    (0, 178, 128),
    (214, 133, 181),
    (240, 228, 66),
    (90, 140, 255),
    (213, 94, 0),
    (170, 170, 170),
)
TRUE_COLOUR: Colour = (255, 200, 30)
FALSE_COLOUR: Colour = (70, 120, 240)
UNKNOWN_COLOUR: Colour = (130, 130, 130)
FOR: Colour = (255, 140, 26)
AGAINST: Colour = (143, 123, 255)
"""Evidence for and against a pair: orange and violet differ for any colour vision."""
BACKGROUND: Colour = (20, 20, 20)
TEXT: Colour = (236, 236, 236)
DIM: Colour = (160, 160, 160)
READABLE = 4.5
"""Contrast of text with its ground that WCAG 2 asks for (level AA)."""


@dataclass(frozen=True)
class Palette:
    """What captions are drawn with.

    Attributes:
        background: of captions, the stage's own.
        text, dim: of words that matter, and of those that accompany them.
        track: the empty rest of a bar.
        off: of lines that count nothing.
    """

    background: Colour
    text: Colour
    dim: Colour
    track: Colour
    off: Colour

    def ink(self, colour: Colour) -> Colour:
        """A colour for words: the same hue, brought as far from the background as it takes to be read."""
        return _ink(colour, self.background)


DARK = Palette(BACKGROUND, TEXT, DIM, (48, 48, 48), (55, 55, 55))
LIGHT = Palette((255, 255, 255), (28, 28, 28), (96, 96, 96), (222, 222, 222), (205, 205, 205))


def contrast(one: Colour, other: Colour) -> float:
    """WCAG 2's contrast ratio of two colours, 1 .. 21."""
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


def _luminance(colour: Colour) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in (value / 255 for value in colour)]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


@lru_cache(maxsize=64)
def _ink(colour: Colour, background: Colour) -> Colour:
    end = 0 if _luminance(background) > 0.5 else 255
    for percent in range(101):
        mixed = cast(Colour, tuple(round(c + (end - c) * percent / 100) for c in colour))
        if contrast(mixed, background) >= READABLE:
            return mixed
    return (end, end, end)


def part_colour(part: int) -> Colour:
    """The colour of a part wherever it is drawn."""
    return PART_COLOURS[part % len(PART_COLOURS)]


def verdict_colour(true: bool | None) -> Colour:
    """Frame colour of a match: yellow true, blue false (as in the paper), grey unknown."""
    return UNKNOWN_COLOUR if true is None else TRUE_COLOUR if true else FALSE_COLOUR


def css(colour: Colour) -> str:
    """A colour for a style sheet."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def square(picture: UInt8Array, size: int) -> UInt8Array:
    """A picture at display size, as the network sees it: the whole of it, resized to a square."""
    return images.resize(picture, size, size)


def part_masks(partition: Partition, map_size: tuple[int, int], size: tuple[int, int]) -> Int64Array:
    """The part of each pixel of a picture of size (height, width), from the model's own cells: (height, width)."""
    return cast(Int64Array, images.enlarge(partition.labels(*map_size), *size))


def with_heat(
    picture: UInt8Array, activation: Float32Array, masks: Int64Array, part: int | None, opacity: float
) -> UInt8Array:
    """Lay a heatmap over a picture; weak cells stay transparent, so that the picture remains readable.

    With `part`, the scale is that part's own and the rest of the picture is darkened.
    """
    height, width = picture.shape[:2]
    heat = np.clip(cv2.resize(activation, (width, height), interpolation=cv2.INTER_CUBIC), 0.0, 1.0)
    if part is not None:
        inside = masks == part
        low, high = float(heat[inside].min()), float(heat[inside].max())
        heat = np.where(inside, np.clip((heat - low) / max(high - low, 1e-6), 0.0, 1.0), 0.0)
    colours = cv2.cvtColor(
        cv2.applyColorMap((255 * (0.25 + 0.75 * heat)).astype(np.uint8), cv2.COLORMAP_INFERNO), cv2.COLOR_BGR2RGB
    )
    alpha = (opacity * heat * np.sqrt(heat)).astype(np.float32)
    blended = cv2.blendLinear(picture, colours, 1 - alpha, alpha)
    if part is not None:
        shade = np.where(masks == part, 1.0, 1.0 - 0.55 * opacity).astype(np.float32)
        blended = cv2.blendLinear(blended, np.zeros_like(blended), shade, 1 - shade)
    return cast(UInt8Array, blended)


def evidence_alpha(values: FloatingArray, limit: float) -> Float32Array:
    """How thickly a cell of evidence is painted: 0 at zero, 1 at the limit, raised in between to be seen."""
    return cast(Float32Array, np.clip(np.abs(values) / max(limit, 1e-12), 0, 1).astype(np.float32) ** 0.7)


def with_evidence(picture: UInt8Array, cells: FloatingArray, limit: float, opacity: float = 0.85) -> UInt8Array:
    """Paint each cell (h, w) in the colour for or against over a greyed picture, as thickly as it weighs."""
    values = images.enlarge(cells, *picture.shape[:2])
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
    ground = (0.25 * picture + 0.5 * grey).astype(np.float32)
    alpha = (opacity * evidence_alpha(values, limit))[..., None]
    colours = np.where(values[..., None] >= 0, np.array(FOR, np.float32), np.array(AGAINST, np.float32))
    return np.asarray(ground * (1 - alpha) + colours * alpha, np.uint8)


def evidence_limit(*maps: FloatingArray) -> float:
    """Return the end of one colour scale for several maps of evidence."""
    return max(float(np.abs(cells).max()) for cells in maps) or 1e-9


def evidence_scale(width: int, height: int) -> UInt8Array:
    """The scale of `with_evidence` from the limit against, by zero in the middle, to the limit for."""
    values = np.broadcast_to(np.linspace(-1, 1, width), (height, width))
    return with_evidence(np.full((height, width, 3), 40, np.uint8), values, 1.0)


def with_rings(picture: UInt8Array, partition: Partition, map_size: tuple[int, int], thickness: int = 2) -> UInt8Array:
    """Draw the true boundary of each part in its colour, on a dark hairline that shows on bright ground."""
    height, width = picture.shape[:2]
    drawn = np.ascontiguousarray(picture).copy()
    for part, (left, top, right, bottom) in enumerate(partition.boxes(*map_size)):
        inset = thickness // 2 + 1
        first = (round(left * width) + inset, round(top * height) + inset)
        second = (round(right * width) - 1 - inset, round(bottom * height) - 1 - inset)
        cv2.rectangle(drawn, first, second, (0, 0, 0), thickness + 2)
        cv2.rectangle(drawn, first, second, part_colour(part), thickness)
    return drawn


def ring_layer(picture: UInt8Array, masks: Int64Array, part: int) -> UInt8Array:
    """One part of a picture alone, the rest transparent: (height, width, 4) RGBA."""
    alpha = np.where(masks == part, 255, 0).astype(np.uint8)
    return np.dstack([picture, alpha])


def framed(picture: UInt8Array, colour: Colour, width: int) -> UInt8Array:
    """Draw a frame over the border of a picture."""
    drawn = np.ascontiguousarray(picture).copy()
    drawn[:width] = drawn[-width:] = colour
    drawn[:, :width] = drawn[:, -width:] = colour
    return drawn


def outlined(size: int, colour: Colour, width: int, tint: float) -> UInt8Array:
    """A see-through square with a frame, its inside covered with the colour by a share: (size, size, 4) RGBA."""
    drawn = np.empty((size, size, 4), np.uint8)
    drawn[..., :3] = colour
    drawn[..., 3] = 255
    drawn[width:-width, width:-width, 3] = round(255 * tint)
    return drawn


def numbered(picture: UInt8Array, number: int) -> UInt8Array:
    """Write a number on a dark patch in the top left corner of an RGB or RGBA picture."""
    image = Image.fromarray(picture)
    draw = ImageDraw.Draw(image)
    width = draw.textlength(str(number), font=font(30))
    draw.rectangle((5, 5, 13 + width, 38), fill=BACKGROUND)
    draw.text((9, 21), str(number), TEXT, font(30), anchor="lm")
    return np.asarray(image)


@lru_cache(maxsize=16)
def font(size: int) -> ImageFont.FreeTypeFont | ImageFont.ImageFont:
    """The typeface that comes with Pillow, at a pixel size."""
    return ImageFont.load_default(size)


def fitted(draw: ImageDraw.ImageDraw, text: str, size: int, width: float) -> str:
    """A text shortened with an ellipsis to fit a width in pixels."""
    if draw.textlength(text, font=font(size)) <= width:
        return text
    while text and draw.textlength(text + "...", font=font(size)) > width:
        text = text[:-1]
    return text + "..."


def draw_sign(
    draw: ImageDraw.ImageDraw, x: float, y: float, size: float, true: bool | None, palette: Palette = DARK
) -> None:
    """A tick, a cross, or nothing, in a box with its top left corner at (x, y): a second sign beside the colour."""
    colour, width = palette.ink(verdict_colour(true)), max(2, round(size / 6))
    if true:
        draw.line(
            [(x, y + 0.55 * size), (x + 0.4 * size, y + 0.9 * size), (x + size, y + 0.1 * size)], colour, width, "curve"
        )
    elif true is not None:
        draw.line([(x, y), (x + size, y + size)], colour, width)
        draw.line([(x + size, y), (x, y + size)], colour, width)


def draw_squared(draw: ImageDraw.ImageDraw, right: float, middle: float, text: str, size: int, fill: Colour) -> float:
    """Write "d² text" ending at `right`; Pillow's typeface has no superscript two. Returns where it begins."""
    draw.text((right, middle), text, fill, font(size), anchor="rm")
    left = right - draw.textlength(text, font=font(size)) - 0.35 * size
    draw.text((left, middle - 0.3 * size), "2", fill, font(round(0.62 * size)), anchor="rm")
    left -= draw.textlength("2", font=font(round(0.62 * size))) + 1
    draw.text((left, middle), "d", fill, font(size), anchor="rm")
    return left - draw.textlength("d", font=font(size))


def draw_shares(
    draw: ImageDraw.ImageDraw,
    box: tuple[float, float, float, float],
    shares: Float32Array,
    full: float,
    palette: Palette = DARK,
) -> None:
    """A bar divided into the parts' shares of the distance; `full` is the distance that fills the box."""
    left, top, right, bottom = box
    draw.rectangle(box, fill=palette.track)
    at = left
    for part, share in enumerate(shares):
        end = at + max(float(share), 0.0) / max(full, 1e-9) * (right - left)
        if end - at >= 0.5:
            draw.rectangle((at, top, min(end, right), bottom), fill=part_colour(part))
        at = end


def caption(width: int, height: int, palette: Palette = DARK) -> tuple[Image.Image, ImageDraw.ImageDraw]:
    """An empty caption on the stage's background."""
    image = Image.new("RGB", (width, height), palette.background)
    return image, ImageDraw.Draw(image)


def data_uri(picture: UInt8Array, quality: int = 80) -> str:
    """A JPEG of a picture as an address for an html image."""
    encoded = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality])[1]
    return "data:image/jpeg;base64," + base64.b64encode(encoded.tobytes()).decode()
