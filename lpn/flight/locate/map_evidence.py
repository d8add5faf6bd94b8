"""Evidence that a map is of the flight's place, as one sum of log odds.

A photo of another place fits a map by chance now and then, most often over trees: on such maps up to two of nine photos did. Each
kind of evidence is the log of a ratio: its probability on the right map over its probability on another map. The latter is the
share of the searched ground that would agree as well. So a search that can hardly fail, such as one close about a prediction,
proves nothing by itself.

    number      photos that fit: on another map an unknown share fits, up to a fifth
    neighbours  successive photos that overlap on the ground by less than half
    sequence    photos that lie within three quarters of a window's side of their sequence's answer
    tags        photos that lie where their GPS tags say

The share of photos that agree on the right map is unknown, so all shares are equally likely. Even on the right map few photos
may fit and none overlap. So number and neighbours are evidence on only a share of right maps, and their absence costs little. If
false places are independent, a sum of 3 has a probability of at most exp(-3) (Markov's inequality). Photos of one view count
once.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import NamedTuple

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.locate.located import LocatedFrame
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


class _View(NamedTuple):
    """The ground of a registered photo: its middle, (2,), width, and radius in metres."""

    middle: Float64Array
    width: float
    radius: float

    def is_new(self, views: Iterable[_View], share: float) -> bool:
        """Tell whether it differs from other views; middles nearer than `share` of the width make one view."""
        return all(
            math.dist(self.middle, one.middle) > max(share * max(self.width, one.width), self.radius + one.radius)
            for one in views
        )


class MapEvidence:
    """The log odds that a map is of a flight's place, summed photo by photo.

    Args:
        bounds: west, south, east, north of the map in metres.
        prior: reach in metres of the search about each photo's tag, if there is no model; None if tags were not used.
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
        # The view of the last photo; None if it fits nowhere.
        self._before: _View | None = None
        # Views so far, and views with tags.
        self._views, self._tagged = (deque[_View](maxlen=kept) for _ in range(2))
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
            searched: side in metres of the square searched about the sequence's answer, to which the photo's own ground is
                added; by default the side of a window.
        """
        before, self._before = self._before, None
        self._photos += 1
        answer, sequence = (located.stages.get(stage) for stage in ("registration", "sequence"))
        # A place is no evidence if the map contradicts it outside the photo's middle.
        if answer is None or not answer.accepted or answer.x is None or map_misfit(answer) is not None:
            self._fits.append(False)
            return
        middle = np.array([answer.x, answer.y]) if answer.homography is None else located.middle(answer)
        self._before = view = _View(middle, answer.width or 0.0, answer.own_radius)
        margin = self.prior if self._side is None else (searched or self._side) / 2
        if is_new := view.is_new(self._views, _ONE_VIEW):
            self._views.append(view)
            self._fits.append(True)
        if is_new and before is not None:
            reach, metres = (before.width + view.width) / 2, np.linalg.norm(before.middle - middle)
            if metres > _SAME_THINGS * reach:
                chance = self._chance(located, view, before.middle, reach, margin)
                self._neighbours.append((chance, bool(metres <= reach)))
        if is_new and self._side is not None and sequence is not None and (sequence.accepted or sequence.unverified):
            there, near = np.array([sequence.x, sequence.y]), OVERLAP * self._side
            chance = self._chance(located, view, there, near, margin)
            self._sequence.append((chance, bool(np.linalg.norm(there - middle) <= near)))
        if located.tag is not None and view.is_new(self._tagged, _SAME_THINGS):
            self._tagged.append(view)
            # A search about windows ignores tags, so a false place may lie anywhere on the map.
            apart, allowed = beside_tag(located, answer)
            self._tags.append((self._chance(located, view, located.tag, allowed, self.prior), apart <= allowed))

    @property
    def log_odds(self) -> float:
        """The sum of all evidence."""
        fits = _mixed(_log_ratio_of_number(self.views, len(self._fits)), _TELLING)
        # A run of neighbours that share one false match may begin at any photo.
        neighbours = _mixed(_log_ratio(self._neighbours), 1 / max(self._photos, 2))
        return fits + neighbours + _log_ratio(self._sequence) + _log_ratio(self._tags)

    def _chance(
        self, located: LocatedFrame, view: _View, point: Float64Array, distance: float, margin: float | None
    ) -> float:
        """Return the share of the searched ground that lies within `distance` metres of a point, 0 < share <= 1."""
        west, south, east, north = self._bounds
        places = None if margin is None else located.searched_places(around_tag=self._side is None)
        if margin is None or places is None:
            return min(1.0, math.pi * distance**2 / ((east - west) * (north - south)))
        # The search reaches beyond the ground that the photo shows.
        reach = margin + (AROUND - 0.5) * view.width
        steps = reach * (np.arange(_POINTS) * 2 + 1 - _POINTS) / _POINTS
        points = (places[:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)).reshape(-1, 2)
        points = points[((points >= (west, south)) & (points <= (east, north))).all(axis=1)]
        if not len(points):
            return 1.0
        # A point in several squares is listed several times.
        weights = 1 / (np.abs(points[:, None] - places) <= reach + 1e-6).all(axis=2).sum(axis=1)
        near = np.linalg.norm(points - point, axis=1) <= distance
        return float(max(weights[near].sum(), weights.min()) / weights.sum())


def judge_map(frames: Sequence[LocatedFrame], evidence: MapEvidence) -> list[str]:
    """Accept the sequence's answers if the map is of the flight's place, else refuse all registrations; return sentences.

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


def _log_ratio(trials: Iterable[tuple[float, bool]]) -> float:
    """Return the log ratio of the trials' probability on the right map and on another map.

    A trial is its chance to agree, 0 < chance <= 1, and whether it agrees. On the right map an unknown share agrees for sure,
    and the others by chance; all shares are equally likely.
    """
    logs = np.zeros(len(_SHARES))
    for chance, agrees in trials:
        logs += np.log1p(_SHARES * (1 - chance) / chance if agrees else -_SHARES)
    return float(np.logaddexp.reduce(logs)) - math.log(len(_SHARES))


def _log_ratio_of_number(count: int, chances: int) -> float:
    """Return the log ratio of `count` fits in `chances` views on the right map and on another.

    On the right map all shares of fits are equally likely; on another map, all shares up to 1/5. So the ratio is 1/5 over the
    probability of more than `count` fits in `chances` + 1 trials of probability 1/5.
    """
    trials, yes, no = chances + 1, math.log(_CHANCE), math.log(1 - _CHANCE)
    logs = [
        math.lgamma(trials + 1) - math.lgamma(k + 1) - math.lgamma(trials + 1 - k) + k * yes + (trials - k) * no
        for k in range(count + 1, trials + 1)
    ]
    return yes - float(np.logaddexp.reduce(logs))


def _mixed(log_ratio: float, share: float) -> float:
    """Return the log odds of evidence that is informative on only a share of all right maps."""
    return float(np.logaddexp(math.log1p(-share), math.log(share) + log_ratio))
