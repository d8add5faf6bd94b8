"""A calibration that ships with a data set, so that its pictures need not be described at several zooms.

descriptors/calibrated/calibration.npz     zooms, means, and the ratio of all, of one model
descriptors/calibrated/query_drone ...     stores of the calibrated descriptors, see `lpn.descriptors.store`
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.arrays import DAMAGED_ARRAY, Float32Array
from lpn.core.errors import StoreError
from lpn.core.files import write_atomic
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors import STORES, Manifest, Precision, descriptor_reader, open_store
from lpn.descriptors.partial_store import PartialStore
from lpn.descriptors.store import row_of
from lpn.descriptors.transforms import UNCHANGED
from lpn.descriptors.writer import write_store
from lpn.models.base import Model
from lpn.retrieval.calibration import Calibration, ZoomLevel

FOLDER = Path(STORES) / "calibrated"
_NAME = "calibration.npz"
# The store of the tiles against which the zoom of an uploaded picture is chosen.
_TILES = "gallery_satellite"


def write_calibration(
    model: Model, root: Path, calibration: Calibration, sides: Mapping[str, tuple[View, Sequence[Picture], Precision]]
) -> None:
    """Write a calibration of a model, and calibrated descriptors, into a data set's folder.

    Args:
        sides: by the store's name, such as "query_drone": view, pictures, and precision on disk.
    """
    read, moved = descriptor_reader(root), calibration.applied(model)
    for name, (view, pictures, precision) in sides.items():
        rows = tuple(row_of(picture.path, picture.path.parents[1], picture.box) for picture in pictures)
        manifest = Manifest.for_model(moved, view, UNCHANGED, rows, precision)
        described = calibration.read(model, pictures, view, read)

        def fill(partial: PartialStore, described: Float32Array = described) -> None:
            partial.put(range(len(described)), described)

        write_store(root / FOLDER / name, manifest, fill)
    values: dict[str, Any] = {
        "fingerprint": np.array(model.fingerprint),
        "ratio": np.array(calibration.ratio),
        "tried": np.array(sorted(calibration.tried.items()), np.float64).reshape(-1, 2),
        "levels": np.array([(level.zoom, level.cost) for level in calibration.levels], np.float64).reshape(-1, 2),
        "level_means": np.array([level.mean for level in calibration.levels], np.float32),
    }
    for view, zooms in calibration.zooms.items():
        values[f"{view} files"] = np.array([file.relative_to(root).as_posix() for file in zooms])
        values[f"{view} zooms"] = np.array(list(zooms.values()), np.float64)
        values[f"{view} mean"] = calibration.means[view]
    data = io.BytesIO()
    np.savez_compressed(data, **values)
    write_atomic(root / FOLDER / _NAME, data.getvalue())


def read_calibration(model: Model, root: Path, lists: Mapping[View, Sequence[Sequence[Picture]]]) -> Calibration | None:
    """Return the calibration that ships with a data set; None without one, and if it is of another model or lacks a picture.

    Args:
        lists: for each view, the lists of pictures that it must have.
    """
    try:
        with np.load(root / FOLDER / _NAME, allow_pickle=False) as archive:
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
