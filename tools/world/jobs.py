"""What renderings of a world and of a flight share: checks of their settings and folder, and the progress of their pictures."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import MISSING, asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lpn.core.errors import InputError, OutputError
from lpn.core.formats import UPGRADE, is_newer, newer_version

if TYPE_CHECKING:
    from tools.world.atlas import Settings
    from tools.world.flight import FlightSettings

EDITION = 2  # counts changes of the code that change the pictures of a seed


def check_limits(settings: Settings | FlightSettings, limits: Mapping[str, tuple[float, float]]) -> None:
    """Check settings against their lowest and highest values; raises InputError."""
    for name, (low, high) in limits.items():
        value = getattr(settings, name)
        if not low <= value <= high:
            raise InputError(f"The setting {name} is {value}; expected {low} to {high}.")


def check_folder(settings: Settings | FlightSettings, file: Path, kind: str, form: str) -> None:
    """Check that the plan in a folder is absent, or of the same settings; a setting with its default may be left out.

    Args:
        file: the plan, world.json or flight_world.json.
        kind: what it is a plan of, in words.
        form: its format.

    Raises:
        OutputError: when the folder holds something else.
    """
    if not file.is_file():
        return
    out = file.parent
    defaults = {one.name: one.default for one in fields(settings) if one.default is not MISSING}
    try:
        held = json.loads(file.read_bytes())
        if is_newer(held.get("format"), form):
            raise OutputError(newer_version(file, held["format"], form))
        had, edition = held["settings"], held["edition"]
        same = json.loads(json.dumps({**defaults, **had})) == json.loads(json.dumps(asdict(settings)))
    except (OSError, ValueError, KeyError, TypeError, AttributeError, RecursionError) as error:
        raise OutputError(f"{file} is not a {kind}'s; choose another folder.") from error
    if not same:
        raise OutputError(
            f"{out} holds pictures made with other settings ({had}); choose another folder, or delete that one."
        )
    if edition != EDITION:
        remedy = f"{UPGRADE}, or" if isinstance(edition, int) and edition > EDITION else "delete that one, or"
        raise OutputError(
            f"{out} holds pictures made by edition {edition} of the program, and this is edition {EDITION}, whose pictures "
            f"differ; {remedy} choose another folder."
        )


@contextmanager
def progress(total: int) -> Iterator[tuple[Path, Callable[[float], None]]]:
    """Show the progress of `total` pictures, Blender's reports kept quiet; yields a scratch folder and a call to advance."""
    from tools.world import render

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with (
        render.quiet() as stream,
        Progress(*columns, console=Console(file=stream)) as bar,
        render.scratch_folder() as folder,
    ):
        task = bar.add_task("Rendering", total=total)
        yield folder, lambda steps: bar.advance(task, steps)
