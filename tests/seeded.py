"""Weights and pictures that depend on a name or seed alone, so that any implementation can be asked the same question."""

from __future__ import annotations

import json
import math
import re
import zlib
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

DATA = Path(__file__).parent / "data"


def state_dict(case: str) -> dict[str, Tensor]:
    """A published checkpoint's entries with the values the parity data were made with."""
    return entries(json.loads((DATA / f"keys_{case}.json").read_text()))


def entries(shapes: dict[str, list[int]]) -> dict[str, Tensor]:
    """Entries of these names and shapes; a name's values do not depend on the branch it belongs to."""
    return {name: torch.from_numpy(np.asarray(_values(name, shape))) for name, shape in shapes.items()}


def pictures(seed: int, batch: int, height: int, width: int) -> np.ndarray:
    """A normalised batch (batch, 3, height, width)."""
    return np.random.default_rng(seed).standard_normal((batch, 3, height, width)).astype(np.float32)


def _values(name: str, shape: list[int]) -> np.ndarray:
    if name.endswith("num_batches_tracked"):
        return np.zeros(shape, np.int64)
    shared = re.sub(r"^model_[123]\.", "", name)
    noise = np.random.default_rng(zlib.crc32(shared.encode())).standard_normal(tuple(shape))
    if len(shape) > 1:
        scaled = noise * math.sqrt(2 / math.prod(shape[1:]))
    elif name.endswith("running_var"):
        scaled = 1 + 0.1 * np.abs(noise)
    else:
        scaled = (1 if name.endswith("weight") else 0) + 0.1 * noise
    return scaled.astype(np.float32)
