"""The colours of the app, the reports, and the figures, each with one meaning, in Python's pictures and in style sheets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import cast

Colour = tuple[int, int, int]

# The table of all colours on dark ground; `tests/lpn/drawing/test_theme.py` measures them. Rings are cool, alternately light and
# dark, so that neighbours differ for any colour vision; numerals state their order. Right and wrong also have a sign and a word.
COLOURS: dict[str, Colour] = {
    "part-0": (242, 247, 255),
    "part-1": (74, 144, 240),
    "part-2": (159, 224, 234),
    "part-3": (106, 102, 216),
    "right": (246, 197, 83),
    "wrong": (255, 123, 95),
    "unknown": (130, 130, 130),
    "for": (244, 104, 184),
    "against": (82, 178, 92),
    "tag": (255, 255, 255),
    "by-hand": (244, 19, 118),
    "retrieval": (253, 219, 193),
    "sequence": (202, 179, 255),
    "registration": (83, 170, 85),
    # A place whose details are contradicted by another answer, or by the map away from the photo's middle.
    "contradicted": (255, 30, 30),
    # The accent marks controls and selections.
    "accent": (44, 199, 184),
}
# Colours that differ on light ground.
LIGHT_COLOURS: dict[str, Colour] = COLOURS | {
    "part-0": (16, 38, 63),
    "part-1": (58, 128, 224),
    "part-2": (11, 70, 86),
    "part-3": (122, 114, 221),
    "right": (138, 102, 0),
    "wrong": (142, 21, 18),
    "for": (176, 40, 146),
    "against": (48, 128, 64),
}
# A fifth part has the first colour again.
N_PART_COLOURS = 4
# Red, green, blue, and opacity over a greyed picture, from weak to strong in even steps of lightness: heat, and evidence against.
HEAT = (
    *((26, 10, 40, 0.0), (104, 24, 112, 0.4), (182, 34, 146, 0.74)),
    *((244, 104, 184, 0.88), (255, 184, 218, 0.95), (255, 246, 251, 1.0)),
)
HEAT_AGAINST = (
    *((8, 30, 14, 0.0), (18, 74, 36, 0.4), (34, 122, 58, 0.74)),
    *((82, 178, 92, 0.88), (166, 226, 160, 0.95), (240, 255, 238, 1.0)),
)
FOR, AGAINST, UNKNOWN_COLOUR = COLOURS["for"], COLOURS["against"], COLOURS["unknown"]
# The contrast of text that WCAG 2 requires (level AA).
MIN_CONTRAST = 4.5
# The contrast of bars and lines, which have names beside them. At 3, bars on white would look alike to people without red cones.
MARK_CONTRAST = 2.0


@dataclass(frozen=True)
class Palette:
    """The colours of a background, text, dimmed text, a bar's track, disabled lines, rows of panels, and the table of colours."""

    background: Colour
    text: Colour
    dim: Colour
    track: Colour
    off: Colour
    row: Colour
    colours: Mapping[str, Colour] = field(hash=False)

    def ink(self, colour: Colour) -> Colour:
        """Return a text colour: the same hue, mixed with black or white until it is readable on a row of a panel."""
        return _mixed(colour, self.row, MIN_CONTRAST)

    def mark(self, colour: Colour) -> Colour:
        """Return the colour of a bar or a line: as for `ink`, with the lower contrast that graphics need."""
        return _mixed(colour, self.background, MARK_CONTRAST)


DARK = Palette((14, 18, 22), (245, 247, 249), (170, 182, 192), (29, 36, 43), (40, 49, 58), (22, 28, 34), COLOURS)
LIGHT = Palette(
    (246, 245, 241), (20, 24, 28), (82, 92, 102), (230, 228, 220), (217, 215, 207), (255, 255, 255), LIGHT_COLOURS
)


def part_colour(part: int, palette: Palette = DARK) -> Colour:
    """Return the colour of a part."""
    return palette.colours[f"part-{part % N_PART_COLOURS}"]


def verdict_colour(true: bool | None, palette: Palette = DARK) -> Colour:
    """Return the frame colour of a match: right, wrong, or unknown (None)."""
    return palette.colours["unknown" if true is None else "right" if true else "wrong"]


def variables(palette: Palette) -> str:
    """Return the table as CSS variables for one palette: `--lpn-NAME` for texts, `--mark-NAME` for bars and lines."""
    inks = [f"--lpn-{name}:{css(palette.ink(colour))}" for name, colour in palette.colours.items()]
    marks = [f"--mark-{name}:{css(palette.mark(colour))}" for name, colour in palette.colours.items()]
    return ";".join(inks + marks)


def mark(name: str) -> str:
    """Return the CSS colour of bars and lines by a name of the table; it follows the page's palette, if there is one."""
    return f"var(--mark-{name},{css(COLOURS[name])})"


def css(colour: Colour) -> str:
    """Format a colour for CSS."""
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
