"""The sentences of the flight window about a flight, its accuracy, and one photo of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from explorer.flight_window.service import FlightView
from explorer.web.coordinates import describe_point
from lpn.core.files import printable
from lpn.drawing.verdicts import compass
from lpn.drawing.words import capitalised, plain, say
from lpn.locate.agreement import MapAgreement
from lpn.locate.audit import TagAudit
from lpn.locate.belief import TAG_RADIUS, Disagreement, on_what
from lpn.locate.camera_pose import CameraPose
from lpn.locate.located import LocatedFlight, LocatedFrame
from lpn.locate.measures import RIGHT_CALIBRATION
from lpn.locate.summary import FlightAccuracy, flight_accuracy

# Three right radii hold 99 % of the errors; a smaller share than this says that radii or tags are wrong.
_RIGHT_SHARE = 90.0
# The list of contradictions alone would read as if all answers were independent, and equally good.
EVIDENCE = (
    "A photo's GPS tag and its details are two independent witnesses, unless the map was made of the same flight, whose tags "
    "place it. Look and neighbours are one witness, and the weakest. Where two lie farther apart than their errors allow, one "
    "of them errs."
)
WORST = (
    "Each photo by the one of its answers that lies farthest from its GPS tag, or its correction by hand: the error of both "
    "together. The answer that counts stands behind it, where it is another one."
)
# Fewer places of a photo tell nothing of the rest.
_FEW_PLACES = 3
_METHODS = {
    "retrieval": "the most similar piece of the map",
    "sequence": "the path of the flight through such pieces",
    "registration": "points of the photo matched on the map",
}
_ENDS = {"tag": "its GPS tag", "registration": "its place by its details", "sequence": "its place by its neighbours"}


@dataclass(frozen=True)
class AccuracyLine:
    """One source of error: what it is of, its figure, and a sentence on where the figure comes from."""

    name: str
    figure: str
    source: str


def label(name: str) -> str:
    """Return what a track is called: that of a stage, of the GPS tags, or of a person's corrections."""
    return "By hand" if name == "corrected" else capitalised(say(name))


def methods(stages: Sequence[str]) -> str:
    """Say in a line how each of the stages places a photo."""
    return " ".join(f"{label(stage)}: {_METHODS[stage]}." for stage in stages)


def refusal(located: LocatedFrame, stage: str) -> str | None:
    """Return that a stage's answer is refused, and why; None if it is not."""
    answer = located.stages.get(stage)
    return None if answer is None or answer.state != "refused" else f"{label(stage)}: refused. {answer.sentence}"


def refusals(located: LocatedFrame) -> list[str]:
    """Return the refusals of all stages."""
    return [text for stage in located.stages if (text := refusal(located, stage)) is not None]


def judge(flight: LocatedFlight) -> str:
    """Return what the page's other panels grade a photo's look by, see `LocatedFlight.photographed`."""
    return "its GPS tag" if flight.late_tags is None else "its details"


def apart(view: FlightView, one: Disagreement) -> str:
    """Return two answers that contradict each other in words: how far apart they lie, and which of them errs if that is known."""
    if not plain():
        return one.sentence
    if view.beliefs[one.frame].sign:  # tag and details agree, and the neighbours alone differ
        place = "here" if one.one == "registration" else _ENDS[one.other]
        return f"Its neighbours would place it {one.metres:.1f} m from {place}."
    tilt = f", and {one.tilt:.1f} m as a tilted camera looks aside" if one.tilt else ""
    return (
        f"{capitalised(_ENDS[one.one])} and {_ENDS[one.other]} lie {one.metres:.1f} m apart, and {one.allowed:.1f} m are "
        f"allowed: three times the error of both{tilt}. Nothing here tells which of the two errs."
    )


def reason(view: FlightView, frame: int) -> str:
    """Return the grounds of the verdict on a frame; "" where they are those of a stage that refuses."""
    located, verdict = view.flight.frames[frame], view.beliefs[frame]
    if any(text.endswith(verdict.reason) for text in refusals(located)):
        return ""
    answer = located.stages.get("registration")
    if not plain() or verdict.stage != "registration" or answer is None:
        return verdict.reason
    sentences = [] if answer.inliers is None else [f"{answer.inliers} details of the photo agree with the map."]
    against = [one for one in view.contradictions if one.frame == frame and one.one == "registration"]
    error = located.error("registration")
    if error is not None and all(one.other != "tag" for one in against):
        sentences.append(
            f"The place lies {error:.1f} m from {'the correction by hand' if located.by_hand else 'its GPS tag'}."
        )
    return " ".join([*sentences, *(apart(view, one) for one in against)])


