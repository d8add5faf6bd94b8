"""A flight and one of its photos as JSON for the panel's script."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from explorer.flight import text
from explorer.flight.pictures import TilePyramid, ground_window
from explorer.flight.service import FlightSnapshot
from lpn.core.arrays import Float64Array, FloatingArray
from lpn.core.files import printable
from lpn.core.homography import apply_homography
from lpn.core.numbers import heading_figure
from lpn.drawing import overlays, score_map, theme
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.belief import Belief
from lpn.flight.locate.coverage import seen_by
from lpn.flight.locate.located import LocatedFrame
from lpn.flight.locate.summary import PLACED, unchecked_frames
from lpn.retrieval import Ranking

# Length of the lists of photos.
_MOST = 200
_COLOURS = ("tag", "retrieval", "sequence", "registration", "right", "contradicted", "unknown", "accent")
_STATES = {"accepted": 0, "not verified": 1, "refused": 2}
# A photo of a list: its number, its name, and lines about it.
_Entry = tuple[int, str, Sequence[str]]


def data(seen: FlightSnapshot, addresses: Mapping[str, Any]) -> dict[str, Any]:
    """Return all that is drawn of a flight.

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
    corrected = ["corrected"] if any(seen.corrected(i) for i in range(len(frames))) else []
    main = Counter(verdict.stage for verdict in seen.beliefs if verdict.stage is not None).most_common(1)
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
        "heights": [_number(frame.frame.flying_height, 2) for frame in frames],
        "outlines": [None if one is None else [*_rounded(one.corners), one.registered] for one in seen.outlines],
        "tracks": {name: _track(seen, name) for name in ("tag", *flight.stages, *corrected)},
        "colours": colours | {"corrected": theme.css(theme.COLOURS["by-hand"])},
        "bar": overlays.png_data_uri(overlays.heat_cells(np.linspace(0, 1, 128)[None], 0, 1)),
        "elsewhere": flight.elsewhere,
        "signs": [verdict.sign for verdict in seen.beliefs],
        "stages": [verdict.stage for verdict in seen.beliefs],
        "states": [state(verdict) for verdict in seen.beliefs],
        "words": text.STATES,
        "circle": text.circle(flight),
        "main": main[0][0] if main else "tag",
        "counts": text.counts(seen),
        "accuracy": text.accuracy(seen),
        "lists": _lists(seen),
    }


def state(verdict: Belief) -> str:
    """Return the name of the colour of what may be believed of a photo: "right", "contradicted", or "unknown"."""
    return theme.placed_name(verdict.sign, verdict.stage == "registration")


def _track(seen: FlightSnapshot, name: str) -> dict[str, Any]:
    """Return a track: x, y, state, radius, error, and reason of each frame, None where unknown.

    The state is -1 while the stage has no answer; a tag counts as accepted. Refused and contradicted answers have reasons.
    """
    rows: list[tuple[float | None, float | None, int, float | None, float | None]] = []
    frames = seen.flight.frames
    for i, located in enumerate(frames):
        answer = located.stages.get(name)
        if name in ("corrected", "tag"):
            place = seen.corrected(i) if name == "corrected" else located.tag
            x, y = (None, None) if place is None else (float(place[0]), float(place[1]))
            known = name == "corrected" and place is not None and located.tag is not None
            rows.append((x, y, 0, None, float(np.linalg.norm(located.tag - place)) if known else None))  # type: ignore[operator]
        elif answer is None:
            rows.append((None, None, -1, None, None))
        else:
            radius = None if answer.state == "refused" else answer.radius
            rows.append((answer.x, answer.y, _STATES[answer.state], radius, located.error(name)))
    columns = list(zip(*rows, strict=True)) or [()] * 5
    states = list(columns[2])
    reasons = [text.refusal(located, name) for located in frames]
    count = f"{sum(x is not None for x in columns[0])} of {len(frames)}"
    if name in seen.flight.stages:
        count = "" if 1 in states else f"{states.count(0)} of {len(frames)}"
    if name == "registration":
        doubted = sum(verdict.in_doubt for verdict in seen.beliefs)
        count += f", {doubted} in doubt" if doubted else ""
        for one in seen.contradictions:
            if one.one == name and seen.beliefs[one.frame].sign is None:
                reasons[one.frame] = " ".join(filter(None, (reasons[one.frame], text.contradiction(seen, one))))
    # Two digits more than are shown: rounded twice, a figure would differ from that of the card.
    numbers = {
        key: [_number(value, 4) for value in column]
        for key, column in zip(("x", "y", "radius", "error"), (*columns[:2], *columns[3:]), strict=True)
    }
    told = {"label": text.LABELS[name], "method": text.METHODS[name], "count": count}
    return told | numbers | {"state": states, "reason": reasons}


