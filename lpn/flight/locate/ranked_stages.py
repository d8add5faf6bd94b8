"""The stages of a flight that rank windows: retrieval, and the sequence over its scores."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.core.numbers import SIGMA
from lpn.flight.files import Flight
from lpn.flight.locate.located import APART, LocatedFrame, StageRecord, State, WindowRecord
from lpn.flight.locate.map_proof import middle_reach, new_views, share_near
from lpn.flight.locate.options import TOP, LocateOptions
from lpn.flight.locate.retrieval import MapRetrieval
from lpn.flight.locate.sequence import (
    MotionModel,
    SequenceResult,
    emissions,
    fitted,
    fitted_frames,
    heading_evidence,
    score_units,
    smooth,
)

# A place is told by windows that overlap it, whose centres lie within this share of a side, and with this probability.
OVERLAP = 0.75
CONFIDENCE = 0.98
# Log odds from which steps along the headings, or registrations that agree, show that the map is of the flight's place.
EVIDENCE = 4.0
# Share of the registrations that agree with the sequence on the right map.
AGREEING = 0.9
_UNVERIFIED = (
    "Nothing shows that the map is of this place: steps along the headings are hardly more probable than others, and the "
    "registrations that agree with the sequence may do so by chance."
)
# Steps of known time between frames that can be read, from which a flight's motion is told.
_LEAST_STEPS = 10
# Standard deviation of a step, as a share of the distance between windows, below which it tells no direction.
_LEAST_STEP = 0.3


# Probability of places beyond the map from which a frame is said to lie there.
_LEFT = 0.5
# No places beyond the map, (0, 2).
_NOWHERE = np.zeros((0, 2))


def left_map(probability: float) -> str:
    """Say that a frame lies where no window of the map does, with some probability, which is not rounded up."""
    share = math.floor(100 * probability) / 100
    return (
        "Where the drone can have been, the map resembles this photo and its neighbours too little. By these scores it was "
        f"beyond the map's edge, or so near it that no piece of the map shows the photo whole, with a probability of {share:.2f}."
    )


def enter_retrieval(retrieval: MapRetrieval, frames: list[LocatedFrame], k: int) -> None:
    """Enter the answers of the retrieval."""
    for i, located in enumerate(frames):
        if i in retrieval.broken:
            located.stages["retrieval"] = StageRecord("refused", retrieval.broken[i])
            continue
        top = retrieval.top(i, max(k, 2), APART)
        located.windows = [
            WindowRecord(
                float(retrieval.places[w, 0]),
                float(retrieval.places[w, 1]),
                float(retrieval.sizes[w]),
                float(top.scores[j]),
                float(top.headings[j]),
                [float(value) for value in top.cosines[j]],
                [float(value) for value in top.contributions[j]],
            )
            for j, w in enumerate(top.indices[:k])
        ]
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
    """Return d² of the best window that does not overlap the best one, minus d² of that; None without such a window."""
    scores = retrieval.scores(frame)
    best = int(scores.argmax())
    apart = (
        np.abs(retrieval.places - retrieval.places[best]).max(axis=1) >= (retrieval.sizes + retrieval.sizes[best]) / 2
    )
    return float(2 * (scores[best] - scores[apart].max())) if apart.any() else None


def smoothed(
    retrieval: MapRetrieval, flight: Flight, speed: float | None, beyond: Float64Array, on_map: Collection[int]
) -> tuple[SequenceResult, MotionModel, float]:
    """Run the sequence over windows, places `beyond` the map, (B, 2), and headings; return it, its motion, and its evidence.

    The evidence is that of `heading_evidence`. Frames `on_map` have no place beyond.

    A frame whose heading is told has this one as its state, as the drone flies along it, and each window counts with the best of
    the turns that are tried. Other frames have all headings that are tried.
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


