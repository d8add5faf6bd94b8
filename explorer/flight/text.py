"""The sentences of the flight panel about a flight, its accuracy, and one photo of it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from explorer.flight.service import FlightSnapshot
from lpn.core.files import printable
from lpn.core.numbers import SIGMA, error_figure, upper_bound
from lpn.drawing.verdicts import compass
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.belief import SIGMAS, Belief, Disagreement, on_what
from lpn.flight.locate.camera_pose import CameraPose
from lpn.flight.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.flight.locate.measures import CONFIRMED_SHARE, RIGHT_CALIBRATION
from lpn.flight.locate.summary import PLACED, FlightAccuracy, flight_accuracy, is_unchecked, other_map, share_within
from lpn.flight.maps.named_window import describe_offset

LABELS = {
    "tag": "GPS tags",
    "retrieval": "Retrieval",
    "sequence": "Sequence",
    "registration": "Registration",
    "corrected": "By hand",
}
# How each track places a photo.
METHODS = {
    "tag": "The positions in the photos' files.",
    "retrieval": "The most similar window of the map; nothing verifies it.",
    "sequence": "The path of the flight through similar windows.",
    "registration": "Points of the photo matched on the map.",
    "corrected": "Places that a person has corrected.",
}
# The states of a photo's place: sign, and words.
STATES = {
    "right": "✓ placed",
    "contradicted": "? in doubt",
    "unknown": "✗ not placed by its details",
}
WORST = "Photos in doubt (?) come first, then by distance from their GPS tag; guesses come last."
UNCHECKED = (
    "Registered photos of which too few places were found on the map to check that they fit away from their middle."
)
_MAP_ADVICE = "Uneven ground, the lens, or changes on the ground can do this; the middle may still be right."


def counts(seen: FlightSnapshot) -> str:
    """Say how many photos are placed, in doubt, guessed, and refused."""
    stages = [verdict.stage for verdict in seen.beliefs]
    ways = [f"{stages.count(stage):,} {words[1]}" for stage, words in PLACED.items() if stage in stages]
    placed = sum(stage in PLACED for stage in stages)
    doubted = sum(verdict.in_doubt for verdict in seen.beliefs)
    pieces = [f"{placed:,} placed" + (f" ({', '.join(ways)})" if ways else "")]
    pieces += [f"{doubted:,} in doubt"] if doubted else []
    rest = {"guessed": stages.count("retrieval"), "refused": stages.count(None)}
    pieces += [f"{count:,} {word}" for word, count in rest.items() if count]
    return f"{len(stages):,} photos: {', '.join(pieces)}. {other_map(seen.flight)}".strip()


def refusals(located: LocatedFrame) -> list[str]:
    """Return the refusals of all stages."""
    return [text for stage in located.stages if (text := refusal(located, stage)) is not None]


def refusal(located: LocatedFrame, stage: str) -> str | None:
    """Return that a stage's answer is refused, and why; None if it is not."""
    answer = located.stages.get(stage)
    refused = answer is not None and answer.state == "refused"
    return f"{LABELS[stage]}: refused. {answer.sentence}" if answer is not None and refused else None


def headline(verdict: Belief, located: LocatedFrame) -> str:
    """Return the verdict on a photo in some words; a photo that is not checked elsewhere is placed by its middle alone."""
    middle = verdict.stage == "registration" and verdict.sign and is_unchecked(located)
    return f"{verdict.headline}, at least its middle" if middle else verdict.headline


def reason(seen: FlightSnapshot, frame: int) -> str:
    """Return the grounds of the verdict on a frame; "" where they are those of a stage that refuses."""
    located, verdict = seen.flight.frames[frame], seen.beliefs[frame]
    if any(one.state == "refused" and one.sentence.endswith(verdict.reason) for one in located.stages.values()):
        return ""
    against = (one for one in seen.contradictions if one.frame == frame and one.other == "map")
    return next((contradiction(seen, one) for one in against if one.sentence == verdict.reason), verdict.reason)


def contradiction(seen: FlightSnapshot, one: Disagreement) -> str:
    """Say what contradicts a photo's answer, and by how much; where the map does, harmless causes are named, too."""
    answer = seen.flight.frames[one.frame].stages.get("registration")
    measured = None if answer is None else answer.agreement
    if one.other != "map" or measured is None or measured.largest is None:
        return one.sentence
    metres, allowed = one.figures
    return f"{_checked(measured, metres)} Allowed: {allowed} m. {_MAP_ADVICE}"


def agreement(seen: FlightSnapshot, frame: int, measured: MapAgreement) -> str:
    """Say how far places of a photo lie from where the map has them, or that too few of them tell."""
    if measured.median is None:
        return f"Not checked: {measured.unchecked[:1].lower()}{measured.unchecked[1:]}"
    text = _checked(measured, f"{measured.median:.1f}")
    answer = seen.flight.frames[frame].stages.get("registration")
    if seen.corrected(frame) is not None or answer is None or answer.middle_on_map is None:
        return text
    if any((one.frame, one.other) == (frame, "map") for one in seen.contradictions):
        return ""  # the verdict says it
    return f"✓ {text} Allowed: {upper_bound(SIGMAS * answer.middle_on_map)} m."


