"""Models named as `timm:NAME:FILE`: a network of timm, and a file with its weights. Nothing is downloaded; no torch here."""

from __future__ import annotations

from pathlib import Path

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.models.spec import TIMM


def timm_file(model: str | Path) -> tuple[str, Path] | None:
    """Return the network's name and the file of `timm:NAME:FILE`; None for any other name of a model.

    Raises:
        ModelFileError: if the file is left out or missing.
    """
    text = str(model)
    if not text.startswith(TIMM) or Path(text).is_file():
        return None
    name, _, file = text.removeprefix(TIMM).partition(":")
    shown = printable(name)[:80] or "NAME"
    if not file:
        raise ModelFileError(
            f"{TIMM}{shown} names a network without its weights, and nothing is downloaded; give a file of them, as "
            f"{TIMM}{shown}:FILE."
        )
    if not Path(file).exists():
        raise ModelFileError(
            f"There is no file {printable(file)[:200]} for the network {shown}, and nothing is downloaded; expected "
            f"{TIMM}NAME:FILE with a file of weights on disk."
        )
    return name, Path(file)
