"""Registration of a photo to the map: local features, a similarity by RANSAC, a homography if better, or a refusal.

A photo point is a complex number u: x to the right and y up from the picture's centre, in units of the picture's width. A map
point is m = east + i north in metres. A similarity is m = a u + b: |a| is the width of the ground that the picture shows,
-arg a the heading of its top (clockwise from north), and b the place of its centre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import cast

import cv2
import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float64Array, Int64Array
from lpn.core.homography import apply_homography, middle_pixel, translation
from lpn.core.numbers import wrap_degrees
from lpn.flight.locate.levelled import Described, PhotoView
from lpn.flight.locate.matchers import Complex, Ground, Matcher, mutual_within
from lpn.flight.locate.words import Reason

# Inliers of a similarity have residuals up to this share of the ground width, which tilt and relief at 50 m height cause.
_RADIUS = 0.015
# Guided matching looks for partners within this share of the ground width about their predicted place.
_REACH = 0.1
# A homography is judged at this share of the similarity's radius.
_TIGHT = 0.5
# A width is plausible within this factor of a known width, or within FREE_FACTOR of a tried one.
_WIDTH_FACTOR = 1.35
FREE_FACTOR = 2.0
# Degrees by which the heading may differ from the known heading, or from its opposite.
_HEADING_TOLERANCE = 40.0
# Least support: the sum of 1 - (residual / radius)^2 over the inliers, less the expectation by chance.
MIN_SUPPORT = 15.0
# The support must be this multiple of the support of the best other place.
MIN_RATIO = 1.7
# Beyond these degrees from the expected heading, where few pictures lie, a place needs this multiple of the support.
_FAR_TURN = 60.0
_FAR_SUPPORT = 2.0
# Cells of a grid of 8 x 8 over the photo that must contain inliers.
MIN_CELLS = 6
_GRID = 8
# Largest distance of a centre off the map as a share of the ground width.
_OFF_MAP = 0.25
_SAMPLES = 200_000
_HYPOTHESES = 4000
# Maximum of places that are matched again, and their least distance in ground widths.
_PLACES = 4
APART = 0.25
_NONE = np.zeros(0, np.complex128)


def is_turned_over(turn: float | None) -> bool:
    """Tell whether a turn in degrees against the heading is about 180, as of a file turned after the flight."""
    return turn is not None and abs(turn) > 135


@dataclass(frozen=True)
class Expectation:
    """Prior knowledge of a photo, for its registration.

    Attributes:
        width: metres of ground across the picture.
        heading: of the picture's top, degrees clockwise from north; None if unknown.
        certain: whether the heading is of the picture, not of a course or an aircraft. Unless an uncertain heading or its
            opposite has twice the needed support and ratio, all headings are tried, and the best supported one is taken.
        guess: heading to try first if none is known, as by an earlier stage. Unless it has twice the needed support and
            ratio, all headings are tried.
        tried: whether the width is only a try, which may be wrong by a factor of 2.
    """

    width: float
    heading: float | None = None
    certain: bool = True
    guess: float | None = None
    tried: bool = False


@dataclass(frozen=True, eq=False)
class PhotoPlace:
    """A place of a photo: the similarity m = a u + b, see the module.

    Attributes:
        support: see `MIN_SUPPORT`; before guided matching, of all matches, without the subtraction of chance.
        u, m: its guided matches on photo and map, (M,) complex each; empty before guided matching.
        matches: number of matches in the support, which are within a larger reach than `u` and `m`.
        seen: the photo's features, turned as the place needs them.
    """

    a: complex
    b: complex
    support: float = 0.0
    u: Complex = field(default_factory=lambda: _NONE)
    m: Complex = field(default_factory=lambda: _NONE)
    matches: int = 0
    seen: Described | None = None

    @property
    def limit(self) -> float:
        """Metres within which a match agrees with the place."""
        return _RADIUS * abs(self.a)

    @property
    def residuals(self) -> Float64Array:
        """Metres on the map from the matches to their predictions by the similarity, (M,)."""
        return cast(Float64Array, np.abs(self.a * self.u + self.b - self.m))

    def is_apart(self, other: PhotoPlace) -> bool:
        """Tell whether another place is farther away than a quarter of the ground width."""
        return abs(other.b - self.b) > APART * abs(self.a)


@dataclass(frozen=True, eq=False)
class Registration:
    """A photo laid over the map, or the reason of the refusal.

    Attributes:
        refusal: the reason of the refusal; None if accepted.
        matcher: the name of the matcher.
        model: "similarity" or "homography".
        inliers: number of matches that agree with the model.
        support: of this place, see `MIN_SUPPORT`.
        homography: from pixels of the photo (x, y, 1) to metres east and north, (3, 3) float64.
        centre: of the picture on the ground, metres east and north, (2,) float64.
        heading: of the picture's top, degrees clockwise from north, 0 .. 360.
        width: metres of ground across the picture's middle.
        turn: degrees clockwise, -180 .. 180, from the expected heading to `heading`; None if none was expected.
        covariance: of the centre in square metres, (2, 2) float64.
        places: all compared places, this one with its matches first.
        ground: the searched features of the map; None without a match.
    """

    refusal: Reason | None
    matcher: str
    model: str = "similarity"
    inliers: int = 0
    support: float = 0.0
    homography: Float64Array | None = None
    centre: Float64Array | None = None
    heading: float | None = None
    width: float | None = None
    turn: float | None = None
    covariance: Float64Array | None = None
    places: tuple[PhotoPlace, ...] = ()
    ground: Ground | None = None

    @property
    def accepted(self) -> bool:
        """True if the position may be used."""
        return self.refusal is None

    @property
    def radius(self) -> float | None:
        """The 1-sigma radius in metres: the root mean square of the two axes of the covariance."""
        return None if self.covariance is None else float(np.sqrt(np.trace(self.covariance) / 2))

    @property
    def turn_sentence(self) -> str:
        """A sentence about the turn against the heading; "" if they agree."""
        if self.turn is None or abs(self.turn) <= _HEADING_TOLERANCE:
            return ""
        return f"The picture is turned by {abs(self.turn):.0f} degrees against its heading."

    def laid(self, homography: Float64Array, size: tuple[int, int], expected: float | None) -> Registration:
        """Return the registration with a homography from pixels, (3, 3), and with centre, heading, width, and turn by it.

        Args:
            size: width and height of the picture in pixels.
            expected: heading in degrees, from which the picture's turn is measured.
        """
        middle = middle_pixel(*size)
        right, up = np.array([size[0] / 2, 0]), np.array([0, -0.01 * size[0]])
        centre, above, *ends = apply_homography(homography, [middle, middle + up, middle - right, middle + right])
        heading = float(np.degrees(np.arctan2(*(above - centre))) % 360)
        turn = None if expected is None else wrap_degrees(heading - expected)
        width = float(np.linalg.norm(ends[1] - ends[0]))
        homography = homography / homography[2, 2]
        return replace(self, homography=homography, centre=centre, heading=heading, width=width, turn=turn)

    def to_metres(self, pixels: npt.ArrayLike) -> Float64Array:
        """Convert pixels of the photo, (N, 2), to metres east and north, (N, 2)."""
        assert self.homography is not None
        return apply_homography(self.homography, pixels)

    def rematch(self, predicted: Complex, reach: float) -> tuple[Complex, Int64Array]:
        """Match features of the ground again near predicted places.

        Args:
            predicted: photo points u of the ground's features, (N,) complex; not finite for features outside of the photo.
            reach: in units of the picture's width.

        Returns:
            Photo points u, (K,), and the indices of their features of the ground, (K,).
        """
        near, ground = np.flatnonzero(np.isfinite(predicted) & (np.abs(predicted) < 1)), self.ground
        seen = self.places[0].seen if self.places else None
        if seen is None or ground is None or not len(near) or not len(seen.u):
            return _NONE, np.zeros(0, np.int64)
        pairs = mutual_within(seen.u, predicted[near], reach, seen.descriptors, ground.descriptors[near])
        return seen.u[pairs[:, 0]], near[pairs[:, 1]]


def register(
    matcher: Matcher,
    photo: PhotoView,
    ground: Ground,
    expected: Expectation,
    bounds: tuple[float, float, float, float] | None = None,
) -> Registration:
    """Register a photo to described ground.

    A place at the expected heading is more probable. A place at another heading must have more support, and is no rival.

    Args:
        ground: features of the searched part of the map.
        bounds: x0, y0, x1, y1 of the map in metres; a centre outside is refused.
    """
    if len(ground.points) < 8:
        return Registration(Reason("no detail"), matcher.name)
    seeds: list[PhotoPlace] = []
    places: list[PhotoPlace] = []
    refined: dict[PhotoPlace, PhotoPlace] = {}
    best = at_given = None
    rival = rival_at_given = nowhere = PhotoPlace(0j, 0j)
    for turns, heading in _turns(matcher, expected):
        if heading is None and expected.heading is not None and best is not None and _doubt(best, rival) is None:
            at_given, rival_at_given = best, rival
        for turn in turns:
            seen = photo.described(matcher, expected.width / ground.resolution, turn)
            seeds += _seeds(matcher, seen, ground, expected, heading)
        chosen = _distinct(seeds)
        refined |= {seed: _guided(seed, ground) for seed in chosen if seed not in refined}
        places = [refined[seed] for seed in chosen]
        best = _best(places)
        if best is None:
            continue
        rival = _best([place for place in places if best.is_apart(place)]) or nowhere
        if best.support >= 2 * MIN_SUPPORT and best.support >= 2 * MIN_RATIO * rival.support:
            break
    if best is None:
        return Registration(Reason("no match"), matcher.name)
    if at_given is not None:
        best = _best([at_given, best]) or best
        rival = (_best([rival, at_given]) or rival) if at_given.is_apart(best) else rival_at_given
    answer = _concluded(matcher, photo, best, rival, expected, bounds)
    return replace(answer, places=(best, *(place for place in places if place is not best)), ground=ground)


def contested(
    answer: Registration,
    photo: PhotoView,
    searches: Sequence[tuple[Matcher, Ground]],
    rivals: Sequence[PhotoPlace],
) -> Registration:
    """Refuse an accepted answer if a place of other searches has nearly its support by all matchers together.

    A matcher may find only one of several equal buildings.

    Args:
        searches: each matcher with its features of the searched part of the map.
        rivals: places of the other searches; those within a quarter of the ground width of the answer do not count.
    """
    own = answer.places[0]
    distinct = [own]
    for rival in rivals:
        if all(place.is_apart(rival) for place in distinct):
            distinct.append(rival)
    if len(distinct) == 1:
        return answer
    own, *others = (replace(place, support=_total_support(place, photo, searches)) for place in distinct)
    refusal = _rivalled(own, max(others, key=lambda place: place.support))
    return answer if refusal is None else replace(answer, refusal=refusal, support=own.support)


def proven(answer: Registration, photo: PhotoView, others: Sequence[tuple[Matcher, Ground]]) -> Registration:
    """Refuse an accepted answer for a photo that may be of another place, unless its support by all matchers is high.

    By one matcher, pictures of two meadows can agree as well as pictures of one place; another matcher then finds no
    agreement. So the support by all matchers together must reach 15 for each matcher and another 15.

    Args:
        others: the other matchers, with their features of the searched part of the map.
    """
    support = answer.support + _total_support(answer.places[0], photo, others)
    least = MIN_SUPPORT * (2 + len(others))
    if support >= least:
        return answer
    return replace(answer, refusal=Reason("anywhere", {"support": support, "needed": least}))


def _total_support(place: PhotoPlace, photo: PhotoView, searches: Sequence[tuple[Matcher, Ground]]) -> float:
    """Return the sum of a place's supports by guided matching, at least 0 each; 0 where the matches lead to another place."""
    total = 0.0
    for matcher, ground in searches:
        turn = float(-np.degrees(np.angle(place.a))) if matcher.tolerance < 90 else 0.0
        seen = photo.described(matcher, abs(place.a) / ground.resolution, turn)
        there = _guided(PhotoPlace(place.a, place.b, seen=seen), ground)
        total += 0.0 if place.is_apart(there) else max(there.support, 0.0)
    return total


