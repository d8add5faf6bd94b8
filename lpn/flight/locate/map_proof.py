"""Registrations that are as few as on a map of another place, where nothing else shows that the map is of the flight's place.

A photo of another place fits a map by chance now and then, most often where trees stand on both. On such maps up to two of nine
photos did. So registrations that are not more than that prove nothing by their number. They prove something by their places if
neighbours overlap on the ground more often than by chance. The chance is the share of the searched ground that lies so near. It
is large where a model has each photo searched near the one before. Tags prove the map only if half of the registrations lie where
their tags say: tags that merely lie on it let false registrations pass. Where only the surroundings of each tag were searched
(`--prior`), a false registration lies near its tag and near its neighbours anyway, so each agreement counts by its chance there.
Photos of one view, such as those of a drone that hovers, fit by one and the same chance, so they count once.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import msgspec
import numpy as np

from lpn.core.arrays import Float64Array
from lpn.flight.locate.belief import disagreements, tag_allowance
from lpn.flight.locate.located import LocatedFrame
from lpn.flight.locate.registered_stage import AROUND, FEWEST

# Share of the views that fit a map of another place by chance, and the log odds that exceed it.
_CHANCE, _EVIDENCE = 0.2, 4.0
# Points along each side of a searched square at which a chance is measured.
_POINTS = 41
# Shares of overlapping neighbours over which the odds are averaged.
_SHARES = 20
# Photos whose middles are nearer than this share of their ground width, or than their radii, are of one view.
ONE_VIEW = 0.25
# Photos nearer than this share of their ground width see some of the same things, which may mislead both alike.
_SAME_THINGS = 0.5


def refuse_unproven(
    frames: Sequence[LocatedFrame],
    bounds: tuple[float, float, float, float],
    prior: float | None = None,
    side: float | None = None,
) -> list[str]:
    """Refuse the accepted registrations of a flight unless something shows that the map is of its place; return a sentence.

    It is shown by tags with which half of the registrations agree within both errors, by a correction, by an accepted answer of
    the sequence, by the number of registered views, or by neighbours that overlap. Flights of fewer than five frames are left as
    they are.

    Args:
        frames: their registrations are replaced.
        bounds: x0, y0, x1, y1 of the map in metres.
        prior: metres about each photo's tag that were searched without a model; None if the tags were not used.
        side: of the windows in metres about which a model had it searched; None without a model.
    """
    registered = [located for located in frames if _registered(located)]
    if len(frames) < FEWEST or not registered or _shown(frames):
        return []
    views = new_views(frames)
    if _tags_agree(frames, bounds, prior):
        return []
    # Further photos of a view are no further chances.
    chances = len(frames) - len(registered) + len(views)
    if -_log_chance(len(views), chances, _CHANCE) >= _EVIDENCE:
        return []
    if _overlaps(frames, views, bounds, prior if side is None else side / 2) >= _EVIDENCE + math.log(len(frames)):
        return []
    count, total = len(registered), len(frames)
    if len(views) == count:
        few = f"Only {count} of {total} photos fit{'s' if count == 1 else ''} this map, as by chance"
    else:
        shown = "one view" if len(views) == 1 else f"{len(views)} views"
        few = f"The {count} of {total} photos that fit this map show {shown}, as by chance"
    confirms = "no GPS tags confirm it"
    if any(located.tag is not None for located in registered):
        confirms = "their GPS tags do not confirm it"
        if prior is not None:
            confirms = f"their GPS tags prove little, as only the map within {prior:g} m of each was searched"
    sentence = f"{few} on a map of another place, and {confirms}"
    for located in registered:
        answer = located.stages["registration"]
        located.stages["registration"] = msgspec.structs.replace(
            answer, state="refused", unverified=True, sentence=f"{sentence}. {answer.sentence}"
        )
    return [f"{sentence}, so none was accepted; check that the map is of the flight's place."]


def _shown(frames: Sequence[LocatedFrame]) -> bool:
    """Return whether a correction or the sequence shows that the map is of the flight's place."""
    return any(
        located.by_hand is not None or ("sequence" in located.stages and located.stages["sequence"].accepted)
        for located in frames
    )


def _tags_agree(
    frames: Sequence[LocatedFrame],
    bounds: tuple[float, float, float, float],
    prior: float | None,
) -> bool:
    """Return whether half of the registrations lie where their tags say, and with a prior more of them than by chance."""
    contradicted = {one.frame for one in disagreements(frames) if (one.one, one.other) == ("registration", "tag")}
    registered = [i for i, located in enumerate(frames) if _registered(located)]
    tags = {i: tag for i in registered if (tag := frames[i].tag) is not None}
    agreeing = tags.keys() - contradicted
    if 2 * len(agreeing) < len(registered):
        return False
    if prior is None:
        return True
    tagged = list(tags)
    views = [tagged[view] for view in new_views([frames[i] for i in tagged], _SAME_THINGS)]
    chances = [_chance_near(frames[i], tags[i], tag_allowance(frames[i]), bounds, prior) for i in views]
    # Of chances that differ, a binomial distribution of their mean has the longer tail (Hoeffding, 1956).
    agreed = len(agreeing.intersection(views))
    return -_log_chance(agreed, len(chances), float(np.mean(chances))) >= _EVIDENCE


