"""Metadata of a data set's pictures, as columns of a table.

    geo.csv        latitude, longitude, altitude, heading, tilt, fov, width: see `lpn.datasets.geo`
    world.json     the building on each picture of a rendered world: district and its character, kind, height, twins
    metadata.csv   anything else, one line a picture:

        path,weather,battery
        test/query_drone/0005/image-01.jpeg,rain,81.5

A column of metadata.csv holds numbers if all its values are numbers, else texts. Values may be empty, and lines may be missing.
"""

from __future__ import annotations

import json
import logging
import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import astuple, fields
from pathlib import Path

from lpn.core.csv_cells import unescape
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.formats import WORLD as WORLD_FORMAT
from lpn.core.formats import is_newer, newer_version
from lpn.core.lists import read_text, table
from lpn.core.tables import OPERATOR_CHARACTERS, Column, number_column, text_column
from lpn.datasets import geo
from lpn.datasets.listed_paths import by_name, plain_path
from lpn.datasets.rendered import PLAN

log = logging.getLogger(__name__)

NAME = "metadata.csv"
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


def columns(root: Path, paths: Sequence[str], taken: Sequence[str] = ()) -> list[Column]:
    """Return all known metadata of some pictures; columns without any value are left out.

    Args:
        root: the data set's folder.
        paths: the pictures' paths below `root`.
        taken: column names that metadata.csv must not use.

    Raises:
        DataError: if a file cannot be used; the message names its line.
    """
    all_columns = [*_positions(root, paths), *_world(root, paths)]
    all_columns += _custom(root, paths, [*taken, *(column.name for column in all_columns), "path", TAGS, NOTE])
    return [column for column in all_columns if column.known.any()]


def _positions(root: Path, paths: Sequence[str]) -> list[Column]:
    where = geo.positions(root)
    if where is None:
        return []
    rows = [[math.nan if value is None else value for value in astuple(place)] for place in where.below(paths)]
    return [
        number_column(field.name, [row[i] for row in rows], _UNITS[field.name], about=_ABOUT.get(field.name, ""))
        for i, field in enumerate(fields(geo.Position))
    ]


def _world(root: Path, paths: Sequence[str]) -> list[Column]:
    file = root / PLAN
    if not file.is_file():
        return []
    name, nothing = f"{PLAN} in {printable(root.name)}", ("", "", "", math.nan, "")
    try:
        plan = json.loads(file.read_bytes())
        if is_newer(plan.get("format"), WORLD_FORMAT):
            raise DataError(newer_version(name, plan["format"], WORLD_FORMAT))
        districts = {district["number"]: (district["name"], district["character"]) for district in plan["districts"]}
        buildings = {
            one["id"]: (
                *(*map(str, districts[one["district"]]), str(one["kind"]), float(one["height"])),
                "no" if one["twins"] is None else "yes",
            )
            for one in plan["buildings"]
        }
        building_of = {picture["path"]: buildings.get(picture["id"], nothing) for picture in plan["pictures"]}
        district, character, kind, height, twins = zip(*(building_of.get(path, nothing) for path in paths), strict=True)
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as error:
        raise DataError(
            f"{name} is damaged or not the plan of a rendered world; render it again, or take {PLAN} away."
        ) from error
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
    used = {name.casefold() for name in taken}
    for name in names[1:]:
        signs = " ".join(sorted(OPERATOR_CHARACTERS))
        if not name or OPERATOR_CHARACTERS & set(name):
            raise DataError(
                f"{NAME} has a column called {name!r}; expected a name without any of {signs}, so rename it."
            )
        if name.casefold() in used:
            raise DataError(f"{NAME} has a column called {name!r}, which exists already; rename it.")
        used.add(name.casefold())
    rows: dict[str, list[str]] = {}
    for where, row in lines:
        text, *rest = map(unescape, row.values())
        path = plain_path(text)
        if path in rows:
            raise DataError(f"{where} is the second line for {printable(path)!r}; keep one.")
        rows[path] = [printable(" ".join(value.splitlines())) for value in rest]
    everywhere = list(rows.values())
    rows = rows if all(path in rows for path in paths) else by_name(rows, paths, NAME)
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


def _column(name: str, values: Sequence[str], everywhere: Sequence[str]) -> Column:
    """Return a number column if every value in the file is a number, so that the kind is the same for all tasks."""
    with suppress(ValueError):
        numbers = {text: float(text) for text in everywhere if text}
        if numbers and all(map(math.isfinite, numbers.values())):
            return number_column(name, [numbers[text] if text else math.nan for text in values])
    return text_column(name, values)
