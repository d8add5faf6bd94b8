"""The areas of one picture's parts: by a partition of every map, or by the cells of the picture."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Int64Array
from lpn.core.views import View
from lpn.models.contract import Contract
from lpn.models.partition import PartBox, Partition
from lpn.models.trace import Trace

_WHOLE: PartBox = (0.0, 0.0, 1.0, 1.0)
# Weights of a cell are equal if they differ by less than this share.
_ALIKE = 1e-5


@dataclass(frozen=True, eq=False)
class PartAreas:
    """The areas of the parts of one picture.

    Attributes:
        inside: the cells of each part, (n, rows, columns). Areas of a picture's cells may overlap; a part may have none.
        labels: the part with the largest weight in each cell, (rows, columns); -1 for none, or for several of equal weight.
        boxes: the box around each part as (left, top, right, bottom) in fractions of the picture; the whole picture for a part
            without an area.
        straight: whether the boxes are the borders of the parts.
        outside_in: whether part 0 is the outermost.
    """

    inside: BoolArray
    labels: Int64Array
    boxes: list[PartBox]
    straight: bool = False
    outside_in: bool = False

    @property
    def outlines(self) -> list[PartBox]:
        """The boxes, if they are the borders of the parts; else none."""
        return self.boxes if self.straight else []

    @classmethod
    def of(cls, contract: Contract, view: View, map_size: tuple[int, int], trace: Trace | None) -> PartAreas | None:
        """Return the areas of a view's partition, else those of the picture's cells; None without either.

        Args:
            map_size: (h, w) of the feature map.
            trace: of the picture; None if it was not described, or the model gives no cells.
        """
        partition = contract.partition(view)
        if partition is not None:
            return cls.of_partition(partition, map_size)
        return None if trace is None else cls.of_cells(trace.cells[0])

    @classmethod
    def of_partition(cls, partition: Partition, map_size: tuple[int, int]) -> PartAreas:
        """Return the areas of a partition of maps of (h, w) cells."""
        labels = partition.labels(*map_size)
        inside = labels == np.arange(partition.n)[:, None, None]
        return cls(inside, labels, partition.boxes(*map_size), True, partition.outside_in)

    @classmethod
    def of_cells(cls, cells: Float32Array) -> PartAreas:
        """Return the areas of the parts from the weight of each cell in each part, (n, h, w)."""
        weights = np.abs(cells)
        order = np.sort(weights, axis=0)
        second = order[-2] if len(order) > 1 else np.zeros_like(order[0])
        distinct = order[-1] > second * (1 + _ALIKE)
        labels = np.where(distinct, weights.argmax(axis=0), -1).astype(np.int64)
        return cls(weights > 0, labels, [_box(area) for area in weights > 0])

    @property
    def lumps(self) -> list[int]:
        """The parts that have no cell in this picture, such as a class token."""
        return [part for part, area in enumerate(self.inside) if not area.any()]


def _box(area: BoolArray) -> PartBox:
    if not area.any():
        return _WHOLE
    rows, columns = (np.flatnonzero(area.any(axis=axis)) for axis in (1, 0))
    height, width = area.shape
    return columns[0] / width, rows[0] / height, (columns[-1] + 1) / width, (rows[-1] + 1) / height
