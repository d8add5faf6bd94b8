"""The sentences of the flight panel about a flight, its accuracy, and one photo of it."""

from __future__ import annotations

import math
import re
from statistics import median

from explorer.flight.service import FlightSnapshot
from lpn.core.numbers import SIGMA, error_figure, upper_bound
from lpn.drawing.verdicts import compass
from lpn.flight.locate.agreement import MapAgreement
from lpn.flight.locate.belief import SIGMAS, Belief, is_unchecked, on_what, radii_on_map
from lpn.flight.locate.errors import CONFIRMED_SHARE, RIGHT_CALIBRATION
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.maps.named_window import describe_offset
from lpn.flight.maps.orthophoto import placing_sentence

# Each track: its name, and how it places a photo.
TRACKS = {
    "tag": ("GPS tags", "The positions in the photos' files."),
    "retrieval": ("Retrieval", "The most similar window of the map; nothing verifies it."),
    "sequence": ("Sequence", "The path of the flight through similar windows."),
    "registration": ("Registration", "Points of the photo matched on the map."),
    "corrected": ("By hand", "Places that a person has corrected."),
}
# Fewest distances whose 95th percentile is shown.
_FEWEST = 5
# The name of each state's colour, and its words.
STATES = {"right": "placed", "contradicted": "in doubt", "unknown": "not placed"}


def state(verdict: Belief) -> str:
    """Return the colour's name of a photo's state, see `STATES`; a guess by its neighbours places no photo."""
    return "right" if verdict.sign else "contradicted" if verdict.contradicted else "unknown"


def mark(verdict: Belief) -> str:
    """Return the sign of a photo's state: a question mark for a place by its neighbours, or one in doubt."""
    return "✓" if verdict.sign else "✗" if verdict.stage in (None, "retrieval") else "?"


def counts(seen: FlightSnapshot) -> str:
    """Count the placed, doubtful, and unplaced photos in a sentence."""
    states = [state(verdict) for verdict in seen.beliefs]
    pieces = [f"{states.count(name):,} {word}" for name, word in STATES.items() if name == "right" or name in states]
    text = f"{len(states):,} photos: {', '.join(pieces)}."
    if seen.flight.elsewhere:
        text += f" {seen.flight.elsewhere}: give the map of the tags' place, unless the tags are wrong."
    return text


def headline(verdict: Belief, located: LocatedFrame) -> str:
    """Return the verdict on a photo in a few words. A photo that is checked nowhere else is placed by its middle alone."""
    middle = verdict.stage == "registration" and verdict.sign and is_unchecked(located)
    return f"{verdict.headline}, at least its middle" if middle else verdict.headline


def reason(verdict: Belief) -> str:
    """Return the grounds of a verdict in one sentence."""
    return _first(verdict.reason)


def agreement(seen: FlightSnapshot, frame: int, measured: MapAgreement | None) -> str:
    """Say how far details of a photo lie from the map's, or that too few of them are known; "" without a search for them."""
    if measured is None or measured.largest is None:
        unchecked = "" if measured is None else _first(measured.unchecked)
        return unchecked and f"Not checked: {unchecked[:1].lower()}{unchecked[1:]}"
    least = "at least " if measured.may_be_larger else ""
    side = _side(*measured.places[measured.metres.argmax()].tolist())
    text = f"Checked at {len(measured.rows)} places: {measured.median:.1f} m off in the median"
    text += f", {least}{measured.largest:.1f} m {side}"
    answer = seen.flight.frames[frame].stages.get("registration")
    if seen.corrected(frame) is not None or answer is None or answer.middle_on_map is None:
        return f"{text}."
    return f"{text}; {upper_bound(SIGMAS * answer.middle_on_map)} m are allowed."


def _first(text: str) -> str:
    """Return the first sentence of a text; a full stop within a name, such as IMG. 12.jpg, does not end it."""
    return re.split(r"(?<=\.) (?=[A-Z])", text, maxsplit=1)[0]


def _side(across: float, down: float) -> str:
    """Name the side of a picture at which a place lies, given as shares of its width and height."""
    row = "upper" if down < 1 / 3 else "lower" if down > 2 / 3 else ""
    column = "left" if across < 1 / 3 else "right" if across > 2 / 3 else ""
    if row and not column:
        return "at the top" if row == "upper" else "at the bottom"
    return f"at the {row} {column}".replace("  ", " ") if column else "near the middle"


