"""The partition of a feature map into parts: the only source for pooling, explanation, and drawing.

LPN (Wang et al., section III-A) cuts the last feature map into square rings around its centre. Pooling a part is a weighted
sum over cells, `part_i = sum_cells weights[i, cell] * map[cell]`, so its weights describe a partition completely. The labels
of four rings on a map of 8 x 8 cells, and of four columns:

    3 3 3 3 3 3 3 3    0 0 1 1 2 2 3 3
    3 2 2 2 2 2 2 3    0 0 1 1 2 2 3 3
    3 2 1 1 1 1 2 3    0 0 1 1 2 2 3 3
    3 2 1 0 0 1 2 3    0 0 1 1 2 2 3 3
    3 2 1 0 0 1 2 3    0 0 1 1 2 2 3 3
    3 2 1 1 1 1 2 3    0 0 1 1 2 2 3 3
    3 2 2 2 2 2 2 3    0 0 1 1 2 2 3 3
    3 3 3 3 3 3 3 3    0 0 1 1 2 2 3 3
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError

PartShape = Literal["rings", "rows", "columns", "windows", "whole"]
Weighting = Literal["published", "area"]
PartBox = tuple[float, float, float, float]
KINDS: tuple[PartShape, ...] = get_args(PartShape)
WEIGHTINGS: tuple[Weighting, ...] = get_args(Weighting)


@dataclass(frozen=True)
class Partition:
    """A way to cut a feature map into `n` parts.

    Attributes:
        kind: "rings" (square rings around the centre), "rows" (horizontal strips, top to bottom), "columns"
            (vertical strips, left to right), "windows" (vertical strips of equal width at multiples of floor(W / n), which
            overlap if n does not divide the width W; SAFA + LPN), or "whole" (the baseline: one part, n = 1).
        n: number of parts, at least 1.
        weighting: the average over a ring. "published" divides a ring's sum by the area of its whole box, as the released
            code does; "area" divides by the ring's own area, as the paper states. Strips and the whole map are plain means.
        outside_in: number rings from the outermost (part 0) to the centre, as the released CVUSA/CVACT models do
            for the satellite; otherwise part 0 is the centre.
        align_corners: this option of the bilinear resize that enlarges a map too small for n rings (true for the
            University-1652 models, false for CVUSA/CVACT).
    """

    kind: PartShape = "rings"
    n: int = 4
    weighting: Weighting = "published"
    outside_in: bool = False
    align_corners: bool = True

    def __post_init__(self) -> None:
        if self.kind not in KINDS:
            raise InputError(f"The partition kind is {self.kind!r}; expected one of {', '.join(KINDS)}.")
        if self.weighting not in WEIGHTINGS:
            raise InputError(f"The ring weighting is {self.weighting!r}; expected one of {', '.join(WEIGHTINGS)}.")
        if self.n < 1 or (self.kind == "whole" and self.n != 1):
            raise InputError(f"A {self.kind!r} partition cannot have {self.n} parts; use n = 1, or rings or strips.")

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of the grid of `labels`: those of the map, or more where they are too few for n parts."""
        if height < 1 or width < 1:
            raise InputError(f"The feature map is {height} x {width}; expected at least 1 x 1.")
        rings = 2 * self.n if self.kind == "rings" and self.n > 1 else 1
        rows, columns = self.kind == "rows", self.kind in ("columns", "windows")
        return max(height, self.n if rows else rings), max(width, self.n if columns else rings)

    def labels(self, height: int, width: int) -> Int64Array:
        """Return the part of each grid cell: (rows, columns) of `grid`, values 0 .. n-1, each present at least once.

        If strips do not divide the map, adjacent strips share a row or column, labelled by the strip at its middle.
        """
        rows, columns = self.grid(height, width)
        if self.kind in ("rows", "columns", "windows"):
            middles = 2 * np.indices((rows, columns))[0 if self.kind == "rows" else 1] + 1
            return np.asarray(middles * self.n // (2 * (rows if self.kind == "rows" else columns)), np.int64)
        labels = np.empty((rows, columns), np.int64)
        for part in range(self.n) if self.outside_in else reversed(range(self.n)):
            top, bottom, left, right = self.box(part, rows, columns)
            labels[top:bottom, left:right] = part
        return labels

    def weights(self, height: int, width: int) -> Float32Array:
        """Return the weight of each feature map cell in each part: (n, height, width) float32.

        `einsum("nhw,chw->nc", weights, map)` is the pooled map. The weights include the bilinear resize of a small map, so
        they always apply to real cells. With "area" weighting, the weights of each part sum to one.
        """
        rows, columns = self.grid(height, width)
        rings = self.kind in ("rings", "whole")
        labels = self.labels(height, width)
        weights = np.zeros((self.n, rows, columns) if rings else (self.n, height, width))
        for part in range(self.n):
            top, bottom, left, right = self.box(part, *weights.shape[1:])
            inside = weights[part, top:bottom, left:right]
            inside[...] = labels[top:bottom, left:right] == part if rings else True
            weights[part] /= inside.sum() if self.weighting == "area" else inside.size
        if weights.shape[1:] != (height, width):
            to_rows = _bilinear(height, rows, self.align_corners)
            weights = np.einsum("nij,ih,jw->nhw", weights, to_rows, _bilinear(width, columns, self.align_corners))
        return weights.astype(np.float32)

    def boxes(self, height: int, width: int) -> list[PartBox]:
        """Return the outer border of each part as (left, top, right, bottom) in fractions of the picture, 0 .. 1.

        A ring is its box without the next inner ring's box; a strip is its box.
        """
        if self.kind in ("rows", "columns"):
            spans = [(part / self.n, (part + 1) / self.n) for part in range(self.n)]
            return [(0.0, a, 1.0, b) if self.kind == "rows" else (a, 0.0, b, 1.0) for a, b in spans]
        rows, columns = self.grid(height, width)
        boxes = [self.box(part, rows, columns) for part in range(self.n)]
        return [(left / columns, top / rows, right / columns, bottom / rows) for top, bottom, left, right in boxes]

    def box(self, part: int, rows: int, columns: int) -> tuple[int, int, int, int]:
        """Return the cells of a part's box: rows top:bottom and columns left:right."""
        if self.kind == "rows":
            return (part * rows // self.n, -(-(part + 1) * rows // self.n), 0, columns)
        if self.kind == "columns":
            return (0, rows, part * columns // self.n, -(-(part + 1) * columns // self.n))
        if self.kind == "windows":
            step = columns // self.n
            return (0, rows, part * step, columns - (self.n - 1 - part) * step)
        ring = self.n - part if self.outside_in else part + 1
        if ring == self.n:
            return (0, rows, 0, columns)
        down, across = ring * (rows // (2 * self.n)), ring * (columns // (2 * self.n))
        return (rows // 2 - down, rows // 2 + down, columns // 2 - across, columns // 2 + across)


def _bilinear(source: int, target: int, align_corners: bool) -> Float64Array:
    """Return the (target, source) matrix of a bilinear resize along one side."""
    if align_corners:
        position = np.arange(target) * ((source - 1) / max(target - 1, 1))
    else:
        position = np.maximum((np.arange(target) + 0.5) * (source / target) - 0.5, 0.0)
    # A cell's weight falls from 1 at its position to 0 at the positions of its neighbours.
    distance = np.abs(np.minimum(position, source - 1)[:, None] - np.arange(source))
    return np.asarray(np.maximum(1 - distance, 0), np.float64)