def agreement(measured: MapAgreement) -> str:
    """Say how far places of a photo lie from where the map has them; "" where too few are found to tell."""
    if len(measured.metres) < _FEW_PLACES:
        return ""
    farthest = int(measured.metres.argmax())
    return (
        f"Beside its middle, {len(measured.metres)} places of the photo were found on the map one by one, looked for within "
        f"± {measured.reach:.1f} m: they lie {np.median(measured.metres):.1f} m from where the photo has them in the median, and "
        f"{measured.metres[farthest]:.1f} m at most, {_side(*measured.places[farthest].tolist())}. "
        "The radius is that of the photo's middle alone."
    )


def _side(across: float, down: float) -> str:
    """Return where in a picture a place lies, given as shares of its width and height."""
    row = "upper" if down < 1 / 3 else "lower" if down > 2 / 3 else ""
    column = "left" if across < 1 / 3 else "right" if across > 2 / 3 else ""
    if row and column:
        return f"at the {row} {column}"
    return f"at the {column or {'upper': 'top', 'lower': 'bottom'}[row]}" if row or column else "near the middle"


def worst(view: FlightView) -> list[tuple[int, str, list[str]]]:
    """Return frame, name, and words of each photo that has a place, by the answer that lies farthest from its GPS tag.

    Answers that are refused do not count. Photos without a tag come last, the largest radius first.
    """
    placed = []
    for i, (located, verdict) in enumerate(zip(view.flight.frames, view.beliefs, strict=True)):
        if verdict.stage is None:
            continue
        answered = [
            name for name, answer in located.stages.items() if answer.state != "refused" and answer.x is not None
        ]
        errors = {name: error for name in answered if (error := located.error(name)) is not None}
        farthest = max(errors, key=lambda name: errors[name], default=verdict.stage)
        if errors.get(verdict.stage) == errors.get(farthest):
            farthest = verdict.stage
        words = [_answered(view, i, name) for name in dict.fromkeys((farthest, verdict.stage))]
        order = errors.get(farthest, -math.inf), located.stages[verdict.stage].radius or 0.0
        placed.append((order, i, printable(located.frame.name), ["; ".join(words)]))
    placed.sort(key=lambda one: one[0], reverse=True)
    return [(i, name, words) for _, i, name, words in placed]


def _answered(view: FlightView, frame: int, stage: str) -> str:
    """Return a stage's answer in words: metres from the tag, the stage, its radius, and whether it is contradicted."""
    located, verdict = view.flight.frames[frame], view.beliefs[frame]
    answer, error = located.stages[stage], located.error(stage)
    words = [] if error is None else [f"{error:.1f} m"]
    words.append(say(stage))
    words.append("not verified" if answer.radius is None else f"± {answer.radius:.1f} m {on_what(answer)}")
    if stage == verdict.stage == "registration" and not verdict.sign:
        words.append("contradicted")
    return ", ".join(words)


def drone(flight: LocatedFlight, located: LocatedFrame) -> str:
    """Say where the drone was and how its camera was tilted, by the pose of a registered photo; "" without one.

    Where the position that counts is the drone's already, its place is not said again. It may rest on the tilt in the photo's
    file, which the pose does not know as well.
    """
    answer = located.stages.get("registration")
    pose = None if answer is None or not answer.accepted else answer.pose
    if answer is None or pose is None:
        return ""
    place = (
        "there" if answer.camera else f"{describe_point(flight, (pose.east, pose.north))} {_error(pose.radius, ' m')}"
    )
    height = pose.altitude if pose.flat else pose.height
    if height is not None:
        place += f", {height:.0f} m above the ground {_error(pose.sigmas[2], ' m', 0)}"
    if answer.camera and not answer.by_pose:
        return f"{place}. Its place rests on the tilt in the photo's file."
    flat = " The map has no heights, and over flat ground a tilt and a shift of the drone look nearly alike."
    return f"{place}. {_tilt(pose)}{flat if pose.flat else ''}"


def _tilt(pose: CameraPose) -> str:
    tilt = pose.tilt
    if tilt.degrees < tilt.error:
        return f"Its camera looked straight down, to within {tilt.error:.1f}°."
    where = compass(tilt.azimuth)
    return f"Its camera looked {tilt.degrees:.1f}° {_error(tilt.error, '°')} away from straight down, to the {where}."


def _error(value: float, unit: str, digits: int = 1) -> str:
    return f"(±\N{NO-BREAK SPACE}{value:.{digits}f}{unit})"


