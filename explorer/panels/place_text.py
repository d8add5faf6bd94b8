"""The place of a map in words: where it is, when it was photographed, and how large it is."""

from __future__ import annotations

from calendar import month_name
from datetime import date

from explorer.web.coordinates import MapCoordinate
from explorer.web.render import render
from explorer.workspace import Workspace
from lpn.core.numbers import distance
from lpn.datasets import Picture
from lpn.datasets.rendered import shows_rendered
from lpn.drawing.verdicts import listed
from lpn.maps import MapPlace
from lpn.maps.named_window import WindowCut, describe_offset


def place(workspace: Workspace) -> str:
    """Return HTML that says where the ground of a map is, when it was photographed, and how large it is; "" without a map.

    A rendered map has no coordinate, as it shows no real place.
    """
    basemap = workspace.basemap if workspace.flight is None else workspace.flight.basemap
    if basemap is None:
        return ""
    return render(
        "panels/place",
        place=basemap.place,
        coordinate=None if shows_rendered(workspace.root) else MapCoordinate.on(basemap, (0.0, 0.0)),
        times=_times(basemap.place, None if workspace.flight is None else workspace.flight.flight.day),
        sides=[distance(side) for side in basemap.sides],
    )


def piece(tile: Picture) -> str:
    """Return what a tile is called: a piece of a map by where its middle lies on the map, and its width."""
    if not isinstance(tile.cut, WindowCut):
        return tile.title
    window = tile.cut.window
    return f"{describe_offset(window.x, window.y)}, {window.size:.0f} m wide"


def same_day(workspace: Workspace) -> bool:
    """Return whether map and photos of a flight are known to be of the same day."""
    flight = workspace.flight
    return flight is not None and flight.flight.day is not None and flight.flight.day == flight.basemap.place.day


def _times(mapped: MapPlace, flown: date | None) -> str:
    """Say when map and photos were taken, as far as it is known."""
    if flown is not None and flown == mapped.day:
        return f"map and photos are of {_written(flown)}"
    known = []
    if mapped.day is not None:
        known.append(f"the map is of {_written(mapped.day)}")
    elif mapped.season:
        known.append(f"the map is of {mapped.season}")
    if flown is not None:
        known.append(f"the photos are of {_written(flown)}")
    return listed(known) if known else ""


def _written(day: date) -> str:
    return f"{day.day}\N{NO-BREAK SPACE}{month_name[day.month]}\N{NO-BREAK SPACE}{day.year}"
