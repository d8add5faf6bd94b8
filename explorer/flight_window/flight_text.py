"""The sentences of the flight window about a flight, its accuracy, and one photo of it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

from explorer.flight_window.service import FlightView
from explorer.panels.radius_text import reach, told_reach
from explorer.web.coordinates import describe_point
from lpn.core.files import printable
from lpn.core.numbers import SIGMA, distance, error_figure, upper_bound
from lpn.drawing.verdicts import compass
from lpn.drawing.words import capitalised, plain, say
from lpn.locate.agreement import MapAgreement
from lpn.locate.audit import TagAudit
from lpn.locate.belief import SIGMAS, Disagreement, on_what, tag_allowance
from lpn.locate.camera_pose import CameraPose
from lpn.locate.located import LocatedFlight, LocatedFrame, StageRecord
from lpn.locate.measures import CONFIRMED_SHARE, RIGHT_CALIBRATION
from lpn.locate.registration import is_turned_over
from lpn.locate.summary import PLACED, FlightAccuracy, flight_accuracy, share_within
from lpn.locate.surveyed import SurveyedErrors

# The list of contradictions alone would read as if all answers were independent, and equally good.
EVIDENCE = (
    "A photo's GPS tag and its details are two independent witnesses, unless the map was made of the same flight, whose tags "
    "place it. Look and neighbours are one witness, and the weakest. Where two lie farther apart than their errors allow, one "
    "of them errs. What the map has away from a photo's middle is a third."
)
WORST = (
    "Contradicted photos, which have a ?, come first, by how many times their metres are those that are allowed; where a photo "
    "breaks two limits, the larger ratio counts. The others follow by their metres from the GPS tag, or from the correction by "
    "hand: the error of both together. Mere guesses come last."
)
UNCHECKED = (
    "Their details place these photos. Away from the middle of each, too few places were found on the map to check that all "
    "of it fits."
)
# The marks of a track in the legend of a map that stands alone, whose table of the tracks is left out.
_MARKS = {
    "retrieval": "Dots without a line: guesses by the look alone, which nothing has verified.",
    "sequence": "Dots and line: the places of the photos, by their neighbours.",
    "registration": "Dots and line: the places of the photos, by their details.",
    "corrected": "Dots and line: the places that a person has corrected by hand.",
    "tag": "Thin dashed line: the GPS tags.",
}
_METHODS = {
    "retrieval": "the most similar piece of the map",
    "sequence": "the path of the flight through such pieces",
    "registration": "points of the photo matched on the map",
}


@dataclass(frozen=True)
class AccuracyLine:
    """One source of error: what it is of, its figure, and a sentence on where the figure comes from."""

    name: str
    figure: str
    source: str


def label(name: str) -> str:
    """Return what a track is called: that of a stage, of the GPS tags, or of a person's corrections."""
    return "By hand" if name == "corrected" else capitalised(say(name))


def mark(name: str) -> str:
    """Say what the marks of a track on the map are."""
    return _MARKS[name]


def methods(stages: Sequence[str]) -> str:
    """Say in a line how each of the stages places a photo."""
    return " ".join(f"{label(stage)}: {_METHODS[stage]}." for stage in stages)


def circle(flight: LocatedFlight) -> str:
    """Say what the circle around a photo's place means, and if the tags of the flight confirm it."""
    inside = RIGHT_CALIBRATION[3 if plain() else 1]
    text = (
        f"Circle around its place: if errors are as estimated, the true place of {inside:.0f} of 100 photos lies in it"
    )
    text += "." if plain() else " (1 sigma along each axis)."
    unconfirmed = flight.radii_confirmed.get("registration") is False
    return f"{text} The flight's GPS tags do not confirm that." if unconfirmed else text


