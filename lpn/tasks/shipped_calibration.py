"""A calibration that ships with a data set, so that its pictures need not be described at several zooms.

descriptors/calibrated/calibration.npz     zooms, means, and the ratio of all, of one model
descriptors/calibrated/query_drone ...     stores of the calibrated descriptors, see `lpn.descriptors.store`
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from lpn.core.arrays import DAMAGED_ARRAY
from lpn.core.errors import StoreError
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors import STORES, open_store
from lpn.models.base import Model
from lpn.retrieval.calibration import Calibration, ZoomLevel

FOLDER = Path(STORES) / "calibrated"
NAME = "calibration.npz"
# The store of the tiles against which the zoom of an uploaded picture is chosen.
_TILES = "gallery_satellite"


def read_calibration(model: Model, root: Path, lists: Mapping[View, Sequence[Sequence[Picture]]]) -> Calibration | None:
    """Return the calibration that ships with a data set; None without one, and if it is of another model or lacks a picture.

    Args:
        lists: for each view, the lists of pictures that it must have.
    """
    try:
        with np.load(root / FOLDER / NAME, allow_pickle=False) as archive:
            values = dict(archive)
        if str(values["fingerprint"]) != model.fingerprint:
            return None
        zooms = {
            view: dict(
                zip(
                    (root / name for name in values[f"{view} files"].tolist()),
                    values[f"{view} zooms"].tolist(),
                    strict=True,
                )
            )
            for view in lists
        }
        levels = [
            ZoomLevel(zoom, cost, mean)
            for (zoom, cost), mean in zip(values["levels"].tolist(), values["level_means"], strict=True)
        ]
        means = {view: values[f"{view} mean"] for view in lists}
        tiles = open_store(root / FOLDER / _TILES).float32
    except (*DAMAGED_ARRAY, KeyError, StoreError):
        return None
    if any(picture.path not in zooms[view] for view, of_view in lists.items() for some in of_view for picture in some):
        return None
    tried = {float(ratio): float(value) for ratio, value in values["tried"].tolist()}
    return Calibration(means, zooms, tried, float(values["ratio"]), levels, tiles)