def _turns(matcher: Matcher, expected: Expectation) -> Iterator[tuple[list[float], float | None]]:
    """Yield groups of headings to turn the photo by, each with the heading that limits the answer, in the order of tries."""
    narrow = matcher.tolerance < 90
    if expected.heading is not None:
        yield [expected.heading if narrow else 0.0], expected.heading
        if narrow:
            yield [expected.heading + 180], expected.heading
    elif expected.guess is not None and narrow:
        yield [expected.guess], None
    if expected.heading is None or not expected.certain:
        count = max(round(180 / matcher.tolerance), 1) if narrow else 1
        yield [i * 360 / count for i in range(count)], None


def _seeds(
    matcher: Matcher, seen: Described, ground: Ground, expected: Expectation, heading: float | None
) -> list[PhotoPlace]:
    """Return the similarities at distinct places with the most support among the matches."""
    pairs = matcher.match(seen.descriptors, ground)
    if len(pairs) < 4:
        return []
    u, m = seen.u[pairs[:, 0]], (ground.points[pairs[:, 1]] @ (1, 1j)).astype(np.complex128)
    a, b = _hypotheses(u, m, expected, heading)
    if not len(a):
        return []
    support = np.concatenate([_support(a[i : i + 500], b[i : i + 500], u, m) for i in range(0, len(a), 500)])
    seeds: list[PhotoPlace] = []
    while len(seeds) < _PLACES and support.max() > 0:
        i = int(support.argmax())
        seeds.append(PhotoPlace(complex(a[i]), complex(b[i]), float(support[i]), seen=seen))
        support[np.abs(b - b[i]) < APART * expected.width] = 0
    return seeds