def refusal(located: LocatedFrame, stage: str) -> str | None:
    """Return that a stage's answer is refused, and why; None if it is not."""
    answer, details = located.stages.get(stage), located.stages.get("registration")
    if answer is None or answer.state != "refused":
        return None
    text = f"{label(stage)}: refused. {_why(located, stage)}"
    placed = plain() and stage == "sequence" and not answer.unverified and details is not None and details.accepted
    return f"{text} That does not speak against its details." if placed else text


def _why(located: LocatedFrame, stage: str) -> str:
    """Return why a stage refuses its answer; in plain words that of the neighbours has neither sigma nor probability."""
    answer, own = located.stages[stage], located.stages.get("retrieval")
    unreadable = own is not None and own.state == "refused"
    if not plain() or stage != "sequence" or answer.radius is None or unreadable:
        return answer.sentence
    if answer.unverified:
        return "Nothing shows that the map is of this place."
    return f"Its neighbours do not settle where it is: this place may be {answer.radius:.0f} m off, or more."


def refusals(located: LocatedFrame) -> list[str]:
    """Return the refusals of all stages."""
    return [text for stage in located.stages if (text := refusal(located, stage)) is not None]


def reason(view: FlightView, frame: int) -> str:
    """Return the grounds of the verdict on a frame; "" where they are those of a stage that refuses."""
    located, verdict = view.flight.frames[frame], view.beliefs[frame]
    if any(one.state == "refused" and one.sentence.endswith(verdict.reason) for one in located.stages.values()):
        return ""
    answer = located.stages.get("registration")
    against = [one for one in view.contradictions if one.frame == frame and one.one == "registration"]
    if not plain() or verdict.stage != "registration" or answer is None:
        told = (contradiction(view, one) for one in against if one.other == "map" and one.sentence == verdict.reason)
        return next(told, verdict.reason)
    sentences = [] if answer.inliers is None else [f"{answer.inliers} details of the photo agree with the map."]
    error = located.error("registration")
    if error is not None and all(one.other != "tag" for one in against):
        place = "The place below the drone" if answer.camera else "The ground at the photo's middle"
        metres, limit = f"{error:.1f} m", ""
        if not located.by_hand:  # as the first screen rounds them
            metres, limit = distance(error), f", where {upper_bound(tag_allowance(located), 0)} m are allowed"
        sentences.append(f"{place} lies {metres} from {_truth(located)}{limit}.")
    if answer.turn is not None and is_turned_over(answer.turn):
        sentences.append(
            f"The picture is turned by {abs(answer.turn):.0f} degrees here: its file tells another heading, by which the first "
            "screen turns it."
        )
    return " ".join([*sentences, *(contradiction(view, one) for one in against)])


def contradiction(view: FlightView, one: Disagreement) -> str:
    """Say what contradicts a photo's answer, and by how much; where the map does, harmless causes are named, too."""
    answer = view.flight.frames[one.frame].stages.get("registration")
    measured = None if answer is None else answer.agreement
    if one.other != "map" or answer is None or measured is None or measured.largest is None:
        return one.told(view.beliefs[one.frame])
    metres, allowed = one.figures
    text = (
        f"Away from its middle, {len(measured.rows)} places of the photo lie {metres} m in the median from where the map "
        f"has them, and {measured.largest:.1f} m at the farthest, {_farthest(measured)}. {_allowed_median(answer, allowed)} "
        "Uneven ground, the lens, or ground that has changed can do this, too; nothing here tells which. The middle may still be "
        "right."
    )
    if answer.on_earth and not plain():
        text += f" Its place is {told_reach(answer)}, where the map's own error moves all of the photo alike."
    return text


def _allowed_median(answer: StageRecord, allowed: str) -> str:
    """Say how far places away from the middle of a photo may lie off in the median: `allowed` metres."""
    radius = answer.radius_on_map or 0.0
    times = "" if plain() else f", three times ± {radius:.1f} m"
    return f"At most {allowed} m are allowed for the median, as far as the middle may be off on this map{times}."


