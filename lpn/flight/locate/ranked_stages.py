"""The stages that rank windows: retrieval, and the sequence over its scores."""

from __future__ import annotations

import math
from collections.abc import Collection

import cv2
import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.files import Flight
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.retrieval import MapRetrieval, WindowGallery
from lpn.flight.locate.sequence import (
    MotionModel,
    SequencePoint,
    elapsed_seconds,
    emissions,
    fitted,
    posteriors,
    score_units,
)
from lpn.flight.maps import Map

# A place is accepted if the windows around it, within this share of a side, together have this probability.
OVERLAP = 0.75
CONFIDENCE = 0.98
# If steps along the headings have at least these log odds, the map counts as one of the flight's place.
EVIDENCE = 4.0
# A frame counts as beyond the map if places there have more than this probability.
_LEFT = 0.5
# A place within the map's bounds counts as beyond the map if the map shows less than this share of its window.
_SHOWN = 0.5
_UNREAD = "The photo cannot be read; the position is a guess from its neighbours."


def enter_retrieval(retrieval: MapRetrieval, frames: list[LocatedFrame], k: int) -> None:
    """Enter the answers of the retrieval, and the k best windows."""
    gallery = retrieval.gallery
    for i, located in enumerate(frames):
        if i in retrieval.broken:
            located.stages["retrieval"] = StageRecord("refused", retrieval.broken[i])
            continue
        located.windows = retrieval.best(i, k)
        best, scores = located.windows[0], retrieval.scores(i)
        turned = "" if len(retrieval.views[i].headings) == 1 else f", turned to {best.heading:.0f} degrees"
        off = np.abs(gallery.places - (best.x, best.y)).max(axis=1)
        apart = off >= (gallery.sizes + best.size) / 2
        margin = f"the margin to windows apart from it is {2 * (best.score - scores[apart].max(initial=-2)):.3f} d²"
        located.stages["retrieval"] = StageRecord(
            "not verified",
            f"The best of {len(gallery.windows)} windows has the score {best.score:.3f}{turned}; "
            f"{margin if apart.any() else 'no window lies apart from it'}; not verified.",
            best.x,
            best.y,
            heading=best.heading,
        )


def enter_sequence(
    retrieval: MapRetrieval,
    flight: Flight,
    frames: list[LocatedFrame],
    beyond: Float64Array,
    on_map: Collection[int] = (),
) -> None:
    """Enter the answers of the sequence.

    A frame with a heading has only this heading as a state, and each window has its best score over the tried turns. Other frames
    have all tried headings as states. Unless the direction of flight proves that the map is of the flight's place, answers are
    refused until `judge_map`.

    Args:
        beyond: places beyond the map in metres, (B, 2), see `places_beyond`.
        on_map: frames known to lie on the map, which have no place beyond it.
    """
    gallery, times = retrieval.gallery, flight.times
    best = np.stack([retrieval.scores(i) for i in range(len(frames))])
    compared = np.stack([gallery.compared(views) for views in retrieval.views])
    headings = [
        np.array(
            [heading]
            if (heading := located.frame.heading) is not None
            else [math.nan]
            if i in retrieval.broken
            else retrieval.views[i].headings
        )
        for i, located in enumerate(frames)
    ]
    elapsed = elapsed_seconds(times)
    units = score_units(best, MotionModel(spacing=gallery.step).deviation(elapsed[1:]), gallery.side, compared)

    def scores(i: int) -> Float64Array:
        return units(i, best[i][:, None] if len(headings[i]) == 1 else retrieval.scores_by_heading(i))

    motion, temperature, evidence = fitted(scores, headings, gallery.places, times, gallery.step)
    # No frame precedes the first, so it takes the likeness of the second.
    alike = motion.alike(np.concatenate([elapsed[1:2], elapsed[1:]]), gallery.side) if len(frames) > 1 else [0.0]

    def log_emissions(i: int) -> Float64Array:
        logs = emissions(scores(i), temperature, len(beyond), alike[i])
        if i in on_map:
            logs[len(gallery.places) :] = -np.inf
        return logs

    places = np.concatenate([gallery.places, beyond])
    for i, joint in posteriors(log_emissions, headings, places, times, motion, len(beyond)):
        point = SequencePoint.of(joint, places, headings[i], OVERLAP * gallery.side, len(beyond))
        answer = sequence_answer(point, gallery, evidence >= EVIDENCE)
        if i in retrieval.broken:
            answer = msgspec.structs.replace(answer.refused("unread"), finding=_UNREAD)
        frames[i].stages["sequence"] = answer


def places_beyond(basemap: Map, gallery: WindowGallery) -> Float64Array:
    """Return places beyond the windows of a map in metres, (B, 2), on the windows' grids.

    They lie up to one side away from a window, where a further window would leave the map's bounds or show less than half of its
    ground. A drone farther away stays at the outermost places. Windows that an index has not returned are not replaced by places.
    """
    found = []
    for size in gallery.levels:
        places, step = gallery.places[gallery.sizes == size], size * (1 - gallery.overlap)
        reach = int(size / step + 0.01)
        cells = np.rint((places - places.min(axis=0)) / step).astype(np.int64) + reach
        own = np.zeros(cells.max(axis=0) + reach + 1, np.uint8)
        own[tuple(cells.T)] = 1
        near = cv2.dilate(own, np.ones((2 * reach + 1, 2 * reach + 1), np.uint8))
        free = (np.argwhere((near > own).T)[:, ::-1] - reach) * step + places.min(axis=0)
        low, high = np.array(basemap.bounds[:2]) + size / 2, np.array(basemap.bounds[2:]) - size / 2
        out = ((free < low - step / 2) | (free > high + step / 2)).any(axis=1)
        found.append(free[out | (basemap.valid_shares(free, size) < _SHOWN)])
    return np.concatenate(found)


def sequence_answer(point: SequencePoint, gallery: WindowGallery, proven: bool) -> StageRecord:
    """Return the answer of the sequence for a frame.

    Args:
        proven: whether the map is known to be of the flight's place; if not, the answer is refused until `judge_map`.
    """
    radius = math.hypot(point.radius, gallery.side * (1 - gallery.overlap) / 2)
    heading = None if math.isnan(point.heading) else point.heading
    x, y = point.position.tolist()
    answer = StageRecord("accepted", "", x, y, radius=radius, heading=heading)
    if point.beyond > _LEFT:
        return answer.refused("beyond", probability=_floored(point.beyond))
    if radius > gallery.side:
        return answer.refused("wide", radius=radius, side=gallery.side)
    if point.nearby < CONFIDENCE:
        metres, probability = OVERLAP * gallery.side, _floored(point.nearby)
        return answer.refused("unsure", metres=metres, probability=probability, needed=CONFIDENCE)
    answer = msgspec.structs.replace(answer, finding="The frames about it agree on this place.")
    return answer if proven else answer.refused("unproven")


def _floored(probability: float) -> float:
    """Round a probability down to two digits, so that it never seems to reach a limit that it misses."""
    return math.floor(100 * probability) / 100
