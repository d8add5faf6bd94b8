"""The figure of a paper: a query and its tiles, the heat of each part, and the parts' shares of d², as PNG, SVG, or PDF.

It is as wide as one column of a page or as two, with letters legible at that size. Matplotlib draws it, so that SVG and PDF
have real lines and texts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core import images
from lpn.core.arrays import FloatingArray, UInt8Array
from lpn.core.errors import InputError
from lpn.core.files import check_ending, write_atomic
from lpn.core.requirements import missing_package
from lpn.drawing import overlays, theme
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.plots import encode, pyplot
from lpn.drawing.theme import LIGHT, Colour
from lpn.explain import Evidence
from lpn.models.partition import PartBox

# Dots per inch of a PNG.
DPI = 300
# Widths in mm of a column and of a page, and the least width with a map for each part.
COLUMN, PAGE, EACH_PART = 88.0, 180.0, 140.0
_WIDTHS = (60.0, 400.0)
_POINTS = 7
# Left, top, width, height in mm.
_Box = tuple[float, float, float, float]
_MM = 1 / 25.4
# In mm: the strip of titles at the left, the strip of names at the top, the scale below, gaps, bars, and the largest picture.
_LEFT, _TOP, _BELOW, _GAP, _BARS, _LARGEST = 8.0, 4.5, 7.0, 2.0, 31.0, 42.0
# In mm: the line above bars, a letter of the names before them, the maximum for a name, a number, and the distance from a
# picture to its frame.
_HEAD, _LETTER, _NAME, _NUMBER, _FRAME = 3.2, 1.3, 16.0, 9.5, 0.5


@dataclass(frozen=True, eq=False)
class FigureRow:
    """A picture of the figure.

    Attributes:
        title: its two lines.
        picture: as the model partitions it, (H, W, 3) uint8.
        areas: of its parts.
        heat: the share of each cell in each part, (n, h, w).
        heat_of: the quantity that the cells share, such as "the score".
        shares: of the parts, (n,); None draws no bars.
        shares_of: the quantity that the parts share; it stands above the bars with their sum.
        frame: its colour; None for no frame.
    """

    title: tuple[str, str]
    picture: UInt8Array
    areas: PartAreas | None
    heat: FloatingArray
    heat_of: str = "the score"
    shares: FloatingArray | None = None
    shares_of: str = "d²"
    frame: Colour | None = None

    @classmethod
    def of_tile(
        cls, title: tuple[str, str], picture: UInt8Array, areas: PartAreas | None, evidence: Evidence, true: bool | None
    ) -> FigureRow:
        """Return the row of a tile: its cells' shares of the score, and its parts' shares of d²."""
        heat = evidence.tile.cells * evidence.weights[:, None, None]
        return cls(title, picture, areas, heat, shares=evidence.contributions, frame=theme.verdict_colour(true, LIGHT))

    @classmethod
    def of_query(
        cls, title: tuple[str, str], picture: UInt8Array, areas: PartAreas | None, evidence: Sequence[Evidence]
    ) -> FigureRow:
        """Return the row of a query: its cells' shares of the score of one tile, or of the first tile's lead over a second.

        Args:
            evidence: for one tile or for two.
        """
        heats = [pair.query.cells * pair.weights[:, None, None] for pair in evidence]
        if len(evidence) == 1:
            return cls(title, picture, areas, heats[0])
        lead = evidence[1].contributions - evidence[0].contributions
        return cls(title, picture, areas, 2 * (heats[0] - heats[1]), "the lead", lead, "lead in d²")


@dataclass(frozen=True, eq=False)
class PaperFigure:
    """A figure of rows, one below the other; a notebook shows it.

    Attributes:
        rows: the query, then its tiles.
        names: of the parts.
        noun: the noun for a part, such as "ring".
        width: in mm.
    """

    rows: Sequence[FigureRow]
    names: Sequence[str]
    noun: str
    width: float = PAGE

    def __post_init__(self) -> None:
        if not _WIDTHS[0] <= self.width <= _WIDTHS[1]:
            raise InputError(
                f"The figure is {self.width:g} mm wide; expected {_WIDTHS[0]:g} to {_WIDTHS[1]:g} mm, such as {COLUMN:g} for a "
                f"column and {PAGE:g} for a page."
            )

    def save(self, path: str | Path) -> None:
        """Write the figure, folders included: a PNG of 300 dpi, an SVG, or a PDF, by the ending of the name.

        Raises:
            InputError: if the name has another ending.
            MissingPackageError: if Matplotlib is not installed.
            OutputError: if the file cannot be written.
        """
        path = Path(path)
        check_ending(path, ".png", ".svg", ".pdf")
        write_atomic(path, self.encode(path.suffix[1:].lower()))

    def encode(self, kind: str) -> bytes:
        """Return the file's bytes; `kind` is "png", "svg", or "pdf". MissingPackageError if Matplotlib is not installed."""
        try:
            plots = pyplot()
        except ModuleNotFoundError as error:
            raise missing_package(error) from error
        # Texts of an SVG stay texts, and a PDF embeds the typeface of the user's settings, if there are any.
        files = {"svg.fonttype": "none", "svg.hashsalt": "lpn", "pdf.fonttype": 42, "savefig.bbox": "standard"}
        with plots.rc_context(files | {"font.size": _POINTS, "text.usetex": False}):
            return encode(_Drawing(plots, self).figure, DPI, kind)

    def _repr_png_(self) -> bytes:
        return self.encode("png")


