"""The parts' activation of a pair as heatmaps side by side, each with a colour bar, for the app and for reports."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from jinja2 import Template
from markupsafe import Markup

from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.templates import environment
from lpn.drawing import charts, overlays
from lpn.drawing.words import plain, say
from lpn.explain.part_activation import value_ranges

# From this ratio of width to height on, a picture is a panorama, and fewer fit in a row.
_PANORAMA = 2.0
_IN_A_ROW, _PANORAMAS_IN_A_ROW = 5, 3


def note(n_parts: int) -> str:
    """Say what the heatmaps of a model of so many parts show."""
    if plain():
        each = f", {say('part')} by {say('part')} (the paper’s Figure 7)" if n_parts > 1 else ""
        return (
            f"The brighter a cell, the more strongly the model reacts there{each}. The numbers have no unit, and each "
            "picture has its own: Why tells what speaks for two pictures together."
        )
    cells = "in the cells of a part (the paper’s Figure 7)" if n_parts > 1 else "in each cell"
    return (
        f"Activation is the channel sum of the last feature map {cells}. It has no unit, and it belongs to one picture; "
        "evidence belongs to the pair."
    )


# Shares of a picture's light outside of the part whose heatmap lies over it, and through the heatmap.
_OUTSIDE, _THROUGH = 0.35, 0.45
# Three labels of up to this many characters fit below a colour bar.
_SHORT = 5


@dataclass(frozen=True, eq=False)
class PictureActivation:
    """One picture of a pair.

    Attributes:
        name: "query", "tile", or "true tile", in the words that are spoken.
        maps: the activation of each part, (n, h, w), see `lpn.explain.part_activation`.
        pixels: the picture with its parts, (H, W, 3) uint8.
    """

    name: str
    maps: Float32Array
    pixels: UInt8Array


@dataclass(frozen=True)
class ColourBar:
    """A colour bar: its picture, and the place of each label in percent of its width."""

    picture: str
    ticks: list[tuple[float, str]]


@dataclass(frozen=True)
class _Panel:
    """One heatmap; without a colour bar, the picture itself."""

    side: str
    picture: str
    bar: ColourBar | None = None
    attributes: Markup | str = ""


# Part, name, colour, and heatmaps; the first column has the pictures themselves.
_Column = tuple[int | None, str, str, list[_Panel]]


def draw(
    pictures: Sequence[PictureActivation],
    names: Sequence[str],
    shared: bool = False,
    attributes: Callable[[PictureActivation, int], Markup] | None = None,
    over: bool = False,
) -> Markup:
    """Draw the pictures of a pair, and the heatmap of each of their n parts that has cells, with its colour bar.

    Args:
        names: of the parts.
        shared: a part has one scale for all pictures; otherwise each heatmap has its own.
        attributes: HTML attributes of the heatmap of a picture's part; none by default.
        over: the heatmaps lie over their pictures, which show through.
    """
    ranges = value_ranges([picture.maps for picture in pictures], shared)
    columns: list[_Column] = [
        (None, "", "", [_Panel(picture.name, overlays.data_uri(picture.pixels, 75)) for picture in pictures])
    ]
    for part, name in enumerate(names):
        if all(np.isnan(picture.maps[part]).all() for picture in pictures):
            continue
        panels = [
            _Panel(
                picture.name,
                _heatmap(picture, overlays.heat_cells(picture.maps[part], low, high), over),
                colour_bar(low, high),
                attributes(picture, part) if attributes else "",
            )
            for picture, (low, high) in zip(pictures, ranges[:, part].tolist(), strict=True)
        ]
        columns.append(
            (part, f"{say('part')} {name}" if len(names) > 1 else "the whole picture", charts.part_colour(part), panels)
        )
    height, width = pictures[0].pixels.shape[:2]
    most = _PANORAMAS_IN_A_ROW if width >= _PANORAMA * height else _IN_A_ROW
    rows = math.ceil(len(columns) / most)
    return Markup(
        _template().render(
            columns=columns,
            in_a_row=math.ceil(len(columns) / rows),
            aspect=f"{width} / {height}",
            parts=say("part", 2),
            activation=say("activation"),
        )
    )


def _heatmap(picture: PictureActivation, cells: UInt8Array, over: bool) -> str:
    """Encode the colours of a part's cells, (h, w, 4), by themselves, or laid over the darkened picture."""
    if not over:
        return overlays.png_data_uri(cells)
    laid = images.enlarge(cells, *picture.pixels.shape[:2]).astype(np.float32)
    share = laid[..., 3:] / 255
    mixed = picture.pixels * (1 - share) * _OUTSIDE + share * (
        _THROUGH * picture.pixels + (1 - _THROUGH) * laid[..., :3]
    )
    return overlays.data_uri(mixed.astype(np.uint8), 80)


def colour_bar(low: float, high: float) -> ColourBar:
    """Return the colours from `low` to `high` with labels at both ends, and in the middle if they are short.

    Labels have up to six digits. If both ends have the same label, there is one in the middle.
    """
    gradient = overlays.png_data_uri(overlays.heat_cells(np.linspace(low, high, 256)[None], low, high))
    return ColourBar(gradient, scale_labels(low, high))


def scale_labels(low: float, high: float) -> list[tuple[float, str]]:
    """Return the labels of a scale and their places in percent, see `colour_bar`."""
    largest = max(abs(low), abs(high))
    notation = ".6g"
    if high > low:
        decimals = 1 - math.floor(math.log10((high - low) / 2))
        most = 5 - math.floor(math.log10(largest))
        notation = f".{max(0, min(decimals, most))}f" if 1e-3 <= largest < 1e6 else ".3g"
    labels = [_label(value, notation) for value in (low, (low + high) / 2, high)]
    if labels[0] == labels[2]:
        return [(50.0, labels[0])]
    ticks = [(0.0, labels[0]), (50.0, labels[1]), (100.0, labels[2])]
    return ticks if max(map(len, labels)) <= _SHORT else ticks[::2]


def _label(value: float, notation: str) -> str:
    """Format a number with proper minus signs, such as −1.5e−7; zero has no sign."""
    text = re.sub(r"e([+-])0*", lambda exponent: "e" + exponent[1].strip("+"), format(value, notation))
    return text.lstrip("-") if float(text) == 0 else text.replace("-", "−")


@cache
def _template() -> Template:
    return environment("lpn.drawing").get_template("heatmaps.html.j2")