def _truth(located: LocatedFrame) -> str:
    return "the correction by hand" if located.by_hand else "its GPS tag"


def agreement(view: FlightView, frame: int, measured: MapAgreement) -> str:
    """Say how far places of a photo lie from where the map has them, and whether that fits, or that too few of them tell."""
    median, largest = measured.median, measured.largest
    if median is None or largest is None:
        return f"Not checked: {measured.unchecked[:1].lower()}{measured.unchecked[1:]}"
    side = _farthest(measured)
    beyond = ", as nothing beyond was looked for" if measured.may_be_larger else ""
    text = (
        f"Away from its middle, {len(measured.rows)} places of the photo were found on the map one by one, looked for within "
        f"± {measured.reach:.1f} m: their median lies {median:.1f} m from where the photo has it, and the farthest "
        f"{'at least ' if beyond else ''}{largest:.1f} m, {side}{beyond}."
    )
    answer = view.flight.frames[frame].stages.get("registration")
    if view.corrected(frame) is not None or answer is None or answer.radius_on_map is None:
        return text
    if any((one.frame, one.other) == (frame, "map") for one in view.contradictions):
        return f"? {text}"
    return f"\u2713 {text} {_allowed_median(answer, upper_bound(SIGMAS * answer.radius_on_map))}"


def _farthest(measured: MapAgreement) -> str:
    """Return where in the picture the place lies that is farthest off."""
    return _side(*measured.places[measured.metres.argmax()].tolist())


def _side(across: float, down: float) -> str:
    """Return where in a picture a place lies, given as shares of its width and height."""
    row = "upper" if down < 1 / 3 else "lower" if down > 2 / 3 else ""
    column = "left" if across < 1 / 3 else "right" if across > 2 / 3 else ""
    if row and column:
        return f"at the {row} {column}"
    return f"at the {column or {'upper': 'top', 'lower': 'bottom'}[row]}" if row or column else "near the middle"


def worst(view: FlightView) -> list[tuple[int, str, list[str]]]:
    """Return frame, name, and words of each photo that has a place, the worst first.

    Contradicted ones are first, by how many times the metres that are allowed, of tag or map the larger ratio, and of neighbours
    where these alone contradict; then placed ones by their metres from the GPS tag, and without a tag by their radii. Guesses are
    last.
    """
    doubts: dict[int, list[Disagreement]] = {}
    for one in view.contradictions:
        doubts.setdefault(one.frame, []).append(one)
    placed = []
    for i, (located, verdict) in enumerate(zip(view.flight.frames, view.beliefs, strict=True)):
        if verdict.stage is None:
            continue
        against = [one for one in doubts.get(i, ()) if verdict.in_doubt and one.one == "registration"]
        against = [one for one in against if one.other != "sequence"] or against
        answer, error = located.stages[verdict.stage], located.error(verdict.stage)
        radius = answer.radius or 0.0
        excess = max((one.metres / max(one.allowed, 0.1) for one in against), default=0.0)
        order = (verdict.stage in PLACED, excess, -1.0 if error is None else error, radius)
        words = [] if error is None else [f"{error:.1f} m from {_truth(located)}{_allowed(against, 'tag')}"]
        if verdict.stage != "registration" or not plain() or error is None:
            words += [
                say(verdict.stage),
                "not verified" if answer.radius is None else told_reach(answer),
            ]
        misfit = None if answer.agreement is None else answer.agreement.median
        if answer.agreement is not None and answer.agreement.unchecked:
            words.append("not checked away from its middle")
        if misfit is not None:
            words.append(f"away from its middle {misfit:.1f} m off{_allowed(against, 'map')}")
        if (allowed := _allowed(against, "sequence")) != "":
            words.append(f"{against[0].figures[0]} m from its place by its neighbours{allowed}")
        line = f"{'? ' if against else ''}{', '.join(words)}"
        placed.append((order, i, printable(located.frame.name), [line]))
    placed.sort(key=lambda one: one[0], reverse=True)
    return [(i, name, lines) for _, i, name, lines in placed]