def _distinct(seeds: list[PhotoPlace]) -> list[PhotoPlace]:
    """Return the places with the most support that lie apart from one another."""
    chosen: list[PhotoPlace] = []
    for seed in sorted(seeds, key=lambda seed: -seed.support):
        if len(chosen) < _PLACES and all(seed.is_apart(other) for other in chosen):
            chosen.append(seed)
    return chosen


def _best(places: Sequence[PhotoPlace]) -> PhotoPlace | None:
    return max(places, key=lambda place: place.support, default=None)


def _hypotheses(u: Complex, m: Complex, expected: Expectation, heading: float | None) -> tuple[Complex, Complex]:
    """Return similarities a, b through random pairs of matches, plausible in scale and heading, (K,) each."""
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, len(u), (2, _SAMPLES))
    apart = u[j] - u[i]
    far = np.abs(apart) > 0.08
    i, a = i[far], (m[j] - m[i])[far] / apart[far]
    factor = FREE_FACTOR if expected.tried else _WIDTH_FACTOR
    kept = (np.abs(a) > expected.width / factor) & (np.abs(a) < expected.width * factor)
    if heading is not None:
        off = np.abs(wrap_degrees(-np.degrees(np.angle(a)) - heading))
        kept &= (off < _HEADING_TOLERANCE) | (off > 180 - _HEADING_TOLERANCE)
    i, a = i[kept][:_HYPOTHESES], a[kept][:_HYPOTHESES]
    return a, m[i] - a * u[i]


