"""Evidence that a map is of the flight's place, as one sum of log odds.

A photo of another place fits a map by chance now and then, most often over trees: on such maps up to two of nine photos did. Each
kind of evidence is the log of a ratio: its probability on the right map over its probability on another map. The latter is the
share of the searched ground that would agree as well. So a search that can hardly fail, such as one close about a prediction,
proves nothing by itself.

    number      photos that fit: on another map an unknown share does, up to a fifth
    neighbours  successive photos that overlap on the ground by less than half
    sequence    photos that lie within three quarters of a window's side of their sequence's answer
    tags        photos that lie where their GPS tags say

The share of photos that agree on the right map is unknown, so all shares are equally likely. On the right map few photos may fit
and none overlap, so number and neighbours are mixed with no evidence at all, and their lack costs little. If false places are
independent, a sum of 3 has a probability of at most exp(-3) (Markov's inequality). Photos of one view count once.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.locate.located import LocatedFrame, StageRecord
from lpn.flight.locate.ranked_stages import OVERLAP
from lpn.flight.locate.registered_stage import AROUND
from lpn.flight.locate.verdict import beside_tag, map_misfit
from lpn.flight.locate.words import Reason

# Log odds from which the map counts as of the flight's place: odds of 20.
ENOUGH = 3.0
# Largest share of views that fit a map of another place by chance.
_CHANCE = 0.2
# Share of flights over the right map whose number of fitting photos is evidence.
_TELLING = 1 / 3
# Shares of agreeing photos over which odds are averaged.
_SHARES = (np.arange(20) + 0.5) / 20
# Points along each side of a searched square at which a chance is measured.
_POINTS = 41
# Photos are of one view if their middles are nearer than this share of their ground width, or than their radii.
_ONE_VIEW = 0.25
# Photos nearer than this share of their ground width show common objects, which may mislead both.
_SAME_THINGS = 0.5


class MapEvidence:
    """The log odds that a map is of a flight's place, summed photo by photo.

    Args:
        bounds: west, south, east, north of the map in metres.
        prior: metres of the search about each photo's tag without a model; None if tags were not used.
        side: metres of the model's windows about which photos were searched; None without a model.
        kept: number of the last views and photos that count; None for all.

    Attributes:
        prior: see the arguments.
    """

    def __init__(
        self,
        bounds: tuple[float, float, float, float],
        prior: float | None = None,
        side: float | None = None,
        kept: int | None = None,
    ) -> None:
        self._bounds, self.prior, self._side = bounds, prior, side
        self._before: LocatedFrame | None = None
        # Middles, ground widths, and radii of the views so far, and of the views with tags.
        self._views, self._tagged = (deque[tuple[Float64Array, float, float]](maxlen=kept) for _ in range(2))
        self._fits = deque[bool](maxlen=kept)
        # For each photo: its chance to agree, and whether it does.
        self._neighbours, self._sequence, self._tags = (deque[tuple[float, bool]](maxlen=kept) for _ in range(3))
        self._photos = 0

    @property
    def views(self) -> int:
        """Number of views that fit the map."""
        return sum(self._fits)

    def add(self, located: LocatedFrame, searched: float | None = None) -> None:
        """Add the evidence of a photo, registered or not.

        Args:
            searched: side in metres of the search about the sequence's answer, without the photo's own ground; by default a
                window's.
        """
        before, self._before = self._before, None
        self._photos += 1
        answer = located.stages.get("registration")
        if answer is None or not _fits(answer):
            self._fits.append(False)
            return
        self._before = located
        middle, width = _middle_of(located, answer), answer.width or 0.0
        view = middle, width, answer.own_radius
        margin = self.prior if self._side is None else (searched or self._side) / 2
        if is_new := _is_new(view, self._views, _ONE_VIEW):
            self._views.append(view)
            self._fits.append(True)
        if is_new and before is not None:
            reach = ((before.stages["registration"].width or 0.0) + width) / 2
            there = _middle_of(before, before.stages["registration"])
            if np.linalg.norm(there - middle) > _SAME_THINGS * reach:
                chance = self._chance(located, there, reach, margin)
                self._neighbours.append((chance, bool(np.linalg.norm(there - middle) <= reach)))
        sequence = located.stages.get("sequence")
        if is_new and self._side is not None and sequence is not None and (sequence.accepted or sequence.unverified):
            there, near = np.array([sequence.x, sequence.y]), OVERLAP * self._side
            chance = self._chance(located, there, near, margin)
            self._sequence.append((chance, bool(np.linalg.norm(there - middle) <= near)))
        if located.tag is not None and _is_new(view, self._tagged, _SAME_THINGS):
            self._tagged.append(view)
            # A search about windows ignores tags, so a false place may lie anywhere on the map.
            metres, allowed = beside_tag(located, answer)
            self._tags.append((self._chance(located, located.tag, allowed, self.prior), metres <= allowed))

    @property
    def log_odds(self) -> float:
        """The sum of all evidence."""
        fits = _mixed(_log_ratio_of_number(self.views, len(self._fits)), _TELLING)
        # A run of neighbours that share one false match may begin at any photo.
        neighbours = _mixed(_log_ratio(self._neighbours), 1 / max(self._photos, 2))
        return fits + neighbours + _log_ratio(self._sequence) + _log_ratio(self._tags)

    def _chance(self, located: LocatedFrame, point: Float64Array, distance: float, margin: float | None) -> float:
        """Return the share of the searched ground of a photo's middle that lies near a point."""
        # The middle may lie off the searched square's middle by the margin, and by the ground searched beyond the photo's own.
        reach = (margin or 0.0) + (AROUND - 0.5) * (located.stages["registration"].width or 0.0)
        places = None if margin is None else located.searched_places(around_tag=self._side is None)
        return _share_near(point, distance, self._bounds, places, reach)


