"""Figures 3 and 4 of the paper from a model: the network's maps and descriptors of pictures, and the partitions of maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from lpn.core import images
from lpn.core.arrays import Float32Array, UInt8Array
from lpn.core.views import View
from lpn.drawing.overlays import with_parts
from lpn.drawing.part_areas import PartAreas
from lpn.drawing.plots import encode, pyplot
from lpn.models.base import Model
from lpn.models.partition import Partition

# Side of a picture in pixels, and the remaining light outside a part.
_SIDE, _DIMMED = 256, 0.25
# The partitions of Figure 4: the paper's square rings, and the sequential ones.
_KINDS = {"rings": "square rings", "columns": "sequential: columns", "rows": "sequential: rows"}


class PictureOfView(NamedTuple):
    """A picture as a network describes it.

    Attributes:
        view: its view.
        picture: as it is partitioned, (H, W, 3) uint8.
        activation: channel sum of the last feature map, (h, w), 0 .. 1.
        descriptor: the parts, (n, D).
    """

    view: View
    picture: UInt8Array
    activation: Float32Array
    descriptor: Float32Array


def network(model: Model, pictures: Sequence[PictureOfView]) -> bytes:
    """Draw Figure 3 as a PNG: a row for each view, with the picture, its map, each part, and the descriptor."""
    figure, axes = _panels(len(pictures), 3 + model.n_parts)
    for cells, (view, picture, activation, descriptor) in zip(axes, pictures, strict=True):
        areas = PartAreas.of(model.contract, view, model.map_size(view), None)
        seen = images.shrink(picture, _SIDE)
        height, width = seen.shape[:2]
        heat = images.enlarge(np.round(255 * activation).astype(np.uint8), height, width)
        rows, columns = activation.shape
        _show(cells[0], seen, f"{view}: {model.input_size[0]} x {model.input_size[1]} pixels")
        _show(cells[1], with_parts(np.repeat(heat[..., None], 3, axis=2), areas), f"map: {rows} x {columns} cells")
        for part, (cell, name) in enumerate(zip(cells[2:-1], model.contract.names(view), strict=True)):
            light = np.ones((height, width), np.float32)
            if areas is not None:
                light = np.where(images.enlarge(areas.inside[part], height, width), np.float32(1), np.float32(_DIMMED))
            shown = (seen * light[..., None]).astype(np.uint8)
            _show(cell, shown, f"{name}: mean, head, {descriptor.shape[1]} numbers")
        limit = float(np.abs(descriptor).max()) or 1.0
        cells[-1].imshow(descriptor, cmap="RdBu_r", vmin=-limit, vmax=limit, aspect="auto", interpolation="nearest")
        cells[-1].set_title(f"descriptor: {descriptor.shape[0]} x {descriptor.shape[1]}", fontsize=7)
    return encode(figure, 100)


def partitions(model: Model, pictures: Sequence[PictureOfView]) -> bytes:
    """Draw Figure 4 as a PNG: pictures of each view under square rings and sequential partitions of the model's n parts."""
    figure, axes = _panels(len(pictures), len(_KINDS))
    for cells, (view, picture, *_) in zip(axes, pictures, strict=True):
        own = model.contract.partition(view)
        for cell, (kind, name) in zip(cells, _KINDS.items(), strict=True):
            areas = PartAreas.of_partition(Partition(kind, model.n_parts), model.map_size(view))  # type: ignore[arg-type]
            its = " (this model)" if own is not None and own.kind == kind else ""
            _show(cell, with_parts(images.shrink(picture, _SIDE), areas), f"{view}, {name}{its}")
    return encode(figure, 100)


def _panels(rows: int, columns: int) -> tuple[Any, Any]:
    size = (2.1 * columns, 2.3 * rows)
    figure, axes = pyplot().subplots(rows, columns, figsize=size, layout="constrained", squeeze=False)
    for cell in axes.flat:
        cell.set_xticks([])
        cell.set_yticks([])
    return figure, axes


def _show(cell: Any, picture: UInt8Array, title: str) -> None:
    cell.imshow(picture)
    cell.set_title(title, fontsize=7)