def _support(a: Complex, b: Complex, u: Complex, m: Complex) -> Float64Array:
    """Return the support of similarities a, b (K,) by matches u, m (M,): (K,)."""
    # Places relative to one of them are exact enough in single precision.
    slope, start, p, q = (values.astype(np.complex64) for values in (a, b - b[0], u, m - b[0]))
    off = slope[:, None] * p + start[:, None] - q
    residuals = (off.real**2 + off.imag**2) / (_RADIUS * np.abs(slope)[:, None]) ** 2
    return cast(Float64Array, np.maximum(1 - residuals, 0).sum(axis=1, dtype=np.float64))


def _guided(seed: PhotoPlace, ground: Ground) -> PhotoPlace:
    """Match features near their predicted places, and fit the similarity to them, three times."""
    seen, a, b = seed.seen, seed.a, seed.b
    near = np.abs(ground.points - (b.real, b.imag)).max(axis=1) < 0.8 * abs(a)
    places = (ground.points[near] @ (1, 1j)).astype(np.complex128)
    if seen is None or len(places) < 4:
        return replace(seed, support=0.0)
    support, matches = 0.0, 0
    for reach in (_REACH, _REACH, _REACH / 2):
        pairs = mutual_within(a * seen.u + b, places, reach * abs(a), seen.descriptors, ground.descriptors[near])
        u, m = seen.u[pairs[:, 0]], places[pairs[:, 1]]
        a, b = _fitted(a, b, u, m)
        if reach == _REACH:
            # A random match lies within the radius with probability (radius / reach)^2, and then adds 1/2 in the mean.
            by_chance = 0.5 * len(u) * (_RADIUS / reach) ** 2
            support, matches = float(_support(np.array([a]), np.array([b]), u, m)[0]) - by_chance, len(u)
    return PhotoPlace(a, b, support, u, m, matches, seen)


