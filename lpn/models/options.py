"""The options of a training, `opts.yaml` beside a published checkpoint, and the size of pictures; no torch here."""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
import yaml

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.models.contract import MAX_SIDE

log = logging.getLogger(__name__)

# The largest opts.yaml in bytes (usual ones have some forty lines), and the most characters of a value.
_MOST_BYTES, _SHOWN = 100_000, 1000
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
    """Return the input size (height, width): `h` and `w` of the options, and the default for what they lack.

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
            "%s does not tell the whole size of its pictures, so %d x %d pixels are assumed; if it was trained at another size, "
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
