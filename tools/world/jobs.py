"""Shared steps of rendering a world or a flight: checks of settings and folder, and progress."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lpn.core.errors import InputError, OutputError

if TYPE_CHECKING:
    from tools.world.atlas import Settings
    from tools.world.flight import FlightSettings

EDITION = 2  # counts changes of the code that change the pictures of a seed
# The entries of a plan that determine its pictures.
_DECIDES = ("format", "edition", "settings")


def check_limits(settings: Settings | FlightSettings, limits: Mapping[str, tuple[float, float]]) -> None:
    """Check settings against their lowest and highest values; raises InputError."""
    for name, (low, high) in limits.items():
        value = getattr(settings, name)
        if not low <= value <= high:
            raise InputError(f"The setting {name} is {value}; expected {low} to {high}.")


def check_folder(settings: Settings | FlightSettings, file: Path, form: str) -> None:
    """Check that the plan in a folder, world.json or flight_world.json, is absent, or of the same settings and format.

    Raises:
        OutputError: when the folder holds something else.
    """
    if not file.is_file():
        return
    try:
        held = {name: value for name, value in json.loads(file.read_bytes()).items() if name in _DECIDES}
        # A plan may lack settings that came later, with their defaults.
        held["settings"] = {one.name: one.default for one in fields(settings) if one.default is not MISSING} | held[
            "settings"
        ]
        held = json.loads(json.dumps(held))
    except (OSError, ValueError, AttributeError, KeyError, TypeError, RecursionError):
        held = {}
    wanted = json.loads(json.dumps({"format": form, "edition": EDITION, "settings": asdict(settings)}))
    if held != wanted:
        raise OutputError(
            f"{file} is of pictures made otherwise, by {json.dumps(held)[:300]}; delete that folder, or choose another one."
        )


@contextmanager
def progress(total: int) -> Iterator[tuple[Path, Callable[[], None]]]:
    """Show the progress of `total` pictures, Blender's reports kept quiet; yields a scratch folder and a call to advance."""
    from tools.world import render

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        render.quiet() as stream,
        Progress(*columns, console=Console(file=stream)) as bar,
        TemporaryDirectory(prefix="lpn-world-") as folder,
    ):
        task = bar.add_task("Rendering", total=total)
        yield Path(folder), lambda: bar.advance(task)