def _fitted(a: complex, b: complex, u: Complex, m: Complex) -> tuple[complex, complex]:
    """Fit a similarity to its inliers by least squares, with a shrinking radius."""
    for radius in (1.5, 1.2, 1.0, 1.0):
        inliers = np.abs(a * u + b - m) < radius * _RADIUS * abs(a)
        if inliers.sum() < 4:
            break
        p, q = u[inliers], m[inliers]
        middle, there = p.mean(), q.mean()
        a = complex(((q - there) * np.conj(p - middle)).sum() / (np.abs(p - middle) ** 2).sum())
        b = complex(there - a * middle)
    return a, b


def _concluded(
    matcher: Matcher,
    photo: PhotoView,
    best: PhotoPlace,
    rival: PhotoPlace,
    expected: Expectation,
    bounds: tuple[float, float, float, float] | None,
) -> Registration:
    """Lay the photo by a place's matches, and accept or refuse it."""
    height, width = photo.picture.shape[:2]
    homography, model, inliers = _homography(best, height / width)
    to_unit = np.array([[1 / width, 0, -(width - 1) / 2 / width], [0, -1 / width, (height - 1) / 2 / width], [0, 0, 1]])
    count, cells, needed = int(inliers.sum()), _cells(best.u[inliers]), _FAR_SUPPORT * MIN_SUPPORT
    answer = Registration(_doubt(best, rival), matcher.name, model, count, best.support)
    answer = answer.laid(homography @ to_unit, (width, height), expected.heading)
    centre = answer.centre
    assert centre is not None
    answer = replace(answer, covariance=_covariance(homography, model, best, inliers, complex(*centre)))
    if not answer.accepted:
        return answer
    if abs(answer.turn or 0.0) > _FAR_TURN and best.support < needed:
        numbers = {"degrees": abs(answer.turn or 0.0), "needed": needed, "support": best.support}
        return replace(answer, refusal=Reason("turned far", numbers))
    if cells < MIN_CELLS:
        return replace(answer, refusal=Reason("cells", {"inliers": count, "cells": cells, "all": _GRID**2}))
    margin = _OFF_MAP * (answer.width or 0.0)
    if bounds is None or (
        bounds[0] - margin <= centre[0] <= bounds[2] + margin and bounds[1] - margin <= centre[1] <= bounds[3] + margin
    ):
        return answer
    return replace(answer, refusal=Reason("off the map"))


