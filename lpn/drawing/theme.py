"""Colours of parts, verdicts, and evidence, and the palettes of the dark and the light theme."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

Colour = tuple[int, int, int]

# Okabe and Ito's colours, distinguishable with any colour vision. A ninth part has the first colour again.
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
# Evidence for and against a pair: orange and violet differ for any colour vision.
FOR: Colour = (255, 140, 26)
AGAINST: Colour = (143, 123, 255)
BACKGROUND: Colour = (20, 20, 20)
TEXT: Colour = (236, 236, 236)
DIM: Colour = (160, 160, 160)
# The contrast of text that WCAG 2 requires (level AA).
MIN_CONTRAST = 4.5


@dataclass(frozen=True)
class Palette:
    """The colours of captions: background, text, dimmed text, the track of a bar, and disabled lines."""

    background: Colour
    text: Colour
    dim: Colour
    track: Colour
    off: Colour

    def ink(self, colour: Colour) -> Colour:
        """Return a text colour: the same hue, mixed with black or white until it is readable on the background."""
        return _ink(colour, self.background)


DARK = Palette(BACKGROUND, TEXT, DIM, (48, 48, 48), (55, 55, 55))
LIGHT = Palette((255, 255, 255), (28, 28, 28), (96, 96, 96), (222, 222, 222), (205, 205, 205))


def part_colour(part: int) -> Colour:
    """Return the colour of a part."""
    return PART_COLOURS[part % len(PART_COLOURS)]


def verdict_colour(true: bool | None) -> Colour:
    """Return the frame colour of a match: yellow true, blue false (as in the paper), grey unknown."""
    return UNKNOWN_COLOUR if true is None else TRUE_COLOUR if true else FALSE_COLOUR


def css(colour: Colour) -> str:
    """Return a colour as CSS has it."""
    return "#{:02x}{:02x}{:02x}".format(*colour)


def contrast(one: Colour, other: Colour) -> float:
    """Return WCAG 2's contrast ratio of two colours, 1 to 21."""
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
        if contrast(mixed, background) >= MIN_CONTRAST:
            return mixed
    return (end, end, end)