class _Drawing:
    """Draws a figure with Matplotlib; lengths are in mm, from its upper left corner."""

    def __init__(self, plots: Any, given: PaperFigure) -> None:
        self._given, n = given, len(given.names)
        self._each = n > 1 and given.width >= EACH_PART
        maps = n if self._each else 1
        side = min((given.width - _LEFT - _BARS - _GAP * (maps + 3)) / (maps + 1), _LARGEST)
        heights = [side * row.picture.shape[0] / row.picture.shape[1] for row in given.rows]
        self._height = _TOP + sum(heights) + _GAP * len(heights) + _BELOW
        self.figure = plots.figure(figsize=(given.width * _MM, self._height * _MM))
        lefts = [_LEFT + (side + _GAP) * column for column in range(maps + 1)]
        bars = lefts[-1] + side + 2.5 * _GAP
        of_all = f"heat of the {given.noun}s" if n > 1 else "heat"
        heads = [f"{given.noun} {name}" for name in given.names] if self._each else [of_all]
        inks = [LIGHT.ink(theme.part_colour(part, LIGHT)) if self._each else LIGHT.text for part in range(maps)]
        for left, head, ink in zip(lefts, ["picture", *heads], [LIGHT.text, *inks], strict=True):
            self._write(left + side / 2, _TOP / 2, head, color=theme.css(ink))
        heats = [row.heat if self._each else row.heat.sum(axis=0, keepdims=True) for row in given.rows]
        limits: dict[str, float] = {}
        for row, maps_of in zip(given.rows, heats, strict=True):
            limits[row.heat_of] = max(limits.get(row.heat_of, 0.0), overlays.evidence_limit(*maps_of))
        most = max((float(row.shares.max()) for row in given.rows[1:] if row.shares is not None), default=1.0)
        top = _TOP
        for i, (row, height) in enumerate(zip(given.rows, heights, strict=True)):
            self._write(_LEFT * 0.28, top + height / 2, row.title[0], rotation=90, weight="bold")
            self._write(_LEFT * 0.70, top + height / 2, row.title[1], rotation=90)
            picture = images.shrink(row.picture, round(max(side, height) * _MM * DPI))
            axes = self._panel(picture, (lefts[0], top, side, height), row.areas, range(n))
            if row.frame is not None:
                x, y = _FRAME / side, _FRAME / height
                _draw_border(axes, (-x, -y, 1 + x, 1 + y), row.frame, 1.6)
            for column, cells in enumerate(heats[i]):
                parts = [column] if self._each else range(n)
                drawn = overlays.with_evidence(picture, cells, limits[row.heat_of])
                self._panel(drawn, (lefts[column + 1], top, side, height), row.areas, parts)
            if row.shares is not None:
                self._bars(row, most if i else None, (bars, top, given.width - bars - _GAP, height))
            top += height + _GAP
        self._scale(limits, top + _BELOW / 2)

    def _axes(self, box: _Box) -> Any:
        left, top, width, height = box
        x, y = self._given.width, self._height
        return self.figure.add_axes((left / x, 1 - (top + height) / y, width / x, height / y))

    def _write(self, x: float, y: float, text: str, **style: Any) -> None:
        style = {"ha": "center", "va": "center", "color": theme.css(LIGHT.text), "parse_math": False} | style
        self.figure.text(x / self._given.width, 1 - y / self._height, text, **style)

    def _panel(self, picture: UInt8Array, box: _Box, areas: PartAreas | None = None, parts: Sequence[int] = ()) -> Any:
        """Draw a picture with the outlines of some parts in their colours, on a white line that is visible on dark ground."""
        if areas is not None and not areas.straight and len(parts) == len(self._given.names):
            picture = overlays.with_parts(picture, areas)
        axes = self._axes(box)
        axes.imshow(picture, interpolation="none", aspect="auto", extent=(0, 1, 1, 0))
        axes.set(xticks=[], yticks=[])
        axes.autoscale(False)
        axes.spines[:].set_visible(False)
        for part in parts:
            for border in [] if areas is None else areas.outlines[part : part + 1]:
                _draw_border(axes, border, (255, 255, 255), 1.5)
                _draw_border(axes, border, theme.part_colour(part, LIGHT), 0.8)
        return axes

    def _bars(self, row: FigureRow, most: float | None, box: _Box) -> None:
        """Draw the shares of the parts between their names and numbers; without `most`, signed and on a separate scale."""
        values = np.asarray(row.shares, np.float64)
        left, top, width, height = box
        names = min(_LETTER * max(map(len, self._given.names)) + 1.0, _NAME)
        self._write(left + width / 2, top + _HEAD / 2, f"{row.shares_of} {_number(float(values.sum()), most is None)}")
        axes = self._axes((left + names, top + _HEAD, width - names - _NUMBER, height - _HEAD))
        low, high = min(float(values.min()), 0.0), most or max(float(values.max()), 1e-9)
        axes.set(xticks=[], yticks=[], xlim=(low, high), ylim=(len(values) - 0.5, -0.5))
        axes.spines[["top", "right", "bottom"]].set_visible(False)
        axes.spines["left"].set(position=("data", 0.0), linewidth=0.6)
        colours = [theme.css(theme.part_colour(part, LIGHT)) for part in range(len(values))]
        axes.barh(range(len(values)), values, 0.62, color=colours)
        line = (height - _HEAD) / len(values)
        for part, (name, value) in enumerate(zip(self._given.names, values.tolist(), strict=True)):
            y = top + _HEAD + (part + 0.5) * line
            self._write(left + names - 1.0, y, name, ha="right")
            self._write(left + width, y, _number(value, most is None), ha="right")

    def _scale(self, limits: dict[str, float], y: float) -> None:
        """Draw the heat's colours, with the meaning of their ends beside them, or below in a narrow figure."""
        left, width, line = _LEFT + 12.0, 20.0, _BELOW / 4
        share = f"a cell's share: {', '.join(f'±{limit:.4f} of {what}' for what, limit in limits.items())}"
        above = y - line if not self._each else y
        self._write(left - 1.5, above, "against", ha="right")
        self._panel(overlays.evidence_scale(240, 16), (left, above - 1.1, width, 2.2))
        self._write(left + width + 1.5, above, f"for;  {share}" if self._each else "for", ha="left")
        if not self._each:
            self._write(self._given.width / 2, y + line, share)


def _draw_border(axes: Any, border: PartBox, colour: Colour, points: float) -> None:
    left, top, right, bottom = border
    x, y = (left, right, right, left, left), (top, top, bottom, bottom, top)
    axes.plot(x, y, color=theme.css(colour), linewidth=points, clip_on=False, solid_joinstyle="miter")


def _number(value: float, signed: bool) -> str:
    rounded = round(value, 3) + 0.0  # avoids a negative zero
    return (f"{rounded:+.3f}" if signed else f"{rounded:.3f}").replace("-", "−")
