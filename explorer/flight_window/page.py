"""HTML and data of the flight window. The page's script draws the map, the tracks, and the timeline from the data."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from explorer.compute.background_jobs import BackgroundJob
from explorer.flight_window import flight_text
from explorer.flight_window.pictures import Pyramid, ground_window
from explorer.flight_window.service import FlightView
from explorer.panels import answer_text
from explorer.panels.radius_text import reach
from explorer.web.coordinates import MapCoordinate, describe_point
from explorer.web.render import call, progress_bar, render, run
from explorer.workspace import StateAnalysis
from lpn.core.arrays import Float64Array, FloatingArray
from lpn.core.files import printable
from lpn.core.homography import apply_homography
from lpn.core.numbers import heading_figure
from lpn.drawing import overlays, score_map, theme
from lpn.drawing.words import plain, say
from lpn.locate.agreement import MapAgreement
from lpn.locate.belief import Belief
from lpn.locate.located import LocatedFrame, StageRecord
from lpn.locate.summary import NOT_CHECKED, PLACED, describe_flight, unchecked_frames
from lpn.maps import Window
from lpn.maps.named_window import describe_offset

# The part whose cosines are painted, or all parts under the current weights.
Painted = int | Literal["all", "off"]
# Colours of the tracks on the map, which is bright or dark, as in the track files.
COLOURS = {name: theme.COLOURS[name] for name in ("tag", "retrieval", "sequence", "registration")} | {
    "corrected": theme.COLOURS["by-hand"]
}
# Length of the lists of refused and of contradicting frames.
_MAX_LISTED = 200
# A frame of a list: its number, its name, and lines about it.
_Entry = tuple[int, str, Sequence[str]]
_PARTLY = "Placed, though the answer of another method is refused"
_STATES = {"accepted": 0, "not verified": 1, "refused": 2}


def shell(part_names: Sequence[str], height: int, tall: bool = False, live: bool = False, alone: bool = False) -> str:
    """Return the elements that the script fills.

    Args:
        height: of the window in pixels.
        tall: on a phone, fill the whole screen.
        live: the flight goes on, so that nothing is corrected, and no scores are painted.
        alone: fill the page with map and photo, without the workbench and what is of the whole flight.
    """
    return render("flight/shell", part_names=part_names, height=height, tall=tall, live=live, alone=alone)


def data(view: FlightView, address: str) -> dict[str, Any]:
    """Return all that the script draws of a flight, as JSON takes it.

    Args:
        address: folder of the pictures, relative to the page.
    """
    flight = view.flight
    basemap, frames, pyramid = flight.basemap, flight.frames, Pyramid.of(flight.basemap)
    known = [frame.frame.time for frame in frames]
    sheets = [
        {
            "name": printable(sheet.name),
            "colour": theme.css(theme.part_colour(i)),
            "outline": _rounded(basemap.frame.xy(*sheet.outline.T)),
        }
        for i, sheet in enumerate(basemap.sheets)
    ]
    return {
        "address": address,
        "bounds": list(basemap.bounds),
        "pyramid": {"west": pyramid.west, "north": pyramid.north, "side": pyramid.side, "levels": pyramid.levels},
        "resolution": basemap.resolution,
        "degrees": None if flight.rendered else basemap.frame.polynomials(basemap.bounds).tolist(),
        "sheets": sheets if len(sheets) > 1 else [],
        "names": [printable(frame.frame.name) for frame in frames],
        "times": None if any(time is None for time in known) else known,
        "heights": [_number(frame.frame.flying_height, 2) for frame in frames],
        "outlines": [None if one is None else [*_rounded(one.corners), one.registered] for one in view.outlines],
        "tracks": {name: _track(view, name) for name in _tracks(view)},
        "methods": flight_text.methods(flight.stages),
        "bar": overlays.png_data_uri(overlays.heat_cells(np.linspace(0, 1, 128)[None], 0, 1)),
        "plain": plain(),
        "elsewhere": flight.elsewhere,
        "signs": [verdict.sign for verdict in view.beliefs],
        "stages": [verdict.stage for verdict in view.beliefs],
        "states": [_state(verdict) for verdict in view.beliefs],
        "circle": flight_text.circle(flight),
        "main": _main_stage(view),
    }


def _main_stage(view: FlightView) -> str:
    """Return the stage whose answers count for most photos; the tags where none counts."""
    counts = Counter(verdict.stage for verdict in view.beliefs if verdict.stage is not None)
    return counts.most_common(1)[0][0] if counts else "tag"


def _tracks(view: FlightView) -> list[str]:
    corrected = ["corrected"] if any(view.corrected(i) for i in range(len(view.flight.frames))) else []
    return ["tag", *view.flight.stages, *corrected]


def _track(view: FlightView, name: str) -> dict[str, Any]:
    """Return a track: x, y, state, radius, and error of each frame, None where unknown; a tag counts as accepted.

    The state is -1 while the stage has no answer. A refused answer has its reason, too, and so has a contradicted registration.
    """
    track: dict[str, Any] = {
        "label": flight_text.label(name),
        "mark": flight_text.mark(name),
        "colour": theme.css(COLOURS[name]),
    }
    rows: list[tuple[float | None, float | None, int, float | None, float | None]] = []
    flight = view.flight
    for i, located in enumerate(flight.frames):
        if name == "corrected":
            place = view.corrected(i)
            x, y = place or (None, None)
            error = None if place is None or located.tag is None else float(np.linalg.norm(located.tag - place))
            rows.append((x, y, 0, None, error))
            continue
        if name == "tag":
            x, y = (None, None) if located.tag is None else (float(located.tag[0]), float(located.tag[1]))
            rows.append((x, y, 0, None, None))
            continue
        answer = located.stages.get(name)
        if answer is None:
            rows.append((None, None, -1, None, None))
        else:
            # A refused place has none.
            radius = None if answer.state == "refused" or answer.radius is None else reach(answer.radius)
            rows.append((answer.x, answer.y, _STATES[answer.state], radius, located.error(name)))
    reasons = [flight_text.refusal(located, name) for located in flight.frames]
    if name == "registration":
        for one in view.contradictions:
            if one.one == name and view.beliefs[one.frame].sign is None:
                reasons[one.frame] = " ".join(filter(None, (reasons[one.frame], flight_text.contradiction(view, one))))
    track["reason"] = reasons
    columns = list(zip(*rows, strict=True)) or [()] * 5
    for key, values in zip(("x", "y", "state", "radius", "error"), columns, strict=True):
        # Two digits more than are shown: rounded twice, a figure would differ from that of the card.
        track[key] = list(values) if key == "state" else [_number(value, 4) for value in values]
    states, total = track["state"], len(flight.frames)
    if name in ("tag", "corrected"):
        track["count"] = f"{sum(x is not None for x in track['x'])} of {total}"
    elif 1 in states:
        track["count"] = ""
    else:
        doubted = sum(verdict.in_doubt for verdict in view.beliefs) if name == "registration" else 0
        track["count"] = f"{states.count(0)} of {total}" + (f", {doubted} in doubt" if doubted else "")
    return track


def card(
    view: FlightView,
    frame: int,
    address: str,
    retrieval_right: bool | None = None,
    agreement: MapAgreement | None = None,
) -> str:
    """Return the query, the answer, and the verdict for the chosen frame.

    Args:
        retrieval_right: whether the page's other panels call the answer of retrieval right; None where they cannot tell.
        agreement: of places of the photo with the map; None where it was not compared.
    """
    located = view.flight.frames[frame]
    verdict = view.beliefs[frame]
    stage = verdict.stage
    place = None if stage is None else located.stages[stage]
    at: MapCoordinate | str | None = None
    if place is not None and place.x is not None and place.y is not None:
        at = MapCoordinate.on_map(view.flight, (place.x, place.y)) or describe_offset(place.x, place.y)
    ground = ground_window(located, stage)
    beside = "" if agreement is None else flight_text.agreement(view, frame, agreement)
    return render(
        "flight/card",
        frame=frame,
        total=len(view.flight.frames),
        name=printable(located.frame.name),
        address=address,
        verdict=verdict,
        headline=_headline(verdict, located),
        colour=f"var(--mark-{_state(verdict)})",
        reason=flight_text.reason(view, frame),
        refusals=flight_text.refusals(located),
        drone=flight_text.drone(view.flight, located),
        agreement=beside,
        unchecked=agreement is not None and bool(agreement.unchecked),
        place=place,
        at=at,
        ground=ground,
        on_map=None if ground is None else _share_on_map(view, ground),
        height=located.frame.flying_height,
        heading=None if place is None or stage != "registration" else heading_figure(place.heading),
        corrected=_correction(view, frame, place),
        look_right=retrieval_right if stage in PLACED else None,
        judge=view.flight.judge_of(frame),
    )


def _headline(verdict: Belief, located: LocatedFrame) -> str:
    text = verdict.summary if plain() else verdict.headline
    return answer_text.checked(text, located, verdict.sign) if verdict.stage == "registration" else text


def _share_on_map(view: FlightView, ground: Window) -> float:
    """Return the share of a photo's ground that the map shows, 0 to 1."""
    return float(view.flight.basemap.valid_shares(np.array([(ground.x, ground.y)]), ground.size)[0])