def _checked(measured: MapAgreement, median: str) -> str:
    least = "at least " if measured.may_be_larger else ""
    side = _side(*measured.places[measured.metres.argmax()].tolist())
    return (
        f"Checked at {len(measured.rows)} places away from its middle: {median} m off in the median, "
        f"{least}{measured.largest:.1f} m {side}."
    )


def _side(across: float, down: float) -> str:
    """Return where in a picture a place lies, given as shares of its width and height."""
    row = "upper" if down < 1 / 3 else "lower" if down > 2 / 3 else ""
    column = "left" if across < 1 / 3 else "right" if across > 2 / 3 else ""
    if row and column:
        return f"at the {row} {column}"
    return f"at the {column or {'upper': 'top', 'lower': 'bottom'}[row]}" if row or column else "near the middle"


def worst(seen: FlightSnapshot) -> list[tuple[int, str, list[str]]]:
    """Return frame, name, and words of each photo that has a place, the worst first.

    Contradicted ones are first, by the ratio of their metres to what is allowed; then placed ones by their metres from the
    GPS tag, or their radii; guesses are last.
    """
    doubts: dict[int, list[Disagreement]] = {}
    for one in seen.contradictions:
        doubts.setdefault(one.frame, []).append(one)
    placed = []
    for i, (located, verdict) in enumerate(zip(seen.flight.frames, seen.beliefs, strict=True)):
        if verdict.stage is None:
            continue
        against = [one for one in doubts.get(i, ()) if verdict.in_doubt and one.one == "registration"]
        against = [one for one in against if one.other != "sequence"] or against
        answer, error = located.stages[verdict.stage], located.error(verdict.stage)
        excess = max((one.metres / max(one.allowed, 0.1) for one in against), default=0.0)
        order = (verdict.stage in PLACED, excess, -1.0 if error is None else error, answer.radius or 0.0)
        told = {
            one.other: (
                f"{one.figures[1]} m allowed"
                if one.other == "tag"
                else f"{one.figures[0]} m, {one.figures[1]} m allowed"
            )
            for one in against
        }
        allowed = f" ({told.pop('tag')})" if "tag" in told else ""
        words = [] if error is None else [f"{error:.1f} m from {_truth(located)}{allowed}"]
        words += [LABELS[verdict.stage].lower(), "not verified" if answer.radius is None else radius(answer)]
        names = {"map": "away from its middle", "sequence": "from its place by sequence"}
        words += [f"{names[other]} {figures}" for other, figures in told.items()]
        if verdict.stage == "registration" and is_unchecked(located):
            words.append("not checked away from its middle")
        placed.append((order, i, printable(located.frame.name), [("? " if against else "") + ", ".join(words)]))
    placed.sort(key=lambda one: one[0], reverse=True)
    return [(i, name, lines) for _, i, name, lines in placed]


def _truth(located: LocatedFrame) -> str:
    return "the correction by hand" if located.by_hand else "its GPS tag"


def radius(answer: StageRecord) -> str:
    """Return the radius of an answer, which must have one, and on what."""
    return f"± {answer.radius:.1f} m {on_what(answer)}"


def place(flight: LocatedFlight, point: tuple[float, float]) -> tuple[str, str]:
    """Return a point on a flight's map in words, and its address on OpenStreetMap; "" for a rendered flight's."""
    if flight.rendered:
        return f"{describe_offset(*point)} (rendered, no real place)", ""
    latitude, longitude = (f"{value:.6f}" for value in flight.basemap.frame.degrees([point])[0].tolist())
    address = f"https://www.openstreetmap.org/?mlat={latitude}&mlon={longitude}#map=18/{latitude}/{longitude}"
    return f"latitude {latitude}, longitude {longitude}", address


def drone(flight: LocatedFlight, located: LocatedFrame) -> str:
    """Say where the drone was and how its camera was tilted, by the pose of a registered photo; "" without one.

    A place that is the answer's own is not said again.
    """
    answer = located.stages.get("registration")
    pose = None if answer is None or not answer.accepted else answer.pose
    if answer is None or pose is None:
        return ""
    text = "Drone: there"
    if not answer.camera:
        off = math.hypot(pose.radius, answer.map_error)
        text = f"Drone: {place(flight, (pose.east, pose.north))[0]} {_error(off, f' m {on_what(answer)}')}"
        if located.tag is not None:
            metres = math.hypot(pose.east - located.tag[0], pose.north - located.tag[1])
            text += f", {metres:.1f} m from its GPS tag"
    height = pose.altitude if pose.flat else pose.height
    if height is not None:
        text += f", {height:.0f} m above the ground {_error(pose.sigmas[2], ' m', 0)}"
    if answer.camera and not answer.by_pose:
        return f"{text}. Its place rests on the tilt in the photo's file."
    flat = " The map has no heights; over flat ground, tilt and shift look nearly alike."
    return f"{text}. {_tilt_of(pose)}{flat if pose.flat else ''}"