def _lists(seen: FlightSnapshot) -> dict[str, Any]:
    """Return the lists of photos by their names."""
    flight = seen.flight
    frames = list(enumerate(zip(flight.frames, seen.beliefs, strict=True)))

    def entry(i: int, lines: Sequence[str]) -> _Entry:
        return i, printable(flight.frames[i].frame.name), lines

    refused = [
        entry(i, text.refusals(located) or [verdict.reason])
        for i, (located, verdict) in frames
        if verdict.stage not in PLACED
    ]
    partly = [
        entry(i, ["Placed, though another stage is refused.", *told])
        for i, (located, verdict) in frames
        if verdict.stage in PLACED and (told := text.refusals(located))
    ]
    unchecked = [
        entry(i, [text.agreement(seen, i, measured)])
        for i in unchecked_frames(flight.frames, seen.beliefs)
        if (measured := flight.frames[i].stages["registration"].agreement) is not None
    ]
    apart = [entry(one.frame, [text.contradiction(seen, one)]) for one in seen.contradictions]
    contradicted = len({one.frame for one in seen.contradictions})
    fits = "Registration, sequence, and tags agree within their radii."
    return {
        "refused": _list("Not placed", [*refused, *partly], "" if refused else "Every photo is placed.", len(refused)),
        "audit": _list("Audit", apart, text.audit(flight) if apart else fits, contradicted),
        "unchecked": _list("Not checked", unchecked, text.UNCHECKED, len(unchecked)),
        "worst": _list("Worst first", text.worst(seen), text.WORST),
        "notes": {"title": "Notes", "sentence": "\n".join(text.notes(seen)) or "No notes.", "entries": [], "total": 0},
    }


def _list(title: str, entries: Sequence[_Entry], sentence: str, count: int | None = None) -> dict[str, Any]:
    title = title if count is None else f"{title} {count}"
    return {"title": title, "sentence": sentence, "entries": entries[:_MOST], "total": len(entries)}


def spot(seen: FlightSnapshot, point: tuple[float, float]) -> dict[str, Any]:
    """Return a spot with the list of the frames that show it."""
    shown = list(seen_by(seen.outlines, *point))
    entries = [
        (
            i,
            printable(seen.flight.frames[i].frame.name),
            ["by its registration" if one is not None and one.registered else "by its tag and the camera's angles"],
        )
        for i in shown
        for one in [seen.outlines[i]]
    ]
    sentence = text.spot(seen.flight, shown, sum(one is None for one in seen.outlines), point)
    return {"spot": point, "frames": shown, "list": _list("Spot", entries, sentence)}


def chosen(
    seen: FlightSnapshot, frame: int, addresses: Mapping[str, Any], agreement: MapAgreement | None, saves: int = 0
) -> dict[str, Any]:
    """Return what is drawn of the chosen frame, with its card.

    Args:
        agreement: of places of the photo with the map; None where it was not compared.
        saves: corrections that this tab has saved; it keeps its tie points until the number changes.
    """
    located = seen.flight.frames[frame]
    laid = seen.homography(frame)
    ground = ground_window(located, seen.beliefs[frame].stage)
    return {
        "frame": frame,
        "photo": f"{addresses['photo']}{frame}",
        "square": f"{addresses['square']}{frame}",
        # The address changes with what it shows, as the browser keeps the picture.
        "ground": ""
        if ground is None
        else f"{addresses['ground']}{frame}?{ground.x:.0f}_{ground.y:.0f}_{ground.size:.0f}",
        "card": _card(seen, frame, agreement),
        "homography": None if laid is None else laid.ravel().tolist(),
        "pins": [] if laid is None else pins(laid, located),
        "corrected": seen.corrected(frame) is not None,
        "size": [located.frame.width, located.frame.height],
        "saves": saves,
    }