def judge_map(frames: Sequence[LocatedFrame], evidence: MapEvidence) -> list[str]:
    """Accept the sequence's answers if the map is of the flight's place, else refuse its registrations; return sentences.

    The map is of the place if `MapEvidence` suffices, a person has corrected a photo, the sequence has an accepted answer (by the
    direction of flight), or the details of one photo suffice alone, see `StageRecord.alone`.

    Args:
        frames: their registrations and sequences are replaced.
        evidence: the sum to which frames are added.
    """
    known = False
    for located in frames:
        evidence.add(located)
        sequence, answer = (located.stages.get(stage) for stage in ("sequence", "registration"))
        known |= located.by_hand is not None or (sequence is not None and sequence.accepted)
        known |= answer is not None and answer.accepted and answer.alone
    if known or evidence.log_odds >= ENOUGH:
        for located in frames:
            if (held := located.stages.get("sequence")) is not None and held.unverified:
                located.stages["sequence"] = msgspec.structs.replace(held, state="accepted", code="")
        return []
    registered = [located for located in frames if located.stages["registration"].accepted]
    if not registered:
        return []
    numbers = {"photos": len(registered), "all": len(frames), "views": evidence.views}
    for located in registered:
        located.stages["registration"] = located.stages["registration"].refused("few", **numbers)
    farther = "" if evidence.prior is None else f", or search farther than {evidence.prior:g} m about its tags"
    return [
        f"{Reason('few', numbers).sentence} So none was accepted; check that the map is of the flight's place{farther}."
    ]


def _fits(answer: StageRecord) -> bool:
    """Tell whether a registration is accepted, and not contradicted by the map away from the photo's middle."""
    return answer.accepted and answer.x is not None and map_misfit(answer) is None


def _middle_of(located: LocatedFrame, answer: StageRecord) -> Float64Array:
    """Return the ground at the middle of a registered picture in metres, (2,)."""
    return np.array([answer.x, answer.y]) if answer.homography is None else located.middle(answer)


def _is_new(
    view: tuple[Float64Array, float, float], views: Iterable[tuple[Float64Array, float, float]], share: float
) -> bool:
    """Tell whether a view (middle, ground width, radius) differs from others; `share` of the width makes one view."""
    middle, width, radius = view
    return all(math.dist(middle, place) > max(share * max(width, wide), radius + wrong) for place, wide, wrong in views)


def _log_ratio(trials: Iterable[tuple[float, bool]]) -> float:
    """Return the log ratio of trials (chance to agree, 0 < chance <= 1; agreement) on the right map and on another.

    On the right map an unknown share agrees for sure, and the others by chance; all shares are equally likely.
    """
    logs = np.zeros(len(_SHARES))
    for chance, agrees in trials:
        logs += np.log1p(_SHARES * (1 - chance) / chance if agrees else -_SHARES)
    return float(logs.max() + np.log(np.exp(logs - logs.max()).mean()))


def _log_ratio_of_number(count: int, chances: int) -> float:
    """Return the log ratio of `count` fits in `chances` views on the right map and on another.

    All shares of fits are equally likely on the right map, and up to 1/5 on another. So the ratio is 1/5 over the probability of
    more than `count` fits in `chances` + 1 trials of probability 1/5.
    """
    logs = [
        math.lgamma(chances + 2) - math.lgamma(k + 1) - math.lgamma(chances + 2 - k)
        + k * math.log(_CHANCE) + (chances + 1 - k) * math.log(1 - _CHANCE)
        for k in range(count + 1, chances + 2)
    ]  # fmt: skip
    most = max(logs)
    return math.log(_CHANCE) - most - math.log(sum(math.exp(log - most) for log in logs))


def _mixed(log_ratio: float, share: float) -> float:
    """Return the log odds of evidence that is informative on only a share of all right maps."""
    return float(np.logaddexp(math.log1p(-share), math.log(share) + log_ratio))


def _share_near(
    point: Float64Array,
    distance: float,
    bounds: tuple[float, float, float, float],
    places: Float64Array | None,
    reach: float,
) -> float:
    """Return the share, 0 < share <= 1, of the searched ground within `distance` metres of a point, (2,).

    The ground is the squares of side 2 `reach` about `places`, (K, 2), or the map's bounds if None.
    """
    west, south, east, north = bounds
    if places is None:
        return min(1.0, math.pi * distance**2 / ((east - west) * (north - south)))
    steps = reach * (np.arange(_POINTS) * 2 + 1 - _POINTS) / _POINTS
    points = (places[:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)).reshape(-1, 2)
    points = points[((points >= bounds[:2]) & (points <= bounds[2:])).all(axis=1)]
    if not len(points):
        return 1.0
    # A point in several squares is listed several times.
    weights = 1 / (np.abs(points[:, None] - places) <= reach + 1e-6).all(axis=2).sum(axis=1)
    near = np.linalg.norm(points - point, axis=1) <= distance
    return float(max(weights[near].sum(), weights.min()) / weights.sum())
