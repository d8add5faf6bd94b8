"""Metadata of a data set's pictures, as columns of a table.

    geo.csv        latitude, longitude, altitude, heading, tilt, fov, width: see `lpn.datasets.geo`
    world.json     the building on each picture of a rendered world: district, its character, kind, height, twins
    metadata.csv   anything else, one line a picture:

        path,weather,battery
        test/query_drone/0005/image-01.jpeg,rain,81.5

A column of metadata.csv holds numbers if all its values are numbers, else texts. Values may be empty, and lines missing.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Sequence
from dataclasses import astuple, fields
from pathlib import Path
from typing import Any

from lpn.core.csv_cells import unescape
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.formats import WORLD as WORLD_FORMAT
from lpn.core.formats import is_newer, newer_version
from lpn.core.lists import read_text, table
from lpn.core.tables import Column, number_column, text_column
from lpn.datasets import geo
from lpn.datasets.listed_paths import by_name, plain_path

log = logging.getLogger(__name__)

NAME = "metadata.csv"
WORLD = "world.json"
# The columns of a user's annotations.
TAGS, NOTE = "tags", "note"
_ABOUT = {
    "altitude": "The height at which the camera flew",
    "heading": "The direction in which the camera looked, clockwise from north",
    "tilt": "The angle of the camera's view below the horizon: -90 looks straight down",
    "fov": "The camera's field of view",
    "width": "The width of the ground on the picture",
}
_UNITS = {"latitude": "°", "longitude": "°", "altitude": "m", "heading": "°", "tilt": "°", "fov": "°", "width": "m"}
_OPERATOR_CHARACTERS = set('<>=!~"')


def columns(root: Path, paths: Sequence[str], taken: Sequence[str] = (), positions: bool = True) -> list[Column]:
    """Return all known metadata of some pictures; columns without any value are left out.

    Args:
        root: the data set's folder.
        paths: the pictures, below it.
        taken: column names that metadata.csv must not use.
        positions: read those of `geo.csv`.

    Raises:
        DataError: if a file cannot be used; the message names its line.
    """
    all_columns = [*(_positions(root, paths) if positions else ()), *_world(root, paths)]
    all_columns += _custom(root, paths, [*taken, *(column.name for column in all_columns), "path", TAGS, NOTE])
    return [column for column in all_columns if column.known.any()]


def _positions(root: Path, paths: Sequence[str]) -> list[Column]:
    where = geo.positions(root)
    if where is None:
        return []
    names = [field.name for field in fields(geo.Position)]
    values = zip(*(astuple(place) for place in where.below(paths)), strict=True)
    return [
        number_column(
            name, [math.nan if value is None else value for value in of_all], _UNITS[name], about=_ABOUT.get(name, "")
        )
        for name, of_all in zip(names, values, strict=True)
    ]


def _world(root: Path, paths: Sequence[str]) -> list[Column]:
    """Return the columns about the building on each picture of a rendered world."""
    file = root / WORLD
    if not file.is_file():
        return []
    try:
        plan = json.loads(file.read_bytes())
        if is_newer(plan.get("format"), WORLD_FORMAT):
            raise DataError(newer_version(f"{WORLD} in {printable(root.name)}", plan["format"], WORLD_FORMAT))
        districts = {int(district["number"]): district for district in plan["districts"]}
        buildings = {int(building["id"]): building for building in plan["buildings"]}
        building_of = {str(picture["path"]): buildings.get(int(picture["id"])) for picture in plan["pictures"]}
        rows = [_building(building_of.get(path), districts) for path in paths]
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{WORLD} in {printable(root.name)} is damaged or not the plan of a rendered world; render it again, or take "
            f"{WORLD} away."
        ) from error
    district, character, kind, height, twins = zip(*rows, strict=True)
    return [
        text_column("district", district, "The district of the rendered city in which the building stands"),
        text_column("character", character, "What the district is mostly used for"),
        text_column(
            "kind",
            kind,
            "The kind of building, by its use or its plan: lshape, tshape, and ushape are plans like L, T, and U",
        ),
        number_column("height", height, "m", about="The height of the building, not that of the flight"),
        text_column("twins", twins, "Whether another building of the city looks the same on purpose"),
    ]


def _building(
    building: dict[str, Any] | None, districts: dict[int, dict[str, Any]]
) -> tuple[str, str, str, float, str]:
    """Return district, its character, kind, height in metres, and whether the building has twins."""
    if building is None:
        return "", "", "", math.nan, ""
    district, twins = districts[int(building["district"])], "no" if building["twins"] is None else "yes"
    return str(district["name"]), str(district["character"]), str(building["kind"]), float(building["height"]), twins


def _custom(root: Path, paths: Sequence[str], taken: Sequence[str]) -> list[Column]:
    file = root / NAME
    if not file.is_file():
        return []
    names, lines = table(
        read_text(file, NAME),
        NAME,
        lambda names: names[:1] == ["path"] and len(names) > 1,
        "path and the names of columns",
        tidy=lambda name: printable(unescape(name)),
    )
    _check_names(names, taken)
    rows: dict[str, list[str]] = {}
    for where, row in lines:
        text, *rest = map(unescape, row.values())
        path = plain_path(text)
        if path in rows:
            raise DataError(f"{where} is a second one for {printable(path)!r}; keep one.")
        rows[path] = [printable(" ".join(value.splitlines())) for value in rest]
    everywhere = list(rows.values())
    if any(path not in rows for path in paths):
        rows = by_name(rows, paths, NAME)
    missing = [path for path in paths if path not in rows]
    if paths and len(missing) == len(paths):
        raise DataError(
            f"{NAME} names none of the {len(paths)} queries; expected paths below the folder, such as {printable(paths[0])}."
        )
    if missing:
        log.warning("%s has no line for %d of %d queries, such as %s.", NAME, len(missing), len(paths), missing[0])
    empty = [""] * (len(names) - 1)
    return [
        _column(name, [rows.get(path, empty)[i] for path in paths], [row[i] for row in everywhere])
        for i, name in enumerate(names[1:])
    ]


def _check_names(names: Sequence[str], taken: Sequence[str]) -> None:
    used = {name.casefold() for name in taken}
    for name in names[1:]:
        if not name or _OPERATOR_CHARACTERS & set(name):
            raise DataError(
                f"{NAME} has a column called {name!r}; expected a name without any of "
                f"{' '.join(sorted(_OPERATOR_CHARACTERS))}, so rename it."
            )
        if name.casefold() in used:
            raise DataError(f"{NAME} has a column called {name!r}, which there is already; rename it.")
        used.add(name.casefold())


def _column(name: str, values: Sequence[str], everywhere: Sequence[str]) -> Column:
    """Return a number column if every value in the file is a number, so that the kind is the same for all tasks."""
    known = [text for text in everywhere if text]
    if known and all(_is_number(text) for text in known):
        return number_column(name, [float(text) if text else math.nan for text in values])
    return text_column(name, values)


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False
