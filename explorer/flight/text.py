"""The sentences of the flight panel about a flight, its accuracy, and one photo of it."""

from __future__ import annotations

import math
import re
from statistics import median

import numpy as np

from explorer.flight.service import FlightSnapshot
from lpn.core.arrays import Float64Array
from lpn.core.numbers import SIGMA, distance, error_figure, upper_bound
from lpn.core.texts import counted
from lpn.flight.locate.errors import CONFIRMED_SHARE, RIGHT_CALIBRATION
from lpn.flight.locate.located import LocatedFlight, LocatedFrame
from lpn.flight.locate.verdict import SIGMAS, FrameVerdict, on_what, placed_errors
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


def state(verdict: FrameVerdict) -> str:
    """Return the colour's name of a photo's state, see `STATES`; a photo that only its neighbours place counts as not placed."""
    return "right" if verdict.sign else "contradicted" if verdict.contradicted else "unknown"


def mark(verdict: FrameVerdict) -> str:
    """Return the sign of a photo's state: a question mark for a place in doubt, or by the neighbours alone."""
    return "✓" if verdict.sign else "✗" if verdict.placed is None else "?"


def counts(seen: FlightSnapshot) -> str:
    """Count the placed, doubtful, and unplaced photos in a sentence."""
    states = [state(verdict) for verdict in seen.verdicts]
    pieces = [f"{states.count(name):,} {word}" for name, word in STATES.items() if name == "right" or name in states]
    text = f"{counted(len(states), 'photo')}: {', '.join(pieces)}."
    if (away := seen.flight.tags_away) is not None:
        text += f" The flight's GPS tags lie {distance(away)} from this map: give the map of the tags' place, unless the tags "
        text += "are wrong."
    return text


def first_sentence(text: str) -> str:
    """Return the first sentence of a text; a full stop within a name, such as IMG. 12.jpg, does not end it."""
    return re.split(r"(?<=\.) (?=[A-Z])", text, maxsplit=1)[0]


def agreement(located: LocatedFrame) -> str:
    """Say how far a registered photo's details lie from the map's details, or why this is unknown; "" without a search."""
    answer = located.stages.get("registration")
    if answer is None or located.by_hand is not None or (measured := answer.agreement) is None:
        return ""
    if measured.largest is None:
        unchecked = first_sentence(measured.unchecked)
        return f"Not checked: {unchecked[:1].lower()}{unchecked[1:]}"
    text = f"Checked at {len(measured.rows)} places: {measured.median:.1f} m off in the median, the largest "
    text += f"{measured.largest:.1f} m{' or more' if measured.may_be_larger else ''}"
    own = answer.middle_on_map
    return f"{text}." if own is None else f"{text}; {upper_bound(SIGMAS * own)} m are allowed."


def place(flight: LocatedFlight, point: tuple[float, float] | Float64Array) -> tuple[str, str]:
    """Return a point on a flight's map in words, and its address on OpenStreetMap, "" for a rendered flight."""
    if flight.rendered:
        return f"{describe_offset(float(point[0]), float(point[1]))} (rendered, no real place)", ""
    latitude, longitude = (f"{value:.6f}" for value in flight.basemap.frame.degrees(np.array([point]))[0].tolist())
    address = f"https://www.openstreetmap.org/?mlat={latitude}&mlon={longitude}#map=18/{latitude}/{longitude}"
    return f"{latitude}, {longitude}", address


def drone(flight: LocatedFlight, located: LocatedFrame) -> str:
    """Describe height and tilt of the drone's camera, and its place unless that is the answer; "" without a pose."""
    answer = located.stages.get("registration")
    if answer is None or not answer.accepted or (pose := answer.pose) is None:
        return ""
    text, height, (tilt, error) = "The drone: ", pose.altitude if pose.flat else pose.height, pose.tilt
    if not answer.camera:
        off = math.hypot(pose.radius, answer.map_error)
        text += f"{place(flight, (pose.east, pose.north))[0]} (± {off:.1f} m {on_what(answer)}), "
    if height is not None:
        text += f"{height:.0f} m above the ground (± {pose.sigmas[2]:.0f} m), "
    return f"{text}its camera {tilt:.1f}° (± {error:.1f}°) from straight down."


def accuracy(seen: FlightSnapshot) -> list[tuple[str, str, str]]:
    """Return three rows on the accuracy of the places: subject, figure, and source; none without a placed photo."""
    flight, placed = seen.flight, [verdict.placed for verdict in seen.verdicts]
    radii = [one.radius_on_map for one in placed if one is not None and one.radius_on_map is not None]
    if not radii:
        return []
    text = f"{SIGMA[:1].upper()}{SIGMA[1:]}, the median of {counted(len(radii), 'photo')}."
    registered = seen.measured.errors().get("registration")
    if registered is not None and registered.calibration and registered.calibration[3] < CONFIRMED_SHARE:
        held, right = registered.calibration[3], RIGHT_CALIBRATION[3]
        text += f" GPS tags do not confirm it: {held:.0f} % lie within 3 radii, where {right:.0f} % should."
    rows = [("On this map", f"± {median(radii):.1f} m", text)]
    figure = f"± {error_figure(flight.place_error)} m" if flight.place_error else ""
    source = "As good as the map's georeference; its error is unknown."
    if flight.rendered:
        source = "The map is rendered, and shows no real place."
    elif told := placing_sentence(flight.basemap.notes):
        source = first_sentence(told)
    elif figure:
        source = "The error that lpn map --error states."
    rows.append(("On Earth", figure, source))
    if (errors := placed_errors(seen.measured.frames, seen.verdicts)) is not None:
        name, with_lag = "GPS tags", ""
        if seen.lag is not None and (as_told := placed_errors(flight.frames, seen.verdicts)) is not None:
            name, with_lag = f"{name} without their lag of {seen.lag:.1f} s", f" With it {as_told.median:.1f} m."
        bounds = f", 95 % of them within {upper_bound(errors.ce95)} m" if errors.photos >= _FEWEST else ""
        bounds += f", at most {upper_bound(errors.largest)} m"
        rows.append((name, f"{errors.median:.1f} m", f"Median of {counted(errors.photos, 'photo')}{bounds}.{with_lag}"))
    return rows


def notes(seen: FlightSnapshot) -> list[str]:
    """Return the remarks on photos, map, and tags."""
    flight = seen.flight
    audit = [] if flight.audit is None else [flight.audit.sentence]
    left_out = [f"Corrections are left out: {seen.corrections_error}"] if seen.corrections_error else []
    return [*flight.notes, *flight.flight.notes, *flight.basemap.notes, *audit, *left_out]
