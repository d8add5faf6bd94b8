"""Models by name: other packages' entry points of the group `lpn.models`, and `timm:NAME:FILE`; no torch here."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path

from lpn.core.errors import LPNError, ModelFileError
from lpn.core.files import printable
from lpn.models.base import Model
from lpn.models.spec import TIMM

GROUP = "lpn.models"


def open_registered(model: str) -> Model | None:
    """Open a registered model: "NAME", or "NAME:FILE" with a file of weights; None if no package registers it.

    The entry point is a function or a class that returns a `Model`. It is called without an argument, or with the file's path.

    Raises:
        ModelFileError: if there is no such file, or the entry point does not return a model.
    """
    name, colon, file = model.partition(":")
    point = next(iter(entry_points(group=GROUP, name=name)), None)
    if point is None:
        return None
    if colon and not Path(file).is_file():
        raise ModelFileError(f"There is no file {printable(file)} for the model {name}; check the path.")
    try:
        opened = point.load()(*([Path(file)] if colon else []))
    except LPNError:
        raise
    except Exception as error:  # another package's code may raise anything
        reason = printable(str(error).strip().partition("\n")[0]) or type(error).__name__
        raise ModelFileError(
            f"The model {name} cannot be opened ({type(error).__name__}: {reason}); it is registered as {point.value}."
        ) from error
    if not isinstance(opened, Model):
        raise ModelFileError(
            f"The entry point {name} of {GROUP} returns a {type(opened).__name__}; it must return an lpn.Model."
        )
    return opened


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
