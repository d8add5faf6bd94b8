"""The configurations beside the weights of transformers: config.json and preprocessor_config.json; no torch here."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, cast

from lpn.core.errors import ModelFileError
from lpn.core.images import Triple

NETWORK, PICTURES = "config.json", "preprocessor_config.json"
# The largest configuration in bytes.
_MOST_BYTES = 1_000_000


def read_configuration(folder: Path, name: str) -> dict[str, Any]:
    """Read a JSON file of transformers; empty if there is none.

    Raises:
        ModelFileError: if it cannot be read.
    """
    file = folder / name
    if not file.is_file():
        return {}
    try:
        if file.stat().st_size > _MOST_BYTES:
            raise ValueError("it is too large")
        values = json.loads(file.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ModelFileError(f"The {name} beside the model cannot be read; correct or remove it.") from error
    if not isinstance(values, dict):
        raise ModelFileError(
            f"The {name} beside the model is not a configuration of transformers; correct or remove it."
        )
    return values


def stated_size(pictures: Mapping[str, Any]) -> tuple[int, int] | None:
    """Return the size (height, width) of pictures in a preprocessor_config.json; None if it has none."""
    return next((size for key in ("crop_size", "size") if (size := _sides(pictures.get(key))) is not None), None)


def _sides(value: Any) -> tuple[int, int] | None:
    height, width = (value.get("height"), value.get("width")) if isinstance(value, dict) else (value, value)
    sides = (height, width)
    if not all(isinstance(side, int) and not isinstance(side, bool) and side > 0 for side in sides):
        return None
    return cast("tuple[int, int]", sides)


def stated_normalisation(pictures: Mapping[str, Any], default: tuple[Triple, Triple]) -> tuple[Triple, Triple]:
    """Return the mean and the standard deviation of pictures in a preprocessor_config.json, else the default."""
    found = tuple(pictures.get(key) for key in ("image_mean", "image_std"))
    if all(isinstance(one, list) and len(one) == 3 and all(isinstance(v, int | float) for v in one) for one in found):
        mean, std = (tuple(map(float, cast("list[float]", one))) for one in found)
        return cast("tuple[Triple, Triple]", (mean, std))
    return default
