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
from lpn.flight.locate.own_photo import OwnPhoto
from lpn.library.analyser import OwnPicture


def own_photo(
    seen: FlightSnapshot, picture: OwnPicture, job: BackgroundJob[OwnPhoto] | None, addresses: Mapping[str, Any]
) -> dict[str, Any]:
    """Return an own photo as data to draw, in the form of `page.chosen`; its frame number is -1.

    Args:
        job: registers the photo; None without a registration.
    """
    basemap, own, pixels, tag = seen.flight.basemap, None if job is None else job.value, picture.picture, None
    tagged = "The photo has no GPS tag."
    if picture.place is not None:
        tag = basemap.frame.xy([picture.place[0]], [picture.place[1]])[0]
        off = basemap.metres_off(tag)
        tagged = f"Its GPS tag lies {distance(off)} off this map." if off else ""
    told: dict[str, Any] = {"tag": None if tag is None else np.round(tag, 2).tolist(), "outline": None, "place": None}
    shown: dict[str, Any] = {"homography": None, "pins": [], "corrected": False, "saves": 0, "ground": "", "photo": ""}
    shown |= {"own": told, "size": [pixels.shape[1], pixels.shape[0]]}
    if own is None:
        headline = "Not compared with the map"
        if job is not None and job.error is None:
            tries = f" {job.done} of {job.total} tries" if job.total else ""
            headline = f"Being compared with the map ...{tries}"
        card: dict[str, Any] = {"state": "unknown", "mark": "?", "headline": headline, "stage": None}
        card |= dict.fromkeys(("what", "at", "link"), "")
        lines = [None if job is None else job.error, tagged]
    else:
        located, answer = own.located, own.answer
        one = FlightSnapshot(replace(seen.flight, frames=[located]))
        shown |= page.chosen(one, 0, addresses) | {"ground": "", "photo": ""}
        searched = "" if own.whole_map else "The map is large, so only the most similar windows were searched."
        card = shown["card"]
        lines = [*card["lines"], tagged, searched]
        pixels = located.frame.undistorted(pixels)
        if answer.accepted and answer.place is not None:
            shown["ground"] = ground(basemap, located).data_uri
            shown["photo"] = encoded(images.shrink(pixels, LAID)).data_uri
            outline = one.outlines[0]
            told["outline"] = None if outline is None else [*np.round(outline.corners, 2).tolist(), True]
            told |= {"place": np.round(answer.place, 2).tolist(), "radius": answer.radius}
    card |= {"name": picture.name, "facts": [], "lines": [line for line in lines if line]}
    return shown | {"frame": -1, "card": card, "square": encoded(middle_square(pixels)).data_uri}