def _homography(best: PhotoPlace, aspect: float) -> tuple[Float64Array, str, BoolArray]:
    """Return the homography from u to metres, its model, and its inliers; a similarity unless a homography is clearly better."""
    a, b, inliers, radius = best.a, best.b, best.residuals < best.limit, _TIGHT * best.limit
    plain = np.array([[a.real, -a.imag, b.real], [a.imag, a.real, b.imag], [0, 0, 1]]), "similarity", inliers
    source, target = (np.stack([z.real, z.imag], axis=1) for z in (best.u, best.m - b))
    if inliers.sum() < 20:
        return plain
    try:
        magsac, _ = cv2.findHomography(source, target, cv2.USAC_MAGSAC, radius, maxIters=2000, confidence=0.999)
    except cv2.error:
        return plain
    if magsac is None or not _plausible(homography := np.asarray(magsac, np.float64), abs(a), aspect):
        return plain
    residuals = np.linalg.norm(apply_homography(homography, source) - target, axis=1)
    if (residuals < radius).sum() < 1.25 * (best.residuals < radius).sum() + 4:
        return plain
    return translation((b.real, b.imag)) @ homography, "homography", residuals < best.limit


def _plausible(homography: Float64Array, width: float, aspect: float) -> bool:
    """Tell whether a homography preserves the orientation, and the scale to a factor of 2 between corners."""
    corners = np.array([[x, y] for x in (-0.5, 0.5) for y in (-aspect / 2, aspect / 2)])
    depths = np.append(corners @ homography[2, :2], 0.0) + homography[2, 2]
    if depths.min() * depths.max() <= 0:
        return False
    scales = []
    for corner in (*corners, np.zeros(2)):
        around = apply_homography(homography, corner + np.array([[0, 0], [0.01, 0], [0, 0.01]]))
        jacobian = (around[1:] - around[0]).T / 0.01
        values = np.linalg.svd(jacobian, compute_uv=False)
        if np.linalg.det(jacobian) <= 0 or values[0] > 1.6 * values[1]:
            return False
        scales.append(float(np.sqrt(values[0] * values[1])))
    centre = apply_homography(homography, np.zeros((1, 2)))[0]
    return max(scales) < 2 * min(scales) and float(np.linalg.norm(centre)) < 0.15 * width


def _covariance(
    homography: Float64Array, model: str, best: PhotoPlace, inliers: BoolArray, centre: complex
) -> Float64Array:
    """Return the covariance of the centre in square metres, (2, 2), from residuals and geometry of the inliers."""
    u, m = best.u[inliers], best.m[inliers]
    if len(u) < 3:
        return np.full((2, 2), np.nan)
    free = 8 if model == "homography" else 4
    x, y = u.real, u.imag
    places = apply_homography(homography, np.stack([x, y], axis=1))
    residuals = np.stack([m.real, m.imag], axis=1) - places
    variance = residuals.T @ residuals / max(len(u) - free / 2, 1)
    # Both models are linearised as polynomials of u about the centre; a homography adds two terms of second order.
    columns = [np.ones_like(x), x, y] + ([x * x, x * y] if model == "homography" else [])
    design = np.stack(columns, axis=1)
    # Relief and tilt make residuals of neighbours alike, so each cell of the grid counts as one observation.
    gram = design.T @ design * (min(_cells(u), len(u)) / len(u)) + 1e-9 * np.eye(len(columns))
    spread = float(np.linalg.inv(gram)[0, 0])
    moved = centre - best.b
    between = np.array([moved.real, moved.imag]) / 2
    return variance * spread + np.outer(between, between)


def _doubt(best: PhotoPlace, rival: PhotoPlace) -> Reason | None:
    """Return the reason if the support is too low for a place, else None."""
    if best.support < MIN_SUPPORT:
        support = max(best.support, 0.0)
        return Reason("support", {"support": support, "matches": best.matches, "needed": MIN_SUPPORT})
    return _rivalled(best, rival)


def _rivalled(place: PhotoPlace, rival: PhotoPlace) -> Reason | None:
    """Return the reason if another place has nearly the support of a place, else None."""
    if place.support >= MIN_RATIO * rival.support:
        return None
    return Reason("rival", {"support": place.support, "other": rival.support, "metres": abs(rival.b - place.b)})


def _cells(u: Complex) -> int:
    """Count the cells of a grid over the photo that hold at least one of the points."""
    cells: Int64Array = np.floor((np.stack([u.real, u.imag]) + 0.5) * _GRID).astype(np.int64)
    return len(np.unique(cells[0] * 1000 + cells[1]))
