"""A user's own photo over the map of a flight, drawn like a photo of the flight and with a card of the same kind."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from explorer.compute.background_jobs import BackgroundJob
from explorer.flight import page
from explorer.flight.pictures import LAID, encoded, ground, middle_square
from explorer.flight.service import FlightSnapshot
from lpn.core import images
from lpn.core.numbers import distance
from lpn.flight.locate.belief import FlightVerdicts
from lpn.flight.locate.own_photo import OwnPhoto
from lpn.library.analyser import OwnPicture


def own_photo(
    seen: FlightSnapshot, picture: OwnPicture, job: BackgroundJob[OwnPhoto] | None, addresses: Mapping[str, Any]
) -> dict[str, Any]:
    """Return the data to draw of an own photo, as `page.chosen` does for a frame; its frame number is -1.

    Args:
        job: registers the photo; None without a registration.
    """
    flight = seen.flight
    basemap, own = flight.basemap, None if job is None else job.value
    tag = None if picture.place is None else basemap.frame.xy([picture.place[0]], [picture.place[1]])[0]
    off = 0.0 if tag is None else basemap.metres_off(tag)
    tagged = (
        "The photo has no GPS tag." if tag is None else f"Its GPS tag lies {distance(off)} off this map." if off else ""
    )
    height, width = picture.picture.shape[:2]
    told: dict[str, Any] = {"tag": None if tag is None else np.round(tag, 2).tolist(), "outline": None, "place": None}
    shown: dict[str, Any] = {
        "frame": -1,
        "photo": "",
        "square": encoded(middle_square(picture.picture)).data_uri,
        "ground": "",
        "card": _waiting(picture, job, tagged),
        "homography": None,
        "pins": [],
        "corrected": False,
        "size": [width, height],
        "saves": 0,
        "own": told,
    }
    if own is None:
        return shown
    located, answer = own.located, own.answer
    alone = replace(flight, frames=[located])
    one = FlightSnapshot(alone, FlightVerdicts.of(alone))
    shown |= page.chosen(one, 0, addresses, answer.agreement)
    searched = "" if own.whole_map else "The map is large, so only the most similar windows were searched."
    card = shown["card"] | {"name": picture.name, "facts": []}
    shown |= {"frame": -1, "card": card | {"lines": [line for line in (*card["lines"], tagged, searched) if line]}}
    shown |= {"photo": "", "square": encoded(middle_square(located.frame.undistorted(picture.picture))).data_uri}
    shown |= {"ground": ground(basemap, located).data_uri if answer.accepted else ""}
    if answer.accepted and answer.x is not None and answer.y is not None:
        outline = one.outlines[0]
        shown["photo"] = encoded(images.shrink(located.frame.undistorted(picture.picture), LAID)).data_uri
        told["outline"] = None if outline is None else [*np.round(outline.corners, 2).tolist(), True]
        told |= {"place": [round(answer.x, 2), round(answer.y, 2)], "radius": answer.radius}
    return shown


def _waiting(picture: OwnPicture, job: BackgroundJob[OwnPhoto] | None, tagged: str) -> dict[str, Any]:
    """Return the card of a photo that is not registered yet, or whose registration failed."""
    headline = "Not compared with the map"
    lines = [tagged]
    if job is not None and job.error is not None:
        lines = [job.error, tagged]
    elif job is not None:
        tries = f" {job.done} of {job.total} tries" if job.total else ""
        headline = f"Being compared with the map ...{tries}"
    card: dict[str, Any] = dict.fromkeys(("what", "at", "link"), "")
    card |= {"name": picture.name, "facts": [], "state": "unknown", "mark": "?", "headline": headline, "stage": None}
    return card | {"lines": [line for line in lines if line]}
