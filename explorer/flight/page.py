"""A flight and one of its photos as JSON for the panel's script."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from explorer.flight import text
from explorer.flight.pictures import TilePyramid, ground_window
from explorer.flight.service import FlightSnapshot
from lpn.core.arrays import Float64Array, FloatingArray
from lpn.core.files import printable
from lpn.core.homography import apply_homography
from lpn.core.texts import counted
from lpn.drawing import overlays, score_map, theme
from lpn.flight.locate.coverage import seen_by
from lpn.flight.locate.located import LocatedFrame
from lpn.retrieval import Ranking

# Maximum of photos in the list of doubtful ones.
_MOST = 200
_COLOURS = ("tag", "retrieval", "sequence", "registration", "right", "contradicted", "unknown", "accent")
_STATES = {"accepted": 0, "not verified": 1, "refused": 2}


def data(seen: FlightSnapshot, addresses: Mapping[str, Any]) -> dict[str, Any]:
    """Return a flight as data to draw.

    Args:
        addresses: folders of the pictures, see `FlightPicturesFeed`.
    """
    flight = seen.flight
    basemap, frames, pyramid = flight.basemap, flight.frames, TilePyramid.of(flight.basemap)
    times = [frame.frame.time for frame in frames]
    sheets = [
        {
            "name": printable(sheet.name),
            "colour": theme.css(theme.part_colour(i)),
            "outline": _rounded(basemap.frame.xy(*sheet.outline.T)),
        }
        for i, sheet in enumerate(basemap.sheets)
    ]
    verdicts = seen.verdicts
    corrected = ["corrected"] if any(located.by_hand for located in frames) else []
    states = [text.state(verdict) for verdict in verdicts]
    reasons = ["" if verdict.sign else text.first_sentence(verdict.reason) for verdict in verdicts]
    doubtful = [(i, one, reasons[i]) for i, one in enumerate(states) if one != "right"]
    main = Counter(verdict.stage for verdict in verdicts if verdict.stage is not None).most_common(1)
    pairs = zip(seen.measured.frames, verdicts, strict=True)
    colours = {name: theme.css(theme.COLOURS[name]) for name in _COLOURS}
    return {
        "addresses": addresses,
        "bounds": list(basemap.bounds),
        "pyramid": {"west": pyramid.west, "north": pyramid.north, "side": pyramid.side},
        "resolution": basemap.resolution,
        "degrees": None if flight.rendered else basemap.frame.polynomials(basemap.bounds).tolist(),
        "sheets": sheets if len(sheets) > 1 else [],
        "names": [printable(frame.frame.name) for frame in frames],
        "times": None if any(time is None for time in times) else times,
        "outlines": [None if one is None else [*_rounded(one.corners), one.registered] for one in seen.outlines],
        "tracks": {name: _track(seen, name) for name in ("tag", *flight.stages, *corrected)},
        "colours": colours | {"corrected": theme.css(theme.COLOURS["by-hand"])},
        "bar": overlays.png_data_uri(overlays.heat_cells(np.linspace(0, 1, 128)[None], 0, 1)),
        "stages": [verdict.stage for verdict in verdicts],
        "states": states,
        "marks": [text.mark(verdict) for verdict in verdicts],
        "reasons": reasons,
        "errors": [_number(located.error(verdict.stage or ""), 4) for located, verdict in pairs],
        "off": "m from its GPS tag" + (" without the lag" if seen.lag is not None else ""),
        "words": text.STATES,
        "main": main[0][0] if main else "tag",
        "counts": text.counts(seen),
        "accuracy": text.accuracy(seen),
        "doubtful": sorted(doubtful, key=lambda one: one[1] != "contradicted")[:_MOST],
        "notes": text.notes(seen),
    }


def _track(seen: FlightSnapshot, name: str) -> dict[str, Any]:
    """Return x, y, state, and radius of each frame; the state is -1 without an answer, and 0 for a tag or correction."""
    x, y, states, radii = list[float | None](), list[float | None](), list[int](), list[float | None]()
    for located in seen.flight.frames:
        answer = located.stages.get(name)
        place = None if answer is None else answer.place
        if name in ("corrected", "tag"):
            place = None if located.by_hand is None else located.middle(located.by_hand)
            place = located.tag if name == "tag" else place
        x.append(None if place is None else round(float(place[0]), 2))
        y.append(None if place is None else round(float(place[1]), 2))
        states.append(0 if name in ("corrected", "tag") else -1 if answer is None else _STATES[answer.state])
        radii.append(None if answer is None or answer.state == "refused" else _number(answer.radius, 2))
    label, method = text.TRACKS[name]
    return {"label": label, "method": method, "x": x, "y": y, "state": states, "radius": radii}


def spot(seen: FlightSnapshot, point: tuple[float, float]) -> dict[str, Any]:
    """Return a point of the map with the frames that show it."""
    shown = list(seen_by(seen.outlines, *point))
    unknown = sum(one is None for one in seen.outlines)
    sentence = f"{len(shown)} of {counted(len(seen.outlines), 'photo')} show {text.place(seen.flight, point)[0]}."
    if unknown:
        sentence += f" The ground of {counted(unknown, 'photo')} is unknown."
    return {"spot": point, "frames": shown, "sentence": sentence}


def chosen(seen: FlightSnapshot, frame: int, addresses: Mapping[str, Any], saves: int = 0) -> dict[str, Any]:
    """Return the shown photo as data to draw.

    Args:
        saves: the number of this tab's saved corrections; the script waits for a change of it.
    """
    located = seen.flight.frames[frame]
    laid, ground = located.laid, ground_window(located, seen.verdicts[frame].stage)
    return {
        "frame": frame,
        "photo": f"{addresses['photo']}{frame}",
        "square": f"{addresses['square']}{frame}",
        # The browser caches the picture, so its address changes with its content.
        "ground": ""
        if ground is None
        else f"{addresses['ground']}{frame}?{ground.x:.0f}_{ground.y:.0f}_{ground.size:.0f}",
        "card": card(seen, frame),
        "homography": None if laid is None else laid.ravel().tolist(),
        "pins": [] if laid is None else pins(laid, located),
        "corrected": located.by_hand is not None,
        "size": [located.frame.width, located.frame.height],
        "saves": saves,
    }


def card(seen: FlightSnapshot, frame: int) -> dict[str, Any]:
    """Return a photo's verdict, and its reasons line by line."""
    flight, located, verdict = seen.flight, seen.flight.frames[frame], seen.verdicts[frame]
    answer = located.stages.get(verdict.stage or "")
    at = None if answer is None else answer.place
    lines = [text.first_sentence(verdict.reason), text.agreement(located), text.drone(flight, located)]
    if located.by_hand is not None:
        lines.append(f"✎ By hand: {text.place(flight, located.middle(located.by_hand))[0]}.")
    facts = [f"{frame + 1} of {len(flight.frames)}"]
    if (height := located.frame.flying_height) is not None:
        facts.append(f"{height:.0f} m high")
    if answer is not None and (error := seen.measured.frames[frame].error(answer)) is not None:
        truth = "its GPS tag" if seen.lag is None else "its GPS tag without the lag"
        if located.by_hand is not None and (located.by_hand.camera or not answer.camera):
            truth = "its correction"
        facts.append(f"{error:.1f} m from {truth}")
    told, link = ("", "") if at is None else text.place(flight, at)
    return {
        "name": printable(located.frame.name),
        "facts": facts,
        "state": text.state(verdict),
        "mark": text.mark(verdict),
        "headline": verdict.headline,
        "stage": verdict.stage,
        "what": "Below the drone" if answer is not None and answer.camera else "Middle of the photo",
        "at": told,
        "link": link,
        "lines": [line for line in lines if line],
    }


