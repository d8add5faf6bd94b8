"""Configurations beside a model: opts.yaml, and the JSON of transformers; no torch here."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, cast

import msgspec
import yaml

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.core.images import Triple
from lpn.models.contract import MAX_SIDE

log = logging.getLogger(__name__)

NETWORK, PICTURES = "config.json", "preprocessor_config.json"
# The largest opts.yaml in bytes (usual ones have some forty lines), and the maximum of characters of a value.
_MOST_BYTES, _SHOWN = 100_000, 1000
# The largest configuration of transformers in bytes.
_MOST_JSON = 1_000_000
_COUNT = (Annotated[int, msgspec.Meta(ge=1, le=1 << 31)], "a whole number")
# YAML's words for no value.
_NOTHING = ("", "~", "null", "None")
_SWITCH = (bool, "true or false")
# The supported options, each with its type, also in words.
_TYPES: dict[str, tuple[Any, str]] = {
    **dict.fromkeys(("h", "w", "stride", "block", "views", "heads"), _COUNT),
    **dict.fromkeys(("LPN", "share", "use_vgg16"), _SWITCH),
    "droprate": (Annotated[float, msgspec.Meta(ge=0, lt=1)], "a number from 0 up to 1"),
}


def read_options(path: Path) -> dict[str, Any]:
    """Read the `opts.yaml` of a published checkpoint; empty if there is none.

    All values are texts except for supported options. Tags, such as `!!python/tuple`, are ignored, so that nothing in the
    file runs.

    Raises:
        ModelFileError: if it cannot be read, or a supported option has an invalid value.
    """
    if not path.is_file():
        return {}
    try:
        if path.stat().st_size > _MOST_BYTES:
            raise ValueError("it is no list of options")
        options = yaml.load(path.read_text("utf-8-sig", "replace"), yaml.BaseLoader) or {}
    except Exception as error:  # the reader may raise anything on deep nesting
        raise ModelFileError("The opts.yaml beside the model cannot be read; correct or remove it.") from error
    if not isinstance(options, dict):
        raise ModelFileError("The opts.yaml beside the model is not a list of options; correct or remove it.")
    known: dict[str, Any] = {key: value for key, value in options.items() if value not in _NOTHING}
    for key, value in known.items():
        # The text of nested lists may be huge.
        known[key] = printable(value[:_SHOWN]) if isinstance(value, str) else f"a {type(value).__name__}"
        if key in _TYPES:
            try:
                known[key] = msgspec.convert(known[key], _TYPES[key][0], strict=False)
            except msgspec.ValidationError as error:
                raise invalid(key, known[key], _TYPES[key][1]) from error
    return known


def invalid(key: str, value: Any, expected: str) -> ModelFileError:
    """Return the error about an option of an invalid value."""
    return ModelFileError(
        f"The opts.yaml beside the model says {key}: {printable(str(value)[:80])}; expected {expected}, so correct it."
    )


def picture_size(
    options: Mapping[str, Any], name: str, default: tuple[int, int], tell: bool = False, step: int = 1
) -> tuple[int, int]:
    """Return the input size (height, width): `h` and `w` of the options, each with its default.

    Args:
        name: of the model's file, for messages.
        tell: whether to log the use of the default.
        step: both sides are multiples of it.

    Raises:
        ModelFileError: if a side is no multiple of `step`, or huge.
    """
    height, width = int(options.get("h", default[0])), int(options.get("w", default[1]))
    if tell and not {"h", "w"} <= options.keys():
        log.warning(
            "%s does not state the whole size of its pictures, so %d x %d pixels are assumed; if it was trained at another size, "
            "write h: and w: into an opts.yaml beside it.",
            printable(name),
            height,
            width,
        )
    if height % step or width % step or max(height, width) > MAX_SIDE:
        raise ModelFileError(
            f"{name} takes pictures of {height} x {width} pixels by its opts.yaml; expected multiples of {step} up to {MAX_SIDE}."
        )
    return height, width


def read_configuration(folder: Path, name: str) -> dict[str, Any]:
    """Read a JSON file of transformers; empty if there is none.

    Raises:
        ModelFileError: if it cannot be read.
    """
    file = folder / name
    if not file.is_file():
        return {}
    try:
        if file.stat().st_size > _MOST_JSON:
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
