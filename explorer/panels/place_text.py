"""The place of a map in words: where it is, when it was photographed, and how large it is."""

from __future__ import annotations

from calendar import month_name
from datetime import date

import numpy as np

from explorer.web.coordinates import MapCoordinate
from explorer.web.render import render
from explorer.workspace import Workspace
from lpn.core.numbers import distance
from lpn.core.texts import listed
from lpn.datasets import Picture
from lpn.datasets.rendered import shows_rendered
from lpn.drawing.words import say
from lpn.locate.located import LocatedFlight
from lpn.maps import MapPlace
from lpn.maps.named_window import WindowCut, describe_offset
from lpn.maps.place import season_of
from lpn.tasks.task import Task

_NO_DAMAGE = "Photos of damage, such as a storm's, have not been tried."
UNTRIED = "Photos of damage, such as a storm's, and real photos of another season than the map's have not been tried."
# A piece that the map shows less of than this share has a visible part without a picture.
_WHOLE = 0.95


def place(workspace: Workspace, task: Task, linked: bool = True) -> str:
    """Return HTML that says what the program searches: a map and when it was photographed, or satellite pictures; "" of neither.

    A rendered map has no coordinate, as it shows no real place.

    Args:
        linked: coordinate and credit have links.
    """
    basemap, rendered = workspace.basemap, shows_rendered(workspace.root)
    seeks = basemap is not None or task.views == ("drone", "satellite")
    if not seeks and not rendered:
        return ""
    day = None if workspace.flight is None else workspace.flight.flight.day
    return render(
        "panels/place",
        seeks=seeks,
        tiles=task.tiles,
        rendered=rendered,
        place=None if basemap is None else basemap.place,
        coordinate=None if basemap is None else MapCoordinate.on(basemap, (0.0, 0.0)),
        linked=linked,
        times="" if basemap is None else _times(basemap.place, day),
        about=workspace.about,
        sides=() if basemap is None else [distance(side) for side in basemap.sides],
    )


def piece(tile: Picture) -> str:
    """Return what a tile is called: a piece of a map by where its middle lies, its width, and how much of it is off the map."""
    if not isinstance(tile.cut, WindowCut):
        return tile.title
    window, share = tile.cut.window, share_off_map(tile)
    off = f", {100 * share:.0f} % of it off the map" if share else ""
    return f"{describe_offset(window.x, window.y)}, {window.size:.0f} m wide{off}"


def share_off_map(tile: Picture) -> float:
    """Return the share of a piece of a map that the map does not show, 0 .. 1; 0 if it is too small to be seen."""
    if not isinstance(tile.cut, WindowCut):
        return 0.0
    window = tile.cut.window
    shown = float(tile.cut.basemap.valid_shares(np.array([(window.x, window.y)]), window.size)[0])
    return 1 - shown if shown < _WHOLE else 0.0


def off_map(tile: Picture, answer: str) -> str:
    """Say which share of a piece of a map, which is called `answer`, is off the map; "" if none is."""
    share = share_off_map(tile)
    return f"{100 * share:.0f} % of {answer} is off the map, and black to the model." if share > 0 else ""


def criterion(workspace: Workspace, task: Task) -> str:
    """Say within what an answer counts as right, and who is the judge."""
    flight = workspace.flight
    if flight is None and task.of_map:
        return "Right is a piece on which the photo's GPS tag lies."
    if flight is None or flight.retrieval is None:
        judges = f"the plan of the {say('rendered')} city" if shows_rendered(workspace.root) else "the data set"
        return f"Right is an answer that shows the same place; {judges} is the judge."
    low, high = float(flight.retrieval.sizes.min()), float(flight.retrieval.sizes.max())
    width = f"{low:.0f} to {high:.0f} m wide" if round(low) < round(high) else f"{high:.0f} m wide"
    right = f"Right is a piece, {width}, on which the photo's middle lies"
    if round(low) < round(high):
        right += ", so the middle of a large piece may lie farther off than that of a small one"
    if (audit := flight.late_tags) is None or audit.lag is None:
        return f"{right}; its GPS tag is the judge."
    return (
        f"{right}. GPS tags here lie {distance(audit.median)} off in the median, some of which a lag of {abs(audit.lag):.1f} s "
        "explains, so the judge is the program's second method, which lays the photo's details over the map."
    )


def season(workspace: Workspace) -> str:
    """Say if map and photos of a flight are of two seasons; of one whose are of the same day, name a flight of two beside it."""
    flight = workspace.flight
    if flight is None:
        return ""
    if _seasons_differ(flight):
        return "Map and photos are of different seasons."
    if flight.flight.day is None or flight.flight.day != flight.basemap.place.day:
        return ""
    for key, other in workspace.opened().items():
        if other.flight is None or not _seasons_differ(other.flight):
            continue
        right, graded = other.counts(other.rankings[next(iter(other.tasks.values())).key])
        if not graded:
            continue
        return (
            f"At another place ({workspace.choices[key]}), whose map is of another season, the first answer is right {right} of "
            f"{graded} times."
        )
    return ""


def untried(workspace: Workspace) -> str:
    """Say what nobody has measured, where a real flight may lead to believe it; "" for any other data."""
    if workspace.flight is None or workspace.flight.rendered:
        return ""
    return _NO_DAMAGE if _seasons_differ(workspace.flight) else UNTRIED


def _seasons_differ(flight: LocatedFlight) -> bool:
    """Return whether map and photos are known to be of different seasons."""
    flown, mapped, latitude = flight.flight.day, flight.basemap.place, flight.basemap.frame.latitude
    season = mapped.season if mapped.day is None else season_of(mapped.day, latitude)
    return flown is not None and season != "" and season != season_of(flown, latitude)


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