def _correction(view: FlightView, frame: int, place: StageRecord | None) -> tuple[str, float | None] | None:
    """Return where a correction is, in words, and the metres from it to the answer that counts."""
    corrected = view.corrected(frame)
    if corrected is None:
        return None
    words = describe_point(view.flight, corrected)
    if place is None or place.x is None or place.y is None:
        return words, None
    return words, math.hypot(place.x - corrected[0], place.y - corrected[1])


def _state(verdict: Belief) -> str:
    """Return the name of the colour of what may be believed of a photo, see `theme.placed_name`."""
    return theme.placed_name(verdict.sign, verdict.stage == "registration")


def chosen(
    view: FlightView,
    frame: int,
    address: str,
    saves: int = 0,
    retrieval_right: bool | None = None,
    agreement: MapAgreement | None = None,
) -> dict[str, Any]:
    """Return what the script draws of the chosen frame.

    Args:
        saves: how many corrections of the page are saved; the page keeps its tie points until the number changes.
        retrieval_right, agreement: see `card`.
    """
    located = view.flight.frames[frame]
    laid = view.homography(frame)
    return {
        "frame": frame,
        "card": card(view, frame, address, retrieval_right, agreement),
        "homography": None if laid is None else laid.ravel().tolist(),
        "pins": [] if laid is None else pins(laid, located),
        "corrected": view.corrected(frame) is not None,
        "size": [located.frame.width, located.frame.height],
        "saves": saves,
    }