def _registered(located: LocatedFrame) -> bool:
    answer = located.stages.get("registration")
    return answer is not None and answer.accepted and answer.x is not None and answer.y is not None


def _middle(located: LocatedFrame) -> Float64Array:
    """Return the ground at the middle of a registered picture in metres, (2,)."""
    answer = located.stages["registration"]
    return np.array([answer.x, answer.y]) if answer.homography is None else located.middle(answer)


def new_views(frames: Sequence[LocatedFrame], share: float = ONE_VIEW) -> list[int]:
    """Return the numbers of registered frames that show a view which no earlier one of them does.

    Args:
        share: of the ground width within which middles are of one view.
    """
    views: list[tuple[int, Float64Array, float, float]] = []
    for i, located in enumerate(frames):
        if not _registered(located):
            continue
        middle, answer = _middle(located), located.stages["registration"]
        width, radius = answer.width or 0.0, answer.own_radius
        if all(
            np.linalg.norm(middle - place) > max(share * max(width, wide), radius + wrong)
            for _, place, wide, wrong in views
        ):
            views.append((i, middle, width, radius))
    return [i for i, *_ in views]


def _log_chance(count: int, chances: int, chance: float) -> float:
    """Return the logarithm of the probability that `count` of so many chances or more come true (binomial)."""
    if chance >= 1:
        return 0.0
    logs = [
        math.lgamma(chances + 1) - math.lgamma(k + 1) - math.lgamma(chances - k + 1)
        + k * math.log(chance) + (chances - k) * math.log(1 - chance)
        for k in range(count, chances + 1)
    ]  # fmt: skip
    most = max(logs)
    return most + math.log(sum(math.exp(log - most) for log in logs))


def _overlaps(
    frames: Sequence[LocatedFrame],
    views: Sequence[int],
    bounds: tuple[float, float, float, float],
    margin: float | None,
) -> float:
    """Return the log odds that registered pictures of neighbours in the flight overlap more than by chance.

    Neighbours count where the later one is a new view. On the right map an unknown share of them overlaps for sure, and the
    others by chance; all shares are equally likely.
    """
    new, logs = set(views), np.zeros(_SHARES)
    shares = (np.arange(_SHARES) + 0.5) / _SHARES
    for (_, one), (i, other) in pairwise(enumerate(frames)):
        if i not in new or not _registered(one):
            continue
        reach = ((one.stages["registration"].width or 0.0) + (other.stages["registration"].width or 0.0)) / 2
        if reach <= 0:
            continue
        chance = _chance_near(other, _middle(one), reach, bounds, margin)
        overlap = np.linalg.norm(_middle(one) - _middle(other)) <= reach
        logs += np.log1p(shares * (1 - chance) / chance if overlap else -shares)
    return float(logs.max() + np.log(np.exp(logs - logs.max()).mean()))


def _chance_near(
    located: LocatedFrame,
    point: Float64Array,
    distance: float,
    bounds: tuple[float, float, float, float],
    margin: float | None,
) -> float:
    """Return the `share_near` of the ground on which the registration of a photo looked for its middle."""
    reach = middle_reach(margin or 0.0, located.stages["registration"].width or 0.0)
    places = located.searched_places(around_tag=margin is not None)
    return share_near(point, distance, bounds, places, reach)


def middle_reach(margin: float, width: float) -> float:
    """Return how far along an axis the middle of a photo within the searched square may lie from the square's middle, in metres.

    Args:
        margin: searched metres beyond the ground of a photo: half of a window's side, or the prior.
        width: of the ground across the photo.
    """
    return margin + (AROUND - 0.5) * width


def share_near(
    point: Float64Array,
    distance: float,
    bounds: tuple[float, float, float, float],
    places: Float64Array | None,
    reach: float,
) -> float:
    """Return the share of the searched ground that lies within so many metres of a point, (2,): above 0, to 1.

    Args:
        bounds: of the map: west, south, east, north in metres.
        places: (K, 2), about which squares of side 2 `reach` were searched; None for the whole map.
    """
    west, south, east, north = bounds
    if places is None:
        return min(1.0, math.pi * distance**2 / ((east - west) * (north - south)))
    steps = reach * (np.arange(_POINTS) * 2 + 1 - _POINTS) / _POINTS
    points = (places[:, None] + np.stack(np.meshgrid(steps, steps), axis=-1).reshape(1, -1, 2)).reshape(-1, 2)
    points = points[((points >= bounds[:2]) & (points <= bounds[2:])).all(axis=1)]
    if not len(points):
        return 1.0
    # A point of several squares is there several times.
    weights = 1 / (np.abs(points[:, None] - places) <= reach + 1e-6).all(axis=2).sum(axis=1)
    near = np.linalg.norm(points - point, axis=1) <= distance
    return float(max(weights[near].sum(), weights.min()) / weights.sum())
