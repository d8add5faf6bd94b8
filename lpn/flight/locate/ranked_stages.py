"""The stages that rank windows: retrieval, and the sequence over its scores."""

from __future__ import annotations

import math
from collections.abc import Collection

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.files import Flight
from lpn.flight.locate.located import APART, LocatedFrame, StageRecord, WindowRecord
from lpn.flight.locate.options import TOP, LocateOptions
from lpn.flight.locate.retrieval import MapRetrieval
from lpn.flight.locate.sequence import (
    MotionModel,
    SequencePoint,
    SequenceResult,
    emissions,
    fitted,
    fitted_frames,
    heading_evidence,
    score_units,
    smooth,
)

# A place is accepted if windows within this share of a side of it have this probability together.
OVERLAP = 0.75
CONFIDENCE = 0.98
# Log odds of steps along the headings from which the map counts as of the flight's place.
EVIDENCE = 4.0
# Fewest steps of known time between readable frames for a note on the flight's motion.
_LEAST_STEPS = 10
# Least standard deviation of a step that has a direction, as a share of the distance between windows.
_LEAST_STEP = 0.3


# Probability of places beyond the map from which a frame counts as there.
_LEFT = 0.5
_UNREAD = "The photo cannot be read; the position is a guess of its neighbours."
# No places beyond the map, (0, 2).
_NOWHERE = np.zeros((0, 2))


def best_windows(retrieval: MapRetrieval, frame: int, k: int) -> list[WindowRecord]:
    """Return the k best windows of a frame, whose centres lie half a side apart."""
    top = retrieval.top(frame, k, APART)
    return [
        WindowRecord(
            float(retrieval.places[w, 0]),
            float(retrieval.places[w, 1]),
            float(retrieval.sizes[w]),
            float(top.scores[j]),
            float(top.headings[j]),
            [float(value) for value in top.cosines[j]],
            [float(value) for value in top.contributions[j]],
        )
        for j, w in enumerate(top.indices)
    ]


def enter_retrieval(retrieval: MapRetrieval, frames: list[LocatedFrame], k: int) -> None:
    """Enter the answers of the retrieval."""
    for i, located in enumerate(frames):
        if i in retrieval.broken:
            located.stages["retrieval"] = StageRecord("refused", retrieval.broken[i])
            continue
        located.windows = best_windows(retrieval, i, k)
        best = located.windows[0]
        turned = "" if len(retrieval.headings[i]) == 1 else f", turned to {best.heading:.0f} degrees"
        margin = _margin(retrieval, i)
        others = (
            "no window lies apart from it"
            if margin is None
            else f"the margin to windows apart from it is {margin:.3f} d²"
        )
        located.stages["retrieval"] = StageRecord(
            "not verified",
            f"The best of {len(retrieval.windows)} windows has the score {best.score:.3f}{turned}; {others}; not verified.",
            best.x,
            best.y,
            heading=best.heading,
        )


def _margin(retrieval: MapRetrieval, frame: int) -> float | None:
    """Return the margin in d² of the best window over the best one that does not overlap it; None without one."""
    scores = retrieval.scores(frame)
    best = int(scores.argmax())
    apart = (
        np.abs(retrieval.places - retrieval.places[best]).max(axis=1) >= (retrieval.sizes + retrieval.sizes[best]) / 2
    )
    return float(2 * (scores[best] - scores[apart].max())) if apart.any() else None