def place(flight: LocatedFlight, point: tuple[float, float]) -> tuple[str, str]:
    """Return a point on a flight's map in words, and its address on OpenStreetMap; "" for a rendered flight's."""
    if flight.rendered:
        return f"{describe_offset(*point)} (rendered, no real place)", ""
    latitude, longitude = (f"{value:.6f}" for value in flight.basemap.frame.degrees([point])[0].tolist())
    address = f"https://www.openstreetmap.org/?mlat={latitude}&mlon={longitude}#map=18/{latitude}/{longitude}"
    return f"{latitude}, {longitude}", address


def drone(flight: LocatedFlight, located: LocatedFrame) -> str:
    """Describe the drone's position and its camera's tilt by the pose of a registered photo; "" without one."""
    answer = located.stages.get("registration")
    pose = None if answer is None or not answer.accepted else answer.pose
    if answer is None or pose is None:
        return ""
    pieces = []
    if not answer.camera:
        off = math.hypot(pose.radius, answer.map_error)
        pieces.append(f"{place(flight, (pose.east, pose.north))[0]} (± {off:.1f} m {on_what(answer)})")
    height = pose.altitude if pose.flat else pose.height
    if height is not None:
        pieces.append(f"{height:.0f} m above the ground (± {pose.sigmas[2]:.0f} m)")
    tilt = pose.tilt
    if tilt.degrees < tilt.error:
        pieces.append(f"its camera straight down, to within {upper_bound(tilt.error)}°")
    else:
        side = compass(tilt.azimuth)
        pieces.append(f"its camera {tilt.degrees:.1f}° (± {tilt.error:.1f}°) from straight down, to the {side}")
    return f"The drone: {', '.join(pieces)}."


def accuracy(seen: FlightSnapshot) -> list[tuple[str, str, str]]:
    """Return three rows on the accuracy of the places: subject, figure, and source; none without a placed photo."""
    flight, radii = seen.flight, radii_on_map(seen.flight, seen.beliefs)
    if not radii:
        return []
    text = f"{SIGMA[:1].upper()}{SIGMA[1:]}, the median of {len(radii)} photos."
    rows = [("On this map", f"± {median(radii):.1f} m", f"{text} {_unconfirmed(seen)}".strip())]
    figure = f"± {error_figure(flight.place_error)} m" if flight.place_error else ""
    if flight.rendered:
        source = "The map is rendered, and shows no real place."
    elif told := placing_sentence(flight.basemap.notes):
        source = _first(told)
    else:
        source = (
            "The error that lpn map --error keeps."
            if figure
            else "As good as the map's georeference; its error is not told."
        )
    rows.append(("On Earth", figure, source))
    if (errors := seen.errors) is not None:
        name, with_lag = "GPS tags", ""
        if (lag := seen.lag) is not None and seen.errors_as_told is not None:
            name = f"GPS tags without their lag of {lag:.1f} s"
            with_lag = f" With it {seen.errors_as_told.median:.1f} m."
        bounds = f", 95 % of them within {upper_bound(errors.ce95)} m" if errors.photos >= _FEWEST else ""
        bounds += f", at most {upper_bound(errors.largest)} m"
        rows.append((name, f"{errors.median:.1f} m", f"Median of {errors.photos} photos{bounds}.{with_lag}"))
    return rows


def _unconfirmed(seen: FlightSnapshot) -> str:
    """Return a warning that the radii do not hold against the GPS tags; "" if they hold, or there are too few tags."""
    errors = seen.measured.errors().get("registration")
    if errors is None or not errors.calibration or errors.calibration[3] >= CONFIRMED_SHARE:
        return ""
    return (
        f"GPS tags do not confirm it: {errors.calibration[3]:.0f} % lie within 3 radii, where {RIGHT_CALIBRATION[3]:.0f} % "
        "should."
    )


def notes(seen: FlightSnapshot) -> list[str]:
    """Return the remarks on photos, map, and tags."""
    flight = seen.flight
    audit = [] if flight.audit is None else [flight.audit.sentence]
    left_out = [f"Corrections are left out: {seen.corrections_error}"] if seen.corrections_error else []
    return [*flight.notes, *flight.flight.notes, *flight.basemap.notes, *audit, *left_out]