def accuracy(view: FlightView, agreements: Sequence[MapAgreement] = ()) -> tuple[str, list[AccuracyLine]] | None:
    """Return how accurate the places of a flight are, in one line and source by source; None if no photo is placed.

    Args:
        agreements: of photos with the map, as far as they are compared.
    """
    known = flight_accuracy(view.flight, view.beliefs)
    if known is None:
        return None
    on_earth, earth = _on_earth(view.flight, known)
    lines = [_on_map(known), *_whole_photos(agreements), earth]
    audit = view.flight.audit
    if audit is not None and audit.frames:
        lines.append(AccuracyLine("GPS tags", f"{audit.median:.1f} m", _tags(audit)))
    if (radii := _radii(view.flight, known)) is not None:
        lines.append(radii)
    if known.place_error is not None:
        on_earth = f"± {known.radius:.1f} m on earth, as far as the tags of the map do not all err alike"
        return f"{lines[0].figure} on this map; {on_earth}.", lines
    return f"± {known.radius:.1f} m on this map; {on_earth}.", lines


def _on_map(known: FlightAccuracy) -> AccuracyLine:
    source = f"1-sigma radius, the median of {known.photos} photos."
    radius = math.sqrt(max(known.radius**2 - (known.place_error or 0.0) ** 2, 0.0))
    if known.details is not None and known.map_error:
        assumed = math.sqrt(known.map_error**2 - (known.place_error or 0.0) ** 2)
        source += (
            f" The scatter of the details gives ± {known.details:.1f} m, and ± {assumed:.1f} m are assumed for the "
            "map, whose places nobody measured."
        )
    return AccuracyLine("On this map", f"± {radius:.1f} m", source)


def _whole_photos(agreements: Sequence[MapAgreement]) -> list[AccuracyLine]:
    """Return how far places of the photos lie from where the map has them; nothing where too few are found."""
    metres = np.concatenate([one.metres for one in agreements]) if agreements else np.zeros(0)
    if len(metres) < _FEW_PLACES:
        return []
    reaches = [one.reach for one in agreements if len(one.metres)]
    source = (
        f"Median of {len(metres)} places of {len(reaches)} photos that were found on the map one by one, {metres.max():.1f} m at "
        f"most: what one transformation of a photo leaves, where the map or the ground is uneven. They were looked for within "
        f"± {min(reaches):.1f} m at least. The radius is that of a photo's middle."
    )
    return [AccuracyLine("All of a photo", f"{np.median(metres):.1f} m", source)]


def _on_earth(flight: LocatedFlight, known: FlightAccuracy) -> tuple[str, AccuracyLine]:
    """Return how well the place of the map itself is known, in a clause and with its source."""
    if flight.rendered:
        return "the map shows no real place", AccuracyLine(
            "The map itself", "", "It is rendered, and shows no real place."
        )
    if known.map_source:
        value = "" if known.place_error is None else f"± {known.place_error:.1f} m"
        return (
            "on earth no better than the GPS tags that the map was made by",
            AccuracyLine("The map itself", value, known.map_source),
        )
    return (
        "on earth as good as the map’s georeference, which nothing here checks",
        AccuracyLine("The map itself", "", "Its place on earth is that of its file, which does not tell its error."),
    )


def _tags(audit: TagAudit) -> str:
    """Say how far the tags lie from the places on the map, and how much of that a lag or a tilted camera explains."""
    text = (
        f"Median of {audit.frames} photos, {audit.largest:.0f} m at most, between the GPS tag and the place on this map: the "
        "error of both together."
    )
    if not audit.has_lag or audit.lag is None:
        return text
    ahead = f", or that {audit.looks_ahead}" if audit.looks_ahead else ""
    return (
        f"{text} It may be that the tags are {abs(audit.lag):.1f} s (± {audit.lag_error or 0:.1f} s) "
        f"{'late' if audit.lag > 0 else 'early'}{ahead}. With a constant offset of {audit.offset:.1f} m that explains a part: "
        f"{audit.without_lag:.1f} m remain in the median, which nothing here explains."
    )


def _radii(flight: LocatedFlight, known: FlightAccuracy) -> AccuracyLine | None:
    """Return whether the radii hold against the tags; None where no tag tells."""
    summary = flight.summaries().get("registration")
    if summary is None or not summary.calibration:
        return None
    right = ", ".join(f"{share:.0f}" for share in RIGHT_CALIBRATION.values())
    if summary.calibration[3] >= _RIGHT_SHARE:
        verdict = "Radii and tags agree."
    elif flight.audit is not None and flight.audit.has_lag:
        verdict = (
            "A part is the lag of the tags or the direction of the camera, which no radius holds, so this does not tell if the "
            "radii fail."
        )
    elif known.radius < TAG_RADIUS:
        verdict = (
            f"GPS tags alone err by some {TAG_RADIUS:.0f} m, more than these radii, so this does not tell which of the two "
            "fails."
        )
    else:
        verdict = "Radii or tags are worse than they should be, and this does not tell which."
    return AccuracyLine(
        "Check of the radii",
        f"{', '.join(f'{share:.0f}' for share in summary.calibration.values())} %",
        f"The share of the tags within 1, 2, and 3 radii; right radii and exact tags would have {right} %. {verdict}",
    )
