"""Figure 7's number: the share of a network's activation that lies in the centre of a picture."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from lpn.core.arrays import BoolArray, FloatingArray
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.models.base import Model
from lpn.models.contract import ForwardPass
from lpn.models.trace import Trace

# Both views of Figure 7, in the order of its columns.
VIEWS: tuple[View, ...] = ("drone", "satellite")
_BATCH = 16


def centre_shares(model: Model, pictures: Sequence[Picture], view: View) -> Iterator[float]:
    """Yield the share of each picture's activation in the centre, see `centre_share`; the mirror is not used.

    Raises:
        InputError: if the model has no cells.
        PictureError: if a picture cannot be read.
    """
    for start in range(0, len(pictures), _BATCH):
        batch = pictures[start : start + _BATCH]
        outputs = model.run(np.stack([model.prepare(picture.load_zoomed(), view) for picture in batch]), view)
        for i in range(len(batch)):
            one = ForwardPass(*(None if values is None else values[i : i + 1] for values in outputs))  # type: ignore[arg-type]
            yield centre_share(Trace.from_pass(model, one, view).activation)


def centre_share(activation: FloatingArray) -> float:
    """Return the share of a channel sum (h, w), see `Trace.activation`, that lies in the centre, from 0 to 1.

    Negative sums count as 0. A map without activation counts as uniform.
    """
    total = np.maximum(activation.astype(np.float64), 0)
    inside = centre_box(*total.shape)
    return float(total[inside].sum() / total.sum()) if total.any() else float(inside.mean())


def centre_box(height: int, width: int) -> BoolArray:
    """Return the mask of cells whose centres lie in the middle half of a map's height and width, (h, w).

    On the 16 x 16 map of a picture of 256 pixels, it is the box of the two inner rings of n = 4, a quarter of the area.
    """
    rows, columns = (abs(2 * np.arange(length) + 1 - length) < length / 2 for length in (height, width))
    return rows[:, None] & columns[None, :]