def _allowed(against: Sequence[Disagreement], other: str) -> str:
    return next((f" where {one.figures[1]} m are allowed" for one in against if one.other == other), "")


def drone(flight: LocatedFlight, located: LocatedFrame) -> str:
    """Say where the drone was and how its camera was tilted, by the pose of a registered photo; "" without one.

    The radius holds the map's error, as those of all places do. Where the position that counts is the drone's already, its place
    and how far that is from the tag are not said again. It may rest on the tilt in the photo's file, which the pose does not know
    as well.
    """
    answer = located.stages.get("registration")
    pose = None if answer is None or not answer.accepted else answer.pose
    if answer is None or pose is None:
        return ""
    place = "there"
    if not answer.camera:
        radius = math.hypot(pose.radius, answer.map_error)
        place = f"{describe_point(flight, (pose.east, pose.north))} {_error(radius, f' m {on_what(answer)}')}"
        if located.tag is not None:
            metres = math.hypot(pose.east - located.tag[0], pose.north - located.tag[1])
            place += f", {metres:.1f} m from its GPS tag"
    height = pose.altitude if pose.flat else pose.height
    if height is not None:
        place += f", {height:.0f} m above the ground {_error(pose.sigmas[2], ' m', 0)}"
    if answer.camera and not answer.by_pose:
        return f"{place}. Its place rests on the tilt in the photo's file."
    flat = " The map has no heights, and over flat ground a tilt and a shift of the drone look nearly alike."
    return f"{place}. {_tilt_of(pose)}{flat if pose.flat else ''}"


def _tilt_of(pose: CameraPose) -> str:
    tilt = pose.tilt
    if tilt.degrees < tilt.error:
        return f"Its camera looked straight down, to within {upper_bound(tilt.error)}°."
    where = compass(tilt.azimuth)
    return f"Its camera looked {tilt.degrees:.1f}° {_error(tilt.error, '°')} away from straight down, to the {where}."


def _error(value: float, unit: str, digits: int = 1) -> str:
    return f"(±\N{NO-BREAK SPACE}{value:.{digits}f}{unit})"


def accuracy(view: FlightView) -> tuple[str, list[AccuracyLine]] | None:
    """Return how accurate the places of a flight are, in one line and source by source; None if no photo is placed."""
    known = flight_accuracy(view.flight, view.beliefs)
    if known is None:
        return None
    on_earth, earth = _on_earth(view.flight, known)
    lines = [_on_map(view.flight, known), earth]
    if view.errors is not None:
        lines.append(AccuracyLine("GPS tags", f"{view.errors.median:.1f} m", _tags(view.errors, view.flight.audit)))
    if known.place_error is not None and known.map_source:
        on_earth = f"± {known.radius:.1f} m on earth, as far as the tags of the map do not all err alike"
    failed = [text for text in (_unconfirmed(view.flight), _unfit(view)) if text]
    checks = f" Not confirmed: {', and '.join(failed)}." if failed else ""
    if plain():
        on_map = upper_bound(reach(_radius_on_map(known)))
        if known.place_error is not None:
            on_earth = f"within {upper_bound(reach(known.radius))} m on earth"
            on_earth += ", as far as the tags of the map do not all err alike" if known.map_source else ""
        of = f"{RIGHT_CALIBRATION[3]:.0f} of 100 photos like the typical one"
        return f"{of} should lie within {on_map} m on this map; {on_earth}.{checks}", lines
    return f"{lines[0].figure} on this map ({SIGMA}); {on_earth}.{checks}", lines


def _radius_on_map(known: FlightAccuracy) -> float:
    return math.sqrt(max(known.radius**2 - (known.place_error or 0.0) ** 2, 0.0))


