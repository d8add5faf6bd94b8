"""The partition of a feature map into parts: the only source for pooling, explanation, and drawing.

LPN (Wang et al., section III-A) cuts the last feature map into square rings around its centre. Pooling a part is a weighted
sum over cells, `part_i = sum_cells weights[i, cell] * map[cell]`, so its weights describe a partition completely.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError

PartShape = Literal["rings", "rows", "columns", "windows", "whole"]
Weighting = Literal["published", "area"]
PartBox = tuple[float, float, float, float]

KINDS: tuple[PartShape, ...] = ("rings", "rows", "columns", "windows", "whole")
WEIGHTINGS: tuple[Weighting, ...] = ("published", "area")
_ENDS = {"rows": ("top", "bottom"), "columns": ("left", "right"), "windows": ("left", "right")}


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
        align_corners: of the bilinear resize of a map too small for n rings (true for the University-1652 models,
            false for CVUSA/CVACT).
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
            raise InputError(
                f"A {self.kind!r} partition cannot have {self.n} parts; use n = 1 or more rings or strips."
            )

    def grid(self, height: int, width: int) -> tuple[int, int]:
        """Return rows and columns of the grid of `labels`.

        It is the feature map, or its resized version if it has too few cells: rings need 2n along each side (the released
        code resizes to 2n x 2n), strips need n along theirs. Only sides that are too short are resized.
        """
        if height < 1 or width < 1:
            raise InputError(f"The feature map is {height} x {width}; expected at least 1 x 1.")
        if self.kind == "rings" and self.n > 1:
            return max(height, 2 * self.n), max(width, 2 * self.n)
        if self.kind == "rows":
            return max(height, self.n), width
        if self.kind in ("columns", "windows"):
            return height, max(width, self.n)
        return height, width

    def labels(self, height: int, width: int) -> Int64Array:
        """Return the part of each grid cell: (rows, columns) of `grid`, values 0 .. n-1, each present at least once.

        If strips do not divide the map, adjacent strips share a row or column (adaptive pooling). Its label is the strip that
        holds its middle; `weights` include both.
        """
        rows, columns = self.grid(height, width)
        if self.kind in ("rows", "columns", "windows"):
            length = rows if self.kind == "rows" else columns
            strip = (2 * np.arange(length) + 1) * self.n // (2 * length)
            return np.broadcast_to(strip[:, None] if self.kind == "rows" else strip[None, :], (rows, columns)).copy()
        labels = np.full((rows, columns), self.n - 1, dtype=np.int64)
        for ring in range(self.n - 2, -1, -1):
            top, bottom, left, right = self._ring_box(rows, columns, ring)
            labels[top:bottom, left:right] = ring
        return self.n - 1 - labels if self.outside_in else labels

    def weights(self, height: int, width: int) -> Float32Array:
        """Return the weight of each feature map cell in each part: (n, height, width) float32.

        `einsum("nhw,chw->nc", weights, map)` is the pooled map. The weights include the bilinear resize of a small map, so
        they always apply to real cells. With "area" weighting each part sums to one.
        """
        if self.kind in ("rows", "columns", "windows"):
            return self._strip_weights(height, width)
        rows, columns = self.grid(height, width)
        labels = self.labels(height, width)
        weights = np.zeros((self.n, rows, columns))
        for part in range(self.n):
            ring = self.n - 1 - part if self.outside_in else part
            if self.weighting == "area":
                area = int(np.count_nonzero(labels == part))
            else:
                top, bottom, left, right = self._ring_box(rows, columns, ring)
                area = (bottom - top) * (right - left)
            weights[part] = (labels == part) / area
        if (rows, columns) != (height, width):
            to_rows = _bilinear(height, rows, self.align_corners)
            to_columns = _bilinear(width, columns, self.align_corners)
            weights = np.einsum("nij,ih,jw->nhw", weights, to_rows, to_columns)
        return weights.astype(np.float32)

    def boxes(self, height: int, width: int) -> list[PartBox]:
        """Return the outer border of each part as (left, top, right, bottom) in fractions of the picture, 0 .. 1.

        A ring is its box without the next inner ring's box; a strip is its box.
        """
        rows, columns = self.grid(height, width)
        boxes: list[PartBox] = []
        for part in range(self.n):
            if self.kind == "rows":
                boxes.append((0.0, part / self.n, 1.0, (part + 1) / self.n))
            elif self.kind == "columns":
                boxes.append((part / self.n, 0.0, (part + 1) / self.n, 1.0))
            elif self.kind == "windows":
                boxes.append((self.strip(part, columns)[0] / columns, 0.0, self.strip(part, columns)[1] / columns, 1.0))
            else:
                ring = self.n - 1 - part if self.outside_in else part
                top, bottom, left, right = self._ring_box(rows, columns, ring)
                boxes.append((left / columns, top / rows, right / columns, bottom / rows))
        return boxes

    def names(self) -> list[str]:
        """Return a short name for each part: "1 centre", "2", "3", "4 outer"."""
        if self.n == 1:
            return ["1 whole"]
        first, last = _ENDS.get(self.kind, ("centre", "outer"))
        if self.outside_in:
            first, last = last, first
        return [f"1 {first}", *(str(i + 1) for i in range(1, self.n - 1)), f"{self.n} {last}"]

    def _ring_box(self, rows: int, columns: int, ring: int) -> tuple[int, int, int, int]:
        """Return rows top:bottom and columns left:right of a ring's box (0 = centre); the last box is the whole grid."""
        if ring == self.n - 1:
            return 0, rows, 0, columns
        down, across = (ring + 1) * (rows // (2 * self.n)), (ring + 1) * (columns // (2 * self.n))
        return rows // 2 - down, rows // 2 + down, columns // 2 - across, columns // 2 + across

    def strip(self, part: int, length: int) -> tuple[int, int]:
        """Return begin and end (exclusive) of strip `part` along `length` rows or columns.

        Rows and columns follow adaptive pooling to n: from floor(i L / n) to ceil((i + 1) L / n). Windows begin at
        i floor(L / n) and are L - (n - 1) floor(L / n) wide.
        """
        if self.kind == "windows":
            step = length // self.n
            return part * step, part * step + length - (self.n - 1) * step
        return part * length // self.n, -(-(part + 1) * length // self.n)

    def _strip_weights(self, height: int, width: int) -> Float32Array:
        weights = np.zeros((self.n, height, width), dtype=np.float32)
        for part in range(self.n):
            begin, end = self.strip(part, height if self.kind == "rows" else width)
            covered = weights[part, begin:end, :] if self.kind == "rows" else weights[part, :, begin:end]
            covered[...] = 1.0 / covered.size
        return weights


def _bilinear(source: int, target: int, align_corners: bool) -> Float64Array:
    """Return the (target, source) matrix of a bilinear resize along one side."""
    if align_corners:
        position = np.arange(target) * ((source - 1) / max(target - 1, 1))
    else:
        position = np.maximum((np.arange(target) + 0.5) * (source / target) - 0.5, 0.0)
    lower = np.minimum(position.astype(int), source - 1)
    upper = np.minimum(lower + 1, source - 1)
    fraction = position - lower
    matrix = np.zeros((target, source))
    rows = np.arange(target)
    np.add.at(matrix, (rows, lower), 1.0 - fraction)
    np.add.at(matrix, (rows, upper), fraction)
    return matrix