def pins(laid: Float64Array, located: LocatedFrame) -> list[list[float]]:
    """Return where a laid photo has the numbered details of *Why?*, in their order, and from there to where the map has them.

    Both are metres east and north. A photo without an accepted registration has none.
    """
    answer = located.stages.get("registration")
    if answer is None or not answer.accepted or answer.details is None or answer.homography is None:
        return []
    size = located.frame.width, located.frame.height
    places = apply_homography(laid, answer.details.places * size - 0.5)
    on_map = answer.details.on_map(np.array(answer.homography).reshape(3, 3), *size)
    return _rounded(np.hstack([places, on_map - places]))


def progress(registration: BackgroundJob[None] | None, frames: int) -> str:
    """Return how far a registration of a number of frames is, or why it failed; empty without one."""
    if registration is None:
        return ""
    if registration.wait(0):
        return "" if registration.error is None else f"{_comparison()} failed: {registration.error}"
    work = "Comparing details with the map" if plain() else "Registering"
    done, total = registration.done, registration.total or frames
    return progress_bar(done, total, f"{work} {done}/{total}", "photos")


def _comparison() -> str:
    return "The comparison of details" if plain() else "Registration"


def sentence(view: FlightView, running: bool) -> str:
    """Say how the flight's photos were placed; `running` says that a registration goes on."""
    more = f" {_comparison()} is still running, so these numbers change." if running else ""
    return f"{describe_flight(view.flight, view.beliefs, view.errors)}{more}"


def accuracy(view: FlightView) -> str:
    """Return how accurate the flight's places are, and where each figure comes from; see `flight_text.accuracy`."""
    return render("flight/accuracy", known=flight_text.accuracy(view))


def answer_window(view: FlightView, analysis: StateAnalysis) -> list[float] | None:
    """Return centre and side, in metres, of the window that the stage compares with the query."""
    retrieval, tile = view.flight.retrieval, analysis.chosen.index
    if retrieval is None or tile >= len(retrieval.windows):
        return None
    return [float(retrieval.places[tile, 0]), float(retrieval.places[tile, 1]), float(retrieval.sizes[tile])]


def painting(
    view: FlightView, analysis: StateAnalysis, painted: Painted, part_names: Sequence[str]
) -> dict[str, Any] | None:
    """Return the picture of all windows' scores for the query that is shown, or None.

    Args:
        painted: all parts under the current weights, or one part, whose score is its cosine.
    """
    retrieval = view.flight.retrieval
    if painted == "off" or retrieval is None:
        return None
    ranking = analysis.ranking
    values: FloatingArray = ranking.scores if painted == "all" else ranking.cosines[:, painted]
    ranked = ranking.order  # without windows of other sizes, which the retrieval does not rank
    drawn = score_map.score_map(retrieval.places[ranked], retrieval.sizes[ranked], values[ranked].astype(np.float64))
    if drawn is None:
        return None
    cells = overlays.heat_cells(drawn.cells, drawn.low, drawn.high)
    return {
        "picture": overlays.png_data_uri(cells),
        "bounds": list(drawn.bounds),
        "low": f"{drawn.low:.2f}",
        "high": f"{drawn.high:.2f}",
        "label": say("score") if painted == "all" else f"{say('part cosine')} of {part_names[painted]}",
        "part": painted,
    }


