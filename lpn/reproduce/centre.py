"""Figure 7's number: the share of a network's activation that lies in the centre of a picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import cast

import numpy as np

from lpn.core import images
from lpn.core.arrays import BoolArray, Float64Array, FloatingArray
from lpn.core.views import View
from lpn.datasets import Dataset, Picture
from lpn.models.base import Model
from lpn.reproduce.paper_values import Values

# Both views of Figure 7, in the order of its columns.
VIEWS: tuple[View, ...] = ("drone", "satellite")
_BATCH = 16


def centre_shares(model: Model, dataset: Dataset) -> Values:
    """Return the mean share of activation in the centre over all test pictures, in percent: of drone and of satellite.

    Every picture of the gallery of the test split counts once; its mirror is not used.
    """
    return tuple(100 * float(np.mean(list(_shares(model, dataset.gallery(view), view)))) for view in VIEWS)


def centre_share(features: FloatingArray) -> Float64Array:
    """Return the share of the channel sum of feature maps (B, C, h, w) that lies in the centre, (B,), from 0 to 1.

    Negative sums count as 0. A map without any activation has the share of an even one.
    """
    total = np.maximum(features.sum(axis=1, dtype=np.float64), 0)
    inside = centre_box(*total.shape[1:])
    sums = total.sum(axis=(1, 2))
    shares = np.where(sums > 0, (total * inside).sum(axis=(1, 2)) / np.where(sums > 0, sums, 1), inside.mean())
    return cast(Float64Array, shares)


def centre_box(height: int, width: int) -> BoolArray:
    """Return the cells of a map whose centres lie in the middle half of its height and of its width, (h, w).

    On the 16 x 16 map of a picture of 256 pixels it is the box of the two inner rings of n = 4, a quarter of the area.
    """
    rows, columns = (abs(2 * np.arange(length) + 1 - length) < length / 2 for length in (height, width))
    return rows[:, None] & columns[None, :]


def _shares(model: Model, pictures: Sequence[Picture], view: View) -> Iterator[float]:
    for start in range(0, len(pictures), _BATCH):
        batch = pictures[start : start + _BATCH]
        prepared = [model.prepare(images.load_picture(picture.path), view) for picture in batch]
        features = model.run(np.stack(prepared), view).features
        assert features is not None
        yield from centre_share(features)