def _tilt_of(pose: CameraPose) -> str:
    tilt = pose.tilt
    if tilt.degrees < tilt.error:
        return f"Its camera looked straight down, to within {upper_bound(tilt.error)}°."
    where = compass(tilt.azimuth)
    return f"Its camera looked {tilt.degrees:.1f}° {_error(tilt.error, '°')} away from straight down, to the {where}."


def _error(value: float, unit: str, digits: int = 1) -> str:
    return f"(±\N{NO-BREAK SPACE}{value:.{digits}f}{unit})"


def accuracy(seen: FlightSnapshot) -> list[tuple[str, str, str]]:
    """Return three rows on the accuracy of the places: what, its figure, and its source; none without a placed photo."""
    flight, known = seen.flight, flight_accuracy(seen.flight, seen.beliefs)
    if known is None:
        return []
    rows = [("On this map", f"± {_radius_on_map(known):.1f} m", _on_map(seen, known)), _on_earth(flight, known)]
    if seen.errors is not None:
        bound = f"at most {upper_bound(seen.errors.largest)} m"
        rows.append(("GPS tags", f"{seen.errors.median:.1f} m", f"Median of {seen.errors.photos} photos"
                     f"{share_within(seen.errors)}, {bound}: the error of place and tag together."))  # fmt: skip
    return rows


def _radius_on_map(known: FlightAccuracy) -> float:
    return math.sqrt(max(known.radius**2 - (known.place_error or 0.0) ** 2, 0.0))


def _on_map(seen: FlightSnapshot, known: FlightAccuracy) -> str:
    text = f"{SIGMA[:1].upper()}{SIGMA[1:]}, the median of {known.photos} photos."
    if known.details is not None and known.map_error:
        assumed = math.sqrt(max(known.map_error**2 - (known.place_error or 0.0) ** 2, 0.0))
        text += f" Details give ± {known.details:.1f} m"
        text += f", and the map is taken as ± {error_figure(assumed)} m (lpn map --error)." if assumed else "."
    return " ".join(filter(None, (text, _unconfirmed(seen.flight), _unfit(seen))))


def _unconfirmed(flight: LocatedFlight) -> str:
    """Return that radii do not hold against the GPS tags; "" if they hold, or no tag tells."""
    summary = flight.registration_summary
    if summary is None or not summary.calibration or summary.calibration[3] >= CONFIRMED_SHARE:
        return ""
    return (
        f"Not confirmed: {summary.calibration[3]:.0f} % of the tags lie within 3 radii, where "
        f"{RIGHT_CALIBRATION[3]:.0f} % should; tags or radii fail."
    )


def _unfit(seen: FlightSnapshot) -> str:
    """Return how many photos do not fit the map away from their middle; "" if none is known not to."""
    answers = [located.stages.get("registration") for located in seen.flight.frames]
    compared = [one for one in answers if one is not None and one.agreement is not None and one.agreement.median]
    unfit = sum(one.other == "map" for one in seen.contradictions)
    return f"{unfit} of {len(compared)} photos do not fit the map away from their middle." if unfit else ""


def _on_earth(flight: LocatedFlight, known: FlightAccuracy) -> tuple[str, str, str]:
    """Return the row on how well the place of the map itself is known."""
    value = "" if known.place_error is None else f"± {error_figure(known.place_error)} m"
    if flight.rendered:
        source = "The map is rendered, and shows no real place."
    elif known.map_source:
        source = known.map_source
    elif known.place_error is not None:
        source = "The map was surveyed; lpn map --error tells its error."
    else:
        source = "As good as the map's georeference, whose error nobody has told."
    return "On earth", value, source


def notes(seen: FlightSnapshot) -> list[str]:
    """Return the remarks on photos and map."""
    flight = seen.flight
    left_out = [f"Corrections are left out: {seen.corrections_error}"] if seen.corrections_error else []
    return [*flight.notes, *flight.flight.notes, *flight.basemap.notes, *left_out]


def audit(flight: LocatedFlight) -> str:
    """Return what the audit of the tags found, and how many errors lie within the radii."""
    summary = flight.registration_summary
    proof = None if summary is None else summary.calibration_sentence("registration")
    return " ".join(filter(None, ("" if flight.audit is None else flight.audit.sentence, proof)))


def circle(flight: LocatedFlight) -> str:
    """Say what the circle around a photo's place means, and if the tags of the flight confirm it."""
    text = f"Circle: the radius, {SIGMA}; it holds {RIGHT_CALIBRATION[1]:.0f} of 100 true places if errors are as estimated."
    unconfirmed = flight.radii_confirmed.get("registration") is False
    return f"{text} The flight's tags do not confirm that." if unconfirmed else text


def spot(flight: LocatedFlight, shown: Sequence[int], unknown: int, point: tuple[float, float]) -> str:
    """Say how many photos show a spot."""
    text = f"{len(shown)} of {len(flight.frames)} photos show {place(flight, point)[0]}."
    return f"{text} The ground of {unknown} photos is unknown." if unknown else text