def lists(view: FlightView) -> dict[str, str]:
    """Return the lists beside the map by their names, as HTML."""
    flight = view.flight
    refused = [
        (i, printable(located.frame.name), flight_text.refusals(located) or [view.beliefs[i].reason])
        for i, located in enumerate(flight.frames)
        if view.beliefs[i].stage not in PLACED
    ]
    partly = [
        (i, printable(located.frame.name), texts)
        for i, located in enumerate(flight.frames)
        if view.beliefs[i].stage in PLACED and (texts := flight_text.refusals(located))
    ]
    unchecked = [
        (i, printable(located.frame.name), [flight_text.agreement(view, i, told)])
        for i in unchecked_frames(flight.frames, view.beliefs)
        for located in [flight.frames[i]]
        if (told := located.stages["registration"].agreement) is not None
    ]
    apart = [
        (one.frame, printable(flight.frames[one.frame].frame.name), [flight_text.contradiction(view, one)])
        for one in view.contradictions
    ]
    notes = [*flight.notes, *flight.flight.notes, *flight.basemap.notes]
    if view.corrections_error:
        notes.append(f"Corrections are left out: {view.corrections_error}")
    summary = flight.registration_summary
    proof = None if summary is None else summary.calibration_sentence("registration")
    audit = " ".join(filter(None, ("" if flight.audit is None else flight.audit.sentence, proof)))
    if plain():  # the figures stand above the map
        audit = flight_text.EVIDENCE if apart else ""
    return {
        "refused": _list(
            refused, "", "Every photo is placed.", ("support", "registration") if refused else (), [(_PARTLY, partly)]
        ),
        "audit": _list(
            apart,
            audit,
            "All tracks agree within their errors."
            if plain()
            else "Registration, sequence, and tags agree within their radii.",
            ("tag", "radius", "median", "time lag", "offset") if audit else (),
        ),
        "unchecked": _list(
            unchecked, flight_text.UNCHECKED if unchecked else "", "Every photo by its details was checked."
        ),
        "worst": _list(flight_text.worst(view), flight_text.WORST, "No photo has a place."),
        "notes": render("flight/notes", notes=notes),
        "counts": render(
            "flight/counts",
            refused=len(refused),
            apart=len({one[0] for one in apart}),
            unchecked=len(unchecked),
            not_checked=NOT_CHECKED,
        ),
    }


def spot_list(view: FlightView, frames: Sequence[int], place: tuple[float, float]) -> str:
    """Return the list of the frames that show a spot."""
    entries = []
    for i in frames:
        one = view.outlines[i]
        details = "by its details" if plain() else "by its registration"
        source = details if one is not None and one.registered else "by its tag and the camera's angles"
        entries.append((i, printable(view.flight.frames[i].frame.name), [source]))
    unknown = sum(one is None for one in view.outlines)
    sentence = f"{len(frames)} of {len(view.outlines)} photos show {describe_point(view.flight, place)}."
    if unknown:
        sentence += f" The ground of {unknown} photos is unknown."
    return _list(entries, sentence, "")


def _list(
    entries: Sequence[_Entry],
    sentence: str,
    empty: str,
    terms: Sequence[str] = (),
    folded: Sequence[tuple[str, Sequence[_Entry]]] = (),
) -> str:
    """Return a list of frames; the page explains its `terms`, see `explorer.web.terms.term`.

    Args:
        folded: further lists, each below its title.
    """
    return render(
        "flight/list",
        entries=entries[:_MAX_LISTED],
        total=len(entries),
        folded=[(title, of) for title, of in folded if of],
        most=_MAX_LISTED,
        sentence=sentence,
        empty="" if entries else empty,
        terms=terms,
    )


def _number(value: float | None, digits: int) -> float | None:
    return None if value is None or not math.isfinite(value) else round(value, digits)


def _rounded(points: FloatingArray) -> list[list[float]]:
    rounded: list[list[float]] = np.round(points, 2).tolist()
    return rounded


def calls(values: Mapping[str, Any]) -> str:
    """Return HTML that hands values to the script's flight window, by the names of its functions."""
    return run("".join(f"{call(f'flight.{name}', value)};" for name, value in values.items()))
