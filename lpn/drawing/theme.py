"""The colours of the app, the reports, and the figures: each stands for one thing, in Python's pictures as in style sheets."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import cast

Colour = tuple[int, int, int]

# The one table of colours. Right and wrong are yellow and blue as in the paper; evidence for and against is orange and violet.
# `tests/lpn/drawing/test_theme.py` measures that all differ, and those that meet on one screen for any colour vision.
COLOURS: dict[str, Colour] = {
    "part-0": (185, 63, 163),
    "part-1": (142, 194, 236),
    "part-2": (208, 248, 94),
    "part-3": (208, 67, 55),
    "part-4": (178, 255, 227),
    "part-5": (147, 173, 25),
    "part-6": (148, 81, 117),
    "part-7": (198, 133, 125),
    "right": (244, 189, 0),
    "wrong": (1, 105, 225),
    "unknown": (130, 130, 130),
    "for": (243, 123, 22),
    "against": (177, 132, 255),
    "tag": (255, 255, 255),
    "by-hand": (244, 19, 118),
    "retrieval": (253, 209, 183),
    "sequence": (202, 179, 255),
    "registration": (83, 170, 85),
    # A place by details that another answer, or the map away from the photo's middle, contradicts.
    "contradicted": (255, 30, 30),
    # The accent marks controls and what is chosen.
    "accent": (44, 199, 184),
}
# A ninth part has the first colour again. Where no parts are shown, categories of a column have these colours.
PART_COLOURS: tuple[Colour, ...] = tuple(COLOURS[f"part-{part}"] for part in range(8))
TRUE_COLOUR, FALSE_COLOUR, UNKNOWN_COLOUR = COLOURS["right"], COLOURS["wrong"], COLOURS["unknown"]
FOR, AGAINST = COLOURS["for"], COLOURS["against"]
BACKGROUND: Colour = (20, 20, 20)
TEXT: Colour = (236, 236, 236)
DIM: Colour = (160, 160, 160)
# The contrast of text that WCAG 2 requires (level AA).
MIN_CONTRAST = 4.5
# The contrast of bars and lines, which have names beside them: at 3, those on white would look alike without red cones.
MARK_CONTRAST = 2.0


@dataclass(frozen=True)
class Palette:
    """The colours of captions: background, text, dimmed text, the track of a bar, disabled lines, and rows of panels."""

    background: Colour
    text: Colour
    dim: Colour
    track: Colour
    off: Colour
    row: Colour

    def ink(self, colour: Colour) -> Colour:
        """Return a text colour: the same hue, mixed with black or white until it is readable on a row of a panel."""
        return _mixed(colour, self.row, MIN_CONTRAST)

    def mark(self, colour: Colour) -> Colour:
        """Return the colour of a bar or a line: as `ink`, with the smaller contrast that graphics need."""
        return _mixed(colour, self.background, MARK_CONTRAST)


DARK = Palette(BACKGROUND, TEXT, DIM, (48, 48, 48), (55, 55, 55), (44, 44, 44))
LIGHT = Palette((255, 255, 255), (28, 28, 28), (96, 96, 96), (222, 222, 222), (205, 205, 205), (238, 238, 238))


def part_colour(part: int) -> Colour:
    """Return the colour of a part."""
    return PART_COLOURS[part % len(PART_COLOURS)]


def verdict_colour(true: bool | None) -> Colour:
    """Return the frame colour of a match: yellow true, blue false (as in the paper), grey unknown."""
    return UNKNOWN_COLOUR if true is None else TRUE_COLOUR if true else FALSE_COLOUR


def placed_name(sign: bool | None, by_details: bool = True) -> str:
    """Return the name in the table of what may be believed of a photo's place: "right", "contradicted", or "unknown".

    Args:
        sign: True if the place is believed.
        by_details: details place the photo; one that they do not, and that is not believed, is a guess or has no place.
    """
    return "right" if sign else "contradicted" if by_details else "unknown"


def placed_colour(sign: bool | None) -> Colour:
    """Return the colour of the ground where details place a photo, see `placed_name`."""
    return COLOURS[placed_name(sign)]


def variables(palette: Palette) -> str:
    """Return the table as CSS variables for one palette: `--lpn-NAME` for texts, `--mark-NAME` for bars and lines."""
    inks = [f"--lpn-{name}:{css(palette.ink(colour))}" for name, colour in COLOURS.items()]
    marks = [f"--mark-{name}:{css(palette.mark(colour))}" for name, colour in COLOURS.items()]
    return ";".join(inks + marks)


def mark(name: str) -> str:
    """Return the CSS colour of bars and lines by a name of the table; it follows the page's palette, if the page has one."""
    return f"var(--mark-{name},{css(COLOURS[name])})"


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


@lru_cache(maxsize=128)
def _mixed(colour: Colour, background: Colour, least: float) -> Colour:
    end = 0 if _luminance(background) > 0.5 else 255
    for percent in range(101):
        mixed = cast(Colour, tuple(round(c + (end - c) * percent / 100) for c in colour))
        if contrast(mixed, background) >= least:
            return mixed
    return (end, end, end)