def _card(seen: FlightSnapshot, frame: int, agreement: MapAgreement | None) -> dict[str, Any]:
    flight, located, verdict = seen.flight, seen.flight.frames[frame], seen.beliefs[frame]
    stage = verdict.stage
    answer = None if stage is None else located.stages[stage]
    at = None if answer is None or answer.x is None or answer.y is None else (answer.x, answer.y)
    ground = ground_window(located, stage)
    lines = [text.reason(seen, frame), *(f"✗ {one}" for one in text.refusals(located))]
    lines.append("" if agreement is None else text.agreement(seen, frame, agreement))
    lines.append(text.drone(flight, located))
    if ground is not None and answer is not None and answer.accepted:
        share = float(flight.basemap.valid_shares(np.array([(ground.x, ground.y)]), ground.size)[0])
        lines.append(f"The map shows only {100 * share:.0f} % of this photo's ground." if share < 0.5 else "")
    if (by_hand := seen.corrected(frame)) is not None:
        apart = "" if at is None else f", {math.dist(at, by_hand):.1f} m from its answer"
        lines.append(f"✎ By hand: {text.place(flight, by_hand)[0]}{apart}.")
    facts = [f"{frame + 1} of {len(flight.frames)}"]
    if (height := located.frame.flying_height) is not None:
        facts.append(f"{height:.0f} m high")
    if answer is not None and stage == "registration" and (heading := heading_figure(answer.heading)) is not None:
        facts.append(f"top points to {heading}°")
    return {
        "name": printable(located.frame.name),
        "facts": facts,
        "sign": verdict.sign,
        "state": state(verdict),
        "headline": text.headline(verdict, located),
        "stage": stage,
        **where(seen, at, answer is not None and answer.camera),
        "lines": lines_of(lines),
    }


def where(seen: FlightSnapshot, at: tuple[float, float] | None, camera: bool) -> dict[str, Any]:
    """Return a photo's place in words, with a link; `camera` says that it is below the drone."""
    told, link = ("", "") if at is None else text.place(seen.flight, at)
    return {"what": "Below the drone" if camera else "Middle of the photo", "at": told, "link": link}


def lines_of(lines: Iterable[str]) -> list[str]:
    """Return the sentences that say something."""
    return [line for line in lines if line]


def pins(laid: Float64Array, located: LocatedFrame) -> list[list[float]]:
    """Return where a laid photo has its matched details, and from there to where the map has them, in metres."""
    answer = located.stages.get("registration")
    if answer is None or not answer.accepted or answer.details is None or answer.homography is None:
        return []
    size = located.frame.width, located.frame.height
    places = apply_homography(laid, answer.details.places * size - 0.5)
    on_map = answer.details.on_map(np.array(answer.homography).reshape(3, 3), *size)
    return _rounded(np.hstack([places, on_map - places]))


def answer_window(seen: FlightSnapshot, tile: int) -> list[float] | None:
    """Return centre and side, in metres, of a window of the retrieval."""
    retrieval = seen.flight.retrieval
    if retrieval is None or tile >= len(retrieval.windows):
        return None
    return [float(retrieval.places[tile, 0]), float(retrieval.places[tile, 1]), float(retrieval.sizes[tile])]


def painting(seen: FlightSnapshot, ranking: Ranking, painted: str, part_names: Sequence[str]) -> dict[str, Any] | None:
    """Return the picture of all windows' scores for the photo that is shown; None for "off", or without windows.

    Args:
        painted: "all" parts under the current weights, or a part's number, whose score is its cosine.
    """
    retrieval = seen.flight.retrieval
    if painted == "off" or retrieval is None:
        return None
    values: FloatingArray = ranking.scores if painted == "all" else ranking.cosines[:, int(painted)]
    ranked = ranking.order  # without windows of other sizes, which the retrieval does not rank
    drawn = score_map.score_map(retrieval.places[ranked], retrieval.sizes[ranked], values[ranked].astype(np.float64))
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