def smoothed(
    retrieval: MapRetrieval, flight: Flight, speed: float | None, beyond: Float64Array, on_map: Collection[int]
) -> tuple[SequenceResult, MotionModel, float]:
    """Run the sequence over windows, places `beyond` the map, (B, 2), and headings; return it, its motion, `heading_evidence`.

    Frames `on_map` have no place beyond. A frame with a heading has only this state, and each window has its best score over the
    tried turns. Other frames have all tried headings as states.
    """
    best = np.stack([retrieval.scores(i) for i in range(len(flight.frames))])
    flown = [frame.heading for frame in flight.frames]
    headings = [
        np.array([heading] if heading is not None else [math.nan] if i in retrieval.broken else retrieval.headings[i])
        for i, heading in enumerate(flown)
    ]
    side = float(np.median(retrieval.sizes))
    step = max(side * (1 - retrieval.overlap), 1.0)
    compared = np.isnan(retrieval.levels)[:, None] | (retrieval.sizes == retrieval.levels[:, None])
    units = score_units(best, MotionModel(speed or MotionModel.speed, step).steps(flight.times), side, compared)

    def scores(i: int) -> Float64Array:
        return units.standardised(i, best[i][:, None] if len(headings[i]) == 1 else retrieval.scores_by_heading(i))

    motion, temperature = fitted(scores, headings, retrieval.places, flight.times, step, speed)
    evidence = heading_evidence(scores, headings, retrieval.places, flight.times, motion, temperature)
    near, alike = OVERLAP * side, motion.alike(flight.times, side)

    def log_emissions(i: int) -> Float64Array:
        logs = emissions(scores(i), temperature, beyond=len(beyond), alike=alike[i])
        if i in on_map:
            logs[len(retrieval.places) :] = -np.inf
        return logs

    track = smooth(
        log_emissions,
        headings,
        np.concatenate([retrieval.places, beyond]),
        flight.times,
        motion,
        near,
        lambda shares: retrieval.best_apart(shares, TOP, APART),
        len(beyond),
    )
    return track, motion, evidence


def sequence_answer(point: SequencePoint, side: float, spacing: float, proven: bool, finding: str = "") -> StageRecord:
    """Return the answer of the sequence for a frame.

    Args:
        point: of the sequence.
        side, spacing: of the windows, and between them, in metres.
        proven: whether the map is known to be of the flight's place; if not, the answer is refused until `judge_map`.
        finding: about the frame.
    """
    radius = math.hypot(point.radius, spacing / 2)
    heading = None if math.isnan(point.heading) else point.heading
    x, y = point.position.tolist()
    answer = StageRecord("accepted", finding, x, y, radius=radius, heading=heading)
    if point.beyond > _LEFT:
        return answer.refused("beyond", probability=_floored(point.beyond))
    if radius > side:
        return answer.refused("wide", radius=radius, side=side)
    if point.nearby < CONFIDENCE:
        return answer.refused("unsure", metres=OVERLAP * side, probability=_floored(point.nearby), needed=CONFIDENCE)
    return answer if proven else answer.refused("unproven")


def _floored(probability: float) -> float:
    """Round a probability down to two digits, so that it never seems to reach a limit that it misses."""
    return math.floor(100 * probability) / 100


def enter_sequence(
    retrieval: MapRetrieval,
    flight: Flight,
    frames: list[LocatedFrame],
    options: LocateOptions,
    beyond: Float64Array = _NOWHERE,
    on_map: Collection[int] = (),
) -> list[str]:
    """Enter the answers of the sequence; return sentences about it.

    If the direction of flight does not prove that the map is of its place, answers are refused until `judge_map`.

    Args:
        beyond: places beyond the map in metres, (B, 2), see `places_beyond`.
        on_map: frames known to lie on the map. With any, the places of the registration's search are kept.
    """
    side = float(np.median(retrieval.sizes))
    spacing = side * (1 - retrieval.overlap)
    track, motion, evidence = smoothed(retrieval, flight, options.speed, beyond, on_map)
    for i, located in enumerate(frames):
        answer = sequence_answer(track.point(i), side, spacing, evidence >= EVIDENCE, track.sentence(i))
        if i in retrieval.broken:
            answer = msgspec.structs.replace(answer.refused("unread"), finding=_UNREAD)
        if not on_map:
            located.likely = [(*retrieval.places[w].tolist(), float(retrieval.sizes[w])) for w in track.first[i]]
        located.stages["sequence"] = answer
    start, stop = fitted_frames(len(frames))
    read = np.array([i not in retrieval.broken for i in range(start, stop)])
    seconds = np.diff(flight.times[start:stop])
    seconds = seconds[np.isfinite(seconds) & read[1:] & read[:-1]]
    if motion.along or len(seconds) < _LEAST_STEPS or motion.speed * np.median(seconds) < _LEAST_STEP * spacing:
        return []
    return [
        "The scores are more probable where the drone moves in any direction than where it flies along its headings: it flew "
        "sideways, its headings are wrong, or the map is of another place."
    ]
