"""A `pytorch_result.mat` as the published test code writes it, on some other machine."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from scipy.io import savemat

import lpn
from lpn.datasets import open_dataset
from lpn.descriptors import cached_descriptors


def flat(descriptors: np.ndarray) -> np.ndarray:
    """(N, n, D) as it is saved: (N, D, n) flattened."""
    return descriptors.transpose(0, 2, 1).reshape(len(descriptors), -1)


def contents(data: Path, model_file: Path) -> dict[str, Any]:
    """Its entries for drone to satellite; the gallery in an order of its own, the names of unequal length."""
    model, dataset, values = lpn.load(model_file), open_dataset(data), {}
    for side, view in (("query", "drone"), ("gallery", "satellite")):
        pictures = dataset.queries(view) if side == "query" else dataset.gallery(view)[::-1]
        values[f"{side}_f"] = flat(cached_descriptors(model, pictures, view))  # type: ignore[arg-type]
        values[f"{side}_label"] = [picture.label for picture in pictures]
        values[f"{side}_path"] = [f"/home/someone/{picture.path.relative_to(data).as_posix()}" for picture in pictures]
    return values


def save_result(file: Path, data: Path, model_file: Path, length: float = 1.0) -> None:
    """Write it, with descriptors of that length."""
    values = contents(data, model_file)
    savemat(file, values | {key: np.float32(length) * values[key] for key in ("query_f", "gallery_f")})