def enter_sequence(
    retrieval: MapRetrieval,
    flight: Flight,
    frames: list[LocatedFrame],
    options: LocateOptions,
    beyond: Float64Array = _NOWHERE,
    on_map: Collection[int] = (),
) -> list[str]:
    """Enter the answers of the sequence; return sentences about it.

    Where the direction of flight does not show that the map is of its place, answers are refused until `confirm_sequence`.

    Args:
        beyond: places beyond the map in metres, (B, 2), see `places_beyond`.
        on_map: frames that lie on the map for other reasons. With any, the places where the registration has searched are kept.
    """
    side = float(np.median(retrieval.sizes))
    spacing = side * (1 - retrieval.overlap)
    track, motion, evidence = smoothed(retrieval, flight, options.speed, beyond, on_map)
    for i, located in enumerate(frames):
        radius = float(np.hypot(track.radii[i], spacing / 2))
        state: State = "accepted"
        sentence = track.sentence(i)
        if i in retrieval.broken:
            state, sentence = "refused", "The photo cannot be read; the position is a guess of its neighbours."
        elif track.beyond[i] > _LEFT:
            state, sentence = "refused", left_map(float(track.beyond[i]))
        elif radius > side:
            state = "refused"
            sentence = (
                f"Its radius of {radius:.0f} m ({SIGMA}) is larger than a piece of the map, {side:.0f} m wide. "
                f"{sentence}"
            )
        elif track.nearby[i] < CONFIDENCE:
            state = "refused"
            probability = math.floor(100 * track.nearby[i]) / 100  # never rounded up to what is needed
            sentence = (
                f"The frame lies within {OVERLAP * side:.0f} m of this place with a probability of {probability:.2f}, and "
                f"{CONFIDENCE:.2f} are needed. {sentence}"
            )
        if not on_map:
            located.likely = [(*retrieval.places[w].tolist(), float(retrieval.sizes[w])) for w in track.first[i]]
        x, y = (float(value) for value in track.positions[i])
        heading = None if math.isnan(track.headings[i]) else float(track.headings[i])
        answer = StageRecord(state, sentence, x, y, radius=radius, heading=heading)
        if answer.accepted and evidence < EVIDENCE:
            answer = msgspec.structs.replace(
                answer, state="refused", unverified=True, sentence=f"{_UNVERIFIED} {sentence}"
            )
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


def confirm_sequence(frames: Sequence[LocatedFrame], side: float, bounds: tuple[float, float, float, float]) -> None:
    """Accept the answers that were refused because nothing showed that the map is of this place, where registrations do.

    The registration searches about the sequence's own answer, so a false one may agree by chance. It does so with a
    probability of p, the share of the searched ground that counts as agreement; on the right map 0.9 agree. The log odds,
    log(0.9 / p) of one that agrees and log(0.1 / (1 - p)) of another one, are added up and have to reach 4. False ones whose
    places are independent reach it with a probability of exp(-4) at most (Markov's inequality). Where p is above 0.9, as on a
    map that is hardly larger than a window, a registration tells nothing. Photos of one view are not independent, and count once.

    Args:
        side: of the windows in metres. A registration agrees within three quarters of it.
        bounds: of the map: west, south, east, north in metres.
    """
    evidence = 0.0
    for i in new_views(frames):
        located = frames[i]
        sequence, registration = located.stages.get("sequence"), located.stages["registration"]
        if sequence is None or not sequence.unverified:
            continue
        chance = chance_to_agree(np.array(located.likely_places()), side, registration.width or side, bounds)
        if chance < AGREEING:
            agrees = registration.distance(np.array([sequence.x, sequence.y])) <= OVERLAP * side
            evidence += math.log(AGREEING / chance if agrees else (1 - AGREEING) / (1 - chance))
    if evidence < EVIDENCE:
        return
    for located in frames:
        if (answer := located.stages.get("sequence")) is not None and answer.unverified:
            located.stages["sequence"] = msgspec.structs.replace(
                answer, state="accepted", unverified=False, sentence=answer.sentence.removeprefix(_UNVERIFIED).strip()
            )


def chance_to_agree(
    places: Float64Array, side: float, width: float, bounds: tuple[float, float, float, float]
) -> float:
    """Return the share of the ground where a photo's middle may be registered that lies near the first of places (K, 2).

    Args:
        side: of the windows in metres; within three quarters of it a registration agrees.
        width: of the ground across the photo.
    """
    return share_near(places[0], OVERLAP * side, bounds, places, middle_reach(side / 2, width))
