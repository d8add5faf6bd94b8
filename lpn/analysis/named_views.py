"""Named choices of queries, in `views.json` in the data set's folder (of the demo, in the user's).

    {"views": [{"name": "dark roofs", "task": "drone-to-satellite", "outcome": "failed", "filter": "altitude > 200", ...}]}

Queries that were chosen by hand are kept by their paths relative to the data set's folder, so that a view holds the same queries
after others were added.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
from msgspec import Meta

from lpn.core.errors import DataError, InputError
from lpn.core.files import printable
from lpn.core.own_files import OwnFileFormat

NAME = "views.json"
LONGEST_NAME, MOST = 60, 100

_Text = Annotated[str, Meta(max_length=4000)]


class ChosenQueries(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Queries that were chosen together by hand.

    Attributes:
        kind: of selection, such as a lasso; a view keeps one of each.
        label: what they have in common, in words.
        paths: relative to the data set's folder.
    """

    kind: _Text
    label: _Text
    paths: tuple[str, ...]


class NamedView(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Queries of a task, and how they are shown.

    Attributes:
        outcome: see `OutcomeFilter` of the explorer.
        filter: see `lpn.core.tables`.
        search: text that the names contain.
        chosen: a query must be in all of them.
        tab: the laboratory's tab; empty for the one that is open.
        map: the map that is shown.
        colour: the column that colours it; empty for the outcome.
    """

    name: _Text
    task: _Text
    outcome: _Text = "all"
    filter: _Text = ""
    search: _Text = ""
    chosen: tuple[ChosenQueries, ...] = ()
    sort: _Text = "margin"
    descending: bool = False
    tab: _Text = ""
    map: _Text = "pca"
    colour: _Text = ""


class _File(msgspec.Struct, forbid_unknown_fields=True):
    views: tuple[NamedView, ...]


def read_views(file: Path) -> tuple[NamedView, ...]:
    """Read all views, by name; empty if the file does not exist.

    Raises:
        DataError: when the file is damaged.
    """
    return _FORMAT.read(file)


def save_view(file: Path, view: NamedView) -> tuple[NamedView, ...]:
    """Save a view in place of one of the same name and task, and return all views.

    Raises:
        InputError: when the name is empty or too long, or the views are too many or too large.
        DataError: when the existing file is damaged; it is not changed.
        OutputError: when the file cannot be written.
    """
    if not view.name.strip() or len(view.name) > LONGEST_NAME or not view.name.isprintable():
        raise InputError(
            f"The view's name has {len(view.name)} letters; expected 1 to {LONGEST_NAME} that can be printed, so choose another."
        )
    return _change(file, (view.task, view.name), view)


def remove_view(file: Path, task: str, name: str) -> tuple[NamedView, ...]:
    """Remove a view, if there is one of this name, and return the others; errors as for `save_view`."""
    return _change(file, (task, name), None)


def _change(file: Path, key: tuple[str, str], view: NamedView | None) -> tuple[NamedView, ...]:
    def change(views: tuple[NamedView, ...]) -> tuple[NamedView, ...]:
        others = [one for one in views if (one.task, one.name) != key]
        changed = others if view is None else [*others, view]
        if len(changed) > MOST:
            raise InputError(f"There are {MOST} views already; remove one first.")
        return tuple(sorted(changed, key=lambda one: (one.task, one.name)))

    return _FORMAT.change(file, change)


def _decode(content: bytes, file: Path) -> tuple[NamedView, ...]:
    try:
        return msgspec.json.decode(content, type=_File).views
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise DataError(
            f"{file} holds no views ({printable(str(error))[:100]}); correct it, or move it away."
        ) from error


def _encode(views: tuple[NamedView, ...]) -> bytes:
    return msgspec.json.format(msgspec.json.encode(_File(views)), indent=1)


_FORMAT = OwnFileFormat("views", _decode, _encode, tuple[NamedView, ...], "remove a view, or choose fewer queries")
