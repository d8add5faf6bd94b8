"""A person's own picture in the flight window: on the flat map as a photo of the flight, without the photos of the flight."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from explorer.flight_window import flight_text, page
from explorer.flight_window.pictures import encoded, ground, middle_square
from explorer.flight_window.service import FlightView
from explorer.panels import answer_text
from explorer.panels.radius_text import holds, reach, with_radius
from explorer.web.coordinates import MapCoordinate
from explorer.web.render import render
from explorer.workspace import StateAnalysis, Workspace
from lpn.core import images
from lpn.drawing import theme, words
from lpn.locate.coverage import outline
from lpn.locate.located import LocatedFlight
from lpn.maps.named_window import describe_offset

# Longer side in pixels of the picture that is laid over the map.
_LAID = 1280
# Metres around the map within which the script draws a place.
_AROUND = 500.0


def own_picture(analysis: StateAnalysis, workspace: Workspace, flight: LocatedFlight) -> dict[str, Any]:
    """Return what the script draws of the own picture that is shown, as `page.chosen` does of a frame, which is -1.

    A picture that fits the map has its frame and its place. Each has its GPS tag, if there is one.
    """
    picture, own = analysis.state.upload, analysis.registered
    assert picture is not None
    basemap = flight.basemap
    tag = None
    if picture.place is not None:
        latitude, longitude = picture.place
        tag = basemap.frame.xy([latitude], [longitude])[0].tolist()
    located = None if own is None else own.located
    answer = None if own is None or not own.answer.accepted else own.answer
    place = None if answer is None or answer.x is None or answer.y is None else (answer.x, answer.y)
    plain = picture.picture if located is None else located.frame.undistorted(picture.picture)
    height, width = picture.picture.shape[:2]
    corners = None if located is None or answer is None else outline(located)
    agreement = None if answer is None else answer.agreement
    fit, pins = "", []
    if located is not None and answer is not None and answer.homography is not None:
        pins = page.pins(np.array(answer.homography).reshape(3, 3), located)
    # The verdict says that it is not checked.
    if located is not None and agreement is not None and not agreement.unchecked:
        fit = flight_text.agreement(FlightView.of(replace(flight, frames=[located]), {}, ""), 0, agreement)
    job = analysis.own_photo
    sign, headline, sentence = answer_text.plain_verdict(analysis, workspace)
    card = render(
        "flight/own",
        name=picture.name,
        query=analysis.state.query,
        photo=encoded(middle_square(plain)).data_uri,
        ground=None if located is None or answer is None else ground(basemap, located).data_uri,
        sign=sign,
        headline=headline,
        sentence=with_radius(sentence, answer, workspace),
        holds=holds(answer, workspace, sign is None) if words.plain() else "",
        next_step=answer_text.next_step(analysis, workspace),
        comparing="" if job is None else answer_text.comparing(job),
        at=None if place is None else describe_offset(*place) if flight.rendered else MapCoordinate.on(basemap, place),
        drone="" if located is None else flight_text.drone(flight, located),
        agreement=fit,
        pins=pins,
        camera=answer is not None and answer.camera,
        placed=place is not None,
        tag=tag,
        off_map=tag is not None and basemap.metres_off(np.array(tag)) > _AROUND,
    )
    return {
        "frame": -1,
        "own": {
            "key": f"{picture.key or picture.name} {answer is not None}",
            "photo": "" if answer is None else encoded(images.shrink(plain, _LAID)).data_uri,
            "outline": None if corners is None else [*_rounded(corners.corners), True],
            "place": None if place is None else _rounded([place])[0],
            "radius": None if answer is None or answer.radius is None else reach(answer.radius),
            "doubted": sign is None,
            "state": theme.placed_name(sign),
            "tag": None if tag is None else _rounded([tag])[0],
        },
        "card": card,
        "homography": None if answer is None else answer.homography,
        "pins": pins,
        "corrected": False,
        "size": [width, height],
        "saves": 0,
    }


def _rounded(points: Any) -> list[Sequence[float]]:
    rounded: list[Sequence[float]] = np.round(np.asarray(points, np.float64), 2).tolist()
    return rounded