def pins(laid: Float64Array, located: LocatedFrame) -> list[list[float]]:
    """Return the positions of a photo's matched details, and their offsets to the map's details, in metres."""
    answer = located.stages.get("registration")
    if answer is None or answer.details is None or answer.matrix is None:
        return []
    size = located.frame.width, located.frame.height
    places = apply_homography(laid, answer.details.places * size - 0.5)
    on_map = answer.details.on_map(answer.matrix, *size)
    return _rounded(np.hstack([places, on_map - places]))


def answer_window(seen: FlightSnapshot, tile: int) -> list[float] | None:
    """Return centre and side, in metres, of a window of the retrieval."""
    retrieval = seen.flight.retrieval
    if retrieval is None or tile >= len(retrieval.gallery.windows):
        return None
    return [*retrieval.gallery.places[tile].tolist(), float(retrieval.gallery.sizes[tile])]


def painting(seen: FlightSnapshot, ranking: Ranking, painted: str, part_names: Sequence[str]) -> dict[str, Any] | None:
    """Return the picture of all windows' scores for the shown photo; None for "off", or without windows.

    Args:
        painted: "all" for all parts under the current weights, or a part's number, whose cosine is then painted.
    """
    retrieval = seen.flight.retrieval
    if painted == "off" or retrieval is None:
        return None
    values: FloatingArray = ranking.scores if painted == "all" else ranking.cosines[:, int(painted)]
    gallery, ranked = retrieval.gallery, ranking.order  # the retrieval does not rank windows of other sizes
    drawn = score_map.score_map(gallery.places[ranked], gallery.sizes[ranked], values[ranked].astype(np.float64))
    if drawn is None:
        return None
    label = "score" if painted == "all" else f"cosine of {part_names[int(painted)]}"
    return {
        "picture": overlays.png_data_uri(overlays.heat_cells(drawn.cells, drawn.low, drawn.high)),
        "bounds": list(drawn.bounds),
        "label": f"{drawn.low:.2f} to {drawn.high:.2f}, {label}",
    }


def _number(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _rounded(points: FloatingArray) -> list[list[float]]:
    rounded: list[list[float]] = np.round(points, 2).tolist()
    return rounded