def _on_map(flight: LocatedFlight, known: FlightAccuracy) -> AccuracyLine:
    source = f"{capitalised(SIGMA)}, the median of {known.photos} photos."
    radius = _radius_on_map(known)
    if known.details is not None and known.map_error:
        assumed = math.sqrt(known.map_error**2 - (known.place_error or 0.0) ** 2)
        answers = [located.stages.get("registration") for located in flight.frames]
        tilted = any(
            answer is not None and answer.accepted and answer.camera and not answer.by_pose for answer in answers
        )
        below = " and the error assumed for the tilt that the photos tell give" if tilted else " gives"
        source += f" The scatter of the details{below} ± {known.details:.1f} m"
        source += (
            f", and ± {error_figure(assumed)} m are assumed for the map, whose places nobody measured; lpn map --error "
            "takes what your check points show."
            if assumed
            else "."
        )
    return AccuracyLine("On this map", f"± {radius:.1f} m", source)


def _unfit(view: FlightView) -> str:
    """Return a clause on the photos that do not fit the map away from their middle; "" if none is known not to."""
    answers = [located.stages.get("registration") for located in view.flight.frames]
    compared = sum(
        answer is not None and answer.agreement is not None and answer.agreement.median is not None
        for answer in answers
    )
    unfit = sum(one.other == "map" for one in view.contradictions)
    return f"{unfit} of {compared} photos do not fit the map away from their middle" if unfit and compared else ""


def _on_earth(flight: LocatedFlight, known: FlightAccuracy) -> tuple[str, AccuracyLine]:
    """Return how well the place of the map itself is known, in a clause and with its source."""
    if flight.rendered:
        return "the map shows no real place", AccuracyLine(
            "The map itself", "", f"It is {say('rendered')}, and shows no real place."
        )
    if known.map_source:
        value = "" if known.place_error is None else f"± {known.place_error:.1f} m"
        return (
            "on earth no better than the GPS tags that the map was made by",
            AccuracyLine("The map itself", value, known.map_source),
        )
    if known.place_error is not None:
        return f"± {known.radius:.1f} m on earth", AccuracyLine(
            "The map itself",
            f"± {error_figure(known.place_error)} m",
            "Its places were surveyed: lpn map --error tells their error on earth.",
        )
    return (
        "on earth as good as the map’s georeference, which nothing here checks",
        AccuracyLine("The map itself", "", "Its place on earth is that of its file, which does not tell its error."),
    )


def _tags(errors: SurveyedErrors, audit: TagAudit | None) -> str:
    """Say how far the places lie from the tags, and how much of that a lag or a tilted camera explains."""
    text = (
        f"Median of {errors.photos} photos{share_within(errors)} and {upper_bound(errors.largest)} m at most, "
        "between the GPS tag and the place on this map: the error of both together."
    )
    if audit is None or not audit.has_lag or audit.lag is None:
        return text
    ahead = f", or that {audit.looks_ahead}" if audit.looks_ahead else ""
    where = "" if audit.bearing is None else f" of the tags to the {compass(audit.bearing)}"
    return (
        f"{text} It may be that the tags are {abs(audit.lag):.1f} s (± {audit.lag_error or 0:.1f} s) "
        f"{'late' if audit.lag > 0 else 'early'}{ahead}. With a constant offset of {audit.offset:.1f} m{where} that explains a "
        f"part: {audit.without_lag:.1f} m remain in the median, which nothing here explains."
    )


def _unconfirmed(flight: LocatedFlight) -> str:
    """Return a clause on radii that do not hold against the GPS tags; "" if they hold, or no tag tells."""
    summary = flight.registration_summary
    if summary is None or not summary.calibration or summary.calibration[3] >= CONFIRMED_SHARE:
        return ""
    near = "that near" if plain() else "within 3 radii"
    return (
        f"only {summary.calibration[3]:.0f} % of the GPS tags lie {near}, where {RIGHT_CALIBRATION[3]:.0f} % should "
        "(tags or radii fail; this does not tell which)"
    )
