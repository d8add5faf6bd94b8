"""Registration of a photo to the map: local features, a similarity by RANSAC, a homography if better, or a refusal.

A photo point is a complex number u: x to the right and y up from the picture's centre, in units of the picture's width. A map
point is m = east + i north in metres. A similarity is m = a u + b: |a| is the width of the ground that the picture shows,
-arg a the heading of its top (clockwise from north), and b the place of its centre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, cast

import cv2
import numpy as np
import numpy.typing as npt

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array, UInt8Array
from lpn.core.homography import apply_homography, middle_pixel, translation
from lpn.core.numbers import wrap_degrees
from lpn.flight.locate.matchers import Complex, Features, Matcher, mutual_within
from lpn.flight.locate.words import Reason

# Inliers of a similarity have residuals up to this share of the ground width, which tilt and relief at 50 m height cause.
_RADIUS = 0.015
# Guided matching looks for partners within this share of the ground width about their predicted place.
_REACH = 0.1
# A homography is judged at this share of the similarity's radius.
_TIGHT = 0.5
# A width is plausible within this factor of the expected width, or within FREE_FACTOR of the tried width if none is expected.
_WIDTH_FACTOR = 1.35
FREE_FACTOR = 2.0
# Degrees by which the heading may differ from the known heading, or from its opposite.
_HEADING_TOLERANCE = 40.0
# Least support: the sum of 1 - (residual / radius)^2 over the inliers, less the expectation by chance.
MIN_SUPPORT = 15.0
# The support must be this multiple of the best other place's.
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
# Most places that are matched again, and their least distance in ground widths.
_PLACES = 4
APART = 0.25
# Most features of a photo; more cost time, and raise the support of wrong places.
_FEATURES = 2048


def is_turned_over(turn: float | None) -> bool:
    """Tell whether a turn in degrees against the heading is about 180, such as that of a file turned after the flight."""
    return turn is not None and abs(turn) > 135


@dataclass(frozen=True, eq=False)
class Ground:
    """Local features of a piece of the map.

    Attributes:
        points: metres east and north in the map's frame, (N, 2) float64.
        descriptors: of norm 1, (N, D) float32.
        resolution: metres per pixel of the picture that was described.
    """

    points: Float64Array
    descriptors: Float32Array
    resolution: float

    def near(self, centre: Float64Array, reach: float) -> Ground:
        """Return the features in the square of side 2 `reach` about a point, (2,)."""
        kept = (np.abs(self.points - centre) <= reach).all(axis=1)
        return Ground(self.points[kept], self.descriptors[kept], self.resolution)


@dataclass(frozen=True)
class Expectation:
    """Prior knowledge of a photo, for its registration; None where it is unknown.

    Attributes:
        width: metres of ground across the picture.
        heading: of the picture's top, degrees clockwise from north.
        certain: whether the heading is the picture's, not a course's or an aircraft's. Unless an uncertain heading or its
            opposite has twice the needed support and ratio, all headings are tried, and the best supported one is taken.
        guess: heading to try first if none is known, such as an earlier stage's. Unless it has twice the needed support and
            ratio, all headings are tried.
    """

    width: float | None = None
    heading: float | None = None
    certain: bool = True
    guess: float | None = None


class Similarity(NamedTuple):
    """A place of a photo: m = a u + b, see the module."""

    a: complex
    b: complex


@dataclass(frozen=True, eq=False)
class Matched:
    """Matches of a photo with the map.

    Attributes:
        u: of the photo, (M,) complex, see the module.
        m: of the map, (M,) complex.
        ground: the matched features of the map.
        limit: metres within which a match agrees with the registration.
    """

    u: Complex
    m: Complex
    ground: Ground
    limit: float
    _seen: _Described

    def again(self, predicted: Complex, reach: float) -> tuple[Complex, Int64Array]:
        """Match again near predicted places.

        Args:
            predicted: photo points u of the map's features, (N,) complex; not finite for features outside of the photo.
            reach: in units of the picture's width.

        Returns:
            Photo points u, (K,), and the indices of their features of the map, (K,).
        """
        near = np.flatnonzero(np.isfinite(predicted) & (np.abs(predicted) < 1))
        if not len(near) or not len(self._seen.u):
            return np.zeros(0, np.complex128), np.zeros(0, np.int64)
        features = self.ground.descriptors[near]
        pairs = mutual_within(self._seen.u, predicted[near], reach, self._seen.features.descriptors, features)
        return self._seen.u[pairs[:, 0]], near[pairs[:, 1]]


@dataclass(frozen=True, eq=False)
class Registration:
    """A photo laid over the map, or the reason of the refusal.

    Attributes:
        refusal: the reason of the refusal; None if accepted.
        matcher: the name of the matcher.
        model: "similarity" or "homography".
        matches, inliers: numbers of guided matches, and of matches that agree with the model.
        support: of this place, see `MIN_SUPPORT`.
        homography: from pixels of the photo (x, y, 1) to metres east and north, (3, 3) float64.
        centre: of the picture on the ground, metres east and north, (2,) float64.
        heading: of the picture's top, degrees clockwise from north, 0 .. 360.
        width: metres of ground across the picture's middle.
        turn: degrees clockwise, -180 .. 180, from the expected heading to `heading`; None if none was expected.
        covariance: of the centre in square metres, (2, 2) float64.
        places: all compared places, this one first.
        matched: the matches; `inliers` of them agree. None without a match.
    """

    refusal: Reason | None
    matcher: str
    model: str = "similarity"
    matches: int = 0
    inliers: int = 0
    support: float = 0.0
    homography: Float64Array | None = None
    centre: Float64Array | None = None
    heading: float | None = None
    width: float | None = None
    turn: float | None = None
    covariance: Float64Array | None = None
    places: tuple[Similarity, ...] = ()
    matched: Matched | None = None

    @property
    def accepted(self) -> bool:
        """True if the position may be used."""
        return self.refusal is None

    @property
    def reason(self) -> str:
        """The reason of the refusal as a sentence; "" if accepted."""
        return "" if self.refusal is None else self.refusal.sentence

    @property
    def radius(self) -> float | None:
        """The 1-sigma radius in metres: the root mean square of the two axes of the covariance."""
        return None if self.covariance is None else float(np.sqrt(np.trace(self.covariance) / 2))

    @property
    def turned(self) -> bool:
        """True if the picture is turned by about 180 degrees against its heading, see `is_turned_over`."""
        return is_turned_over(self.turn)

    @property
    def turn_sentence(self) -> str:
        """A sentence about the turn against the heading; "" if they agree."""
        if self.turn is None or abs(self.turn) <= _HEADING_TOLERANCE:
            return ""
        return f"The picture is turned by {abs(self.turn):.0f} degrees against its heading."

    def to_metres(self, pixels: npt.ArrayLike) -> Float64Array:
        """Convert pixels of the photo, (N, 2), to metres east and north, (N, 2)."""
        assert self.homography is not None
        return apply_homography(self.homography, pixels)


def pose(homography: Float64Array, width: int, height: int) -> tuple[Float64Array, float, float]:
    """Return the pose in the plane of a picture of this size by its homography from pixels to metres, (3, 3).

    Returns:
        The ground of its middle, (2,), the heading of its top in degrees, 0 .. 360, and the metres of ground across its middle.
    """
    middle = middle_pixel(width, height)
    right, up = np.array([width / 2, 0]), np.array([0, -0.01 * width])
    centre, above, *ends = apply_homography(homography, [middle, middle + up, middle - right, middle + right])
    heading = float(np.degrees(np.arctan2(*(above - centre))) % 360)
    return centre, heading, float(np.linalg.norm(ends[1] - ends[0]))


def turn_between(expected: float | None, heading: float) -> float | None:
    """Return the degrees clockwise, -180 .. 180, from an expected heading to another; None if none was expected."""
    return None if expected is None else wrap_degrees(heading - expected)


def describe_ground(
    matcher: Matcher,
    picture: UInt8Array,
    valid: BoolArray | None,
    corner: tuple[float, float],
    resolution: float,
    limit: int = 8192,
) -> Ground:
    """Describe a north-up piece of the map.

    Args:
        picture: (H, W, 3) uint8.
        valid: pixels with data, (H, W); None for all.
        corner: metres east and north of the picture's north-west corner.
        resolution: metres per pixel.
        limit: greatest number of features.
    """
    features = matcher.features(picture, valid, limit)
    east = corner[0] + (features.points[:, 0] + 0.5) * resolution
    north = corner[1] - (features.points[:, 1] + 0.5) * resolution
    return Ground(np.stack([east, north], axis=1).astype(np.float64), features.descriptors, resolution)


def register(
    matcher: Matcher,
    photo: UInt8Array,
    ground: Ground,
    expected: Expectation,
    widths: Sequence[float] = (),
    bounds: tuple[float, float, float, float] | None = None,
    valid: BoolArray | None = None,
) -> Registration:
    """Register a photo to described ground.

    Args:
        photo: (H, W, 3) uint8.
        ground: features of the searched part of the map.
        expected: known width and heading.
        widths: ground widths in metres to try if none is expected.
        bounds: x0, y0, x1, y1 of the map in metres; a centre outside is refused.
        valid: pixels of the photo that show ground, (H, W); None for all.
    """
    tried = [expected.width] if expected.width else list(widths)
    factor = _WIDTH_FACTOR if expected.width else FREE_FACTOR
    if not tried:
        raise ValueError("a width is needed, expected or to be tried")
    if len(ground.points) < 8:
        return Registration(Reason("no detail"), matcher.name)
    seeds: list[_Seed] = []
    known: dict[_Seed, _Candidate] = {}
    chosen: list[_Seed] = []
    best, runner_up = None, _Rival()
    at_given: _Candidate | None = None
    rival = _Rival()
    for turns, heading in _turns(matcher, expected):
        if heading is None and expected.heading is not None and best is not None and _doubt(best, runner_up) is None:
            at_given, rival = best, runner_up
        for width in tried:
            for turn in turns:
                seen = _described(matcher, photo, valid, width / ground.resolution, turn)
                seeds += _seeds(matcher, seen, ground, width, factor, heading)
        chosen = _apart(seeds)
        known |= {seed: _guided(seed, ground) for seed in chosen if seed not in known}
        best, runner_up = _ranked([known[seed] for seed in chosen])
        if best is not None and best.support >= 2 * MIN_SUPPORT and best.support >= 2 * MIN_RATIO * runner_up.support:
            break
    # A place at the given heading is more probable. One at another heading must have more support, and otherwise is no rival.
    if at_given is not None and best is not None:
        if at_given.support >= best.support:
            best = at_given
        if abs(best.b - at_given.b) <= APART * abs(at_given.a):
            runner_up = rival
        elif at_given.support > runner_up.support:
            runner_up = _Rival(at_given.support, at_given.b)
    if best is None:
        return Registration(Reason("no match"), matcher.name)
    others = (known[seed] for seed in chosen if known[seed] is not best)
    places = tuple(Similarity(candidate.a, candidate.b) for candidate in (best, *others))
    matched = Matched(best.u, best.m, ground, best.radius, best.seen)
    answer = _concluded(matcher, photo, best, runner_up, expected, bounds)
    return replace(answer, places=places, matched=matched)


def contested(
    answer: Registration,
    photo: UInt8Array,
    searches: Sequence[tuple[Matcher, Ground]],
    rivals: Sequence[Similarity],
    valid: BoolArray | None = None,
) -> Registration:
    """Compare an accepted answer with places of other searches, by the features of all matchers together.

    A matcher may find only one of several equal buildings. So the support of a place is the sum of its supports by all matchers,
    at least 0 each.

    Args:
        photo: (H, W, 3) uint8.
        searches: each matcher with its features of the searched part of the map.
        rivals: places of the other searches; places within a quarter of the ground width of the answer do not count.
        valid: see `register`.

    Returns:
        The answer, refused if its support is less than 1.7 times a rival's.
    """
    own, *_ = answer.places
    others: list[Similarity] = []
    for rival in rivals:
        if all(abs(rival.b - place.b) > APART * abs(place.a) for place in (own, *others)):
            others.append(rival)
    if not others:
        return answer
    support, *others_support = (
        sum(_support_at(place, matcher, photo, valid, ground) for matcher, ground in searches)
        for place in (own, *others)
    )
    at = int(np.argmax(others_support))
    refusal = _rivalled(support, own.b, _Rival(others_support[at], others[at].b))
    return answer if refusal is None else replace(answer, refusal=refusal, support=support)


def proven(
    answer: Registration,
    photo: UInt8Array,
    others: Sequence[tuple[Matcher, Ground]],
    valid: BoolArray | None = None,
) -> Registration:
    """Refuse an accepted answer for a photo that may be of another place, unless its support by all matchers is high.

    By one matcher, two pictures of meadows can agree by chance as well as two of one place; another matcher then finds no
    agreement. So the supports of a place are summed, at least 0 each, and must reach 15 for each matcher and another 15.

    Args:
        photo: (H, W, 3) uint8.
        others: the other matchers, with their features of the searched part of the map.
        valid: see `register`.
    """
    place, *_ = answer.places
    support = answer.support + sum(_support_at(place, matcher, photo, valid, ground) for matcher, ground in others)
    least = MIN_SUPPORT * (2 + len(others))
    if support >= least:
        return answer
    return replace(answer, refusal=Reason("anywhere", {"support": support, "needed": least}))


def _support_at(
    place: Similarity, matcher: Matcher, photo: UInt8Array, valid: BoolArray | None, ground: Ground
) -> float:
    """Return the support of a place by guided matching, at least 0; 0 if the matches lead to another place."""
    heading = float(-np.degrees(np.angle(place.a)))
    turn = heading if matcher.tolerance < 90 else 0.0
    seen = _described(matcher, photo, valid, abs(place.a) / ground.resolution, turn)
    refined = _guided(_Seed(seen, place.a, place.b, 0.0), ground)
    return max(refined.support, 0.0) if abs(refined.b - place.b) <= APART * abs(place.a) else 0.0


@dataclass(frozen=True, eq=False)
class _Candidate:
    """A similarity with its guided matches: photo points u, map points m, both (M,) complex.

    Attributes:
        support: by the last round's matches within the whole reach; `matches` is their number.
    """

    seen: _Described
    a: complex
    b: complex
    u: Complex
    m: Complex
    support: float
    matches: int

    @property
    def radius(self) -> float:
        return _RADIUS * abs(self.a)

    @property
    def residuals(self) -> Float64Array:
        return cast(Float64Array, np.abs(self.a * self.u + self.b - self.m))


class _Rival(NamedTuple):
    """Another place where a photo may lie: its support, and its middle in metres, east + i north."""

    support: float = 0.0
    b: complex = 0j


@dataclass(frozen=True, eq=False)
class _Seed:
    """A similarity through two matches, before guided matching, with its support by all matches."""

    seen: _Described
    a: complex
    b: complex
    support: float


@dataclass(frozen=True, eq=False)
class _Described:
    """Features of a turned and resized photo: their places u (N,) complex."""

    u: Complex
    features: Features


def _turns(matcher: Matcher, expected: Expectation) -> Iterator[tuple[list[float], float | None]]:
    """Yield groups of headings to turn the photo by, each with the heading that limits the answer, in the order of tries."""
    count = max(round(180 / matcher.tolerance), 1)
    circle = [i * 360 / count for i in range(count)] if matcher.tolerance < 90 else [0.0]
    if expected.heading is not None:
        known = [expected.heading, expected.heading + 180] if matcher.tolerance < 90 else [0.0]
        for turn in known:
            yield [turn], expected.heading
    elif expected.guess is not None and matcher.tolerance < 90:
        yield [expected.guess], None
    if expected.heading is None or not expected.certain:
        yield circle, None


def _described(
    matcher: Matcher, photo: UInt8Array, shown: BoolArray | None, pixels: float, heading: float
) -> _Described:
    """Resize a photo to a width in pixels, turn it north-up, and describe its `shown` pixels, (H, W)."""
    height, width = photo.shape[:2]
    pixels = int(np.clip(round(pixels), 64, width))
    small = cv2.resize(photo, (pixels, max(round(height * pixels / width), 32)), interpolation=cv2.INTER_AREA)
    rows, columns = small.shape[:2]
    matrix = cv2.getRotationMatrix2D(((columns - 1) / 2, (rows - 1) / 2), -heading, 1.0)
    valid = None
    if shown is not None:
        valid = cv2.resize(shown.astype(np.uint8), (columns, rows), interpolation=cv2.INTER_NEAREST) > 0
    if heading % 360:
        cos, sin = abs(matrix[0, 0]), abs(matrix[0, 1])
        canvas = (round(rows * sin + columns * cos), round(rows * cos + columns * sin))
        matrix[:, 2] += (np.array(canvas) - (columns, rows)) / 2
        turned = cv2.warpAffine(small, matrix, canvas, flags=cv2.INTER_LINEAR)
        whole = np.ones((rows, columns), np.uint8) if valid is None else valid.astype(np.uint8)
        valid = cv2.warpAffine(whole, matrix, canvas, flags=cv2.INTER_NEAREST) > 0
        features = matcher.features(cast(UInt8Array, turned), valid, _FEATURES)
    else:
        features = matcher.features(cast(UInt8Array, small), valid, _FEATURES)
    points = (features.points - matrix[:, 2]) @ np.linalg.inv(matrix[:, :2]).T
    x, y = points[:, 0] - (columns - 1) / 2, (rows - 1) / 2 - points[:, 1]
    return _Described(((x + 1j * y) / columns).astype(np.complex128), features)


def _seeds(
    matcher: Matcher, seen: _Described, ground: Ground, width: float, factor: float, heading: float | None
) -> list[_Seed]:
    """Return the similarities at distinct places with the most support among the matches."""
    pairs = matcher.match(seen.features, Features(cast(Float32Array, ground.points), ground.descriptors))
    if len(pairs) < 4:
        return []
    u, m = seen.u[pairs[:, 0]], (ground.points[pairs[:, 1]] @ (1, 1j)).astype(np.complex128)
    a, b = _hypotheses(u, m, width, factor, heading)
    if not len(a):
        return []
    support = np.concatenate([_support(a[i : i + 500], b[i : i + 500], u, m) for i in range(0, len(a), 500)])
    seeds: list[_Seed] = []
    while len(seeds) < _PLACES and support.max() > 0:
        i = int(support.argmax())
        seeds.append(_Seed(seen, complex(a[i]), complex(b[i]), float(support[i])))
        support[np.abs(b - b[i]) < APART * width] = 0
    return seeds


def _apart(seeds: list[_Seed]) -> list[_Seed]:
    chosen: list[_Seed] = []
    for seed in sorted(seeds, key=lambda seed: -seed.support):
        if len(chosen) < _PLACES and all(abs(seed.b - other.b) > APART * abs(seed.a) for other in chosen):
            chosen.append(seed)
    return chosen


def _ranked(candidates: list[_Candidate]) -> tuple[_Candidate | None, _Rival]:
    best = max(candidates, key=lambda candidate: candidate.support, default=None)
    if best is None:
        return None, _Rival()
    apart = (other for other in candidates if abs(other.b - best.b) > APART * abs(best.a))
    other = max(apart, key=lambda candidate: candidate.support, default=None)
    return best, _Rival() if other is None else _Rival(other.support, other.b)


def _hypotheses(u: Complex, m: Complex, width: float, factor: float, heading: float | None) -> tuple[Complex, Complex]:
    """Return similarities a, b through random pairs of matches, plausible in scale and heading, (K,) each."""
    rng = np.random.default_rng(0)
    i, j = rng.integers(0, len(u), (2, _SAMPLES))
    apart = u[j] - u[i]
    far = np.abs(apart) > 0.08
    i, a = i[far], (m[j] - m[i])[far] / apart[far]
    kept = (np.abs(a) > width / factor) & (np.abs(a) < width * factor)
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


def _guided(seed: _Seed, ground: Ground) -> _Candidate:
    seen, a, b = seed.seen, seed.a, seed.b
    near = np.abs(ground.points - (b.real, b.imag)).max(axis=1) < 0.8 * abs(a)
    places = (ground.points[near] @ (1, 1j)).astype(np.complex128)
    u = m = np.zeros(0, np.complex128)
    support, matches = 0.0, 0
    if len(places) < 4:
        return _Candidate(seen, a, b, u, m, support, matches)
    features = ground.descriptors[near]
    for reach in (_REACH, _REACH, _REACH / 2):
        pairs = mutual_within(a * seen.u + b, places, reach * abs(a), seen.features.descriptors, features)
        u, m = seen.u[pairs[:, 0]], places[pairs[:, 1]]
        a, b = _fitted(a, b, u, m)
        if reach == _REACH:
            support, matches = _counted(a, b, u, m, reach), len(u)
    return _Candidate(seen, a, b, u, m, support, matches)


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


def _counted(a: complex, b: complex, u: Complex, m: Complex, reach: float) -> float:
    """Return the support less the expectation of random matches within `reach`."""
    raw = float(_support(np.array([a]), np.array([b]), u, m)[0])
    # A random match lies within the radius with probability (radius / reach)^2, and then adds 1/2 in the mean.
    return raw - 0.5 * len(u) * (_RADIUS / reach) ** 2


def _concluded(
    matcher: Matcher,
    photo: UInt8Array,
    best: _Candidate,
    runner_up: _Rival,
    expected: Expectation,
    bounds: tuple[float, float, float, float] | None,
) -> Registration:
    height, width = photo.shape[:2]
    inliers = best.residuals < best.radius
    homography, model, inliers = _homography(best, inliers, height / width)
    to_unit = np.array([[1 / width, 0, -(width - 1) / 2 / width], [0, -1 / width, (height - 1) / 2 / width], [0, 0, 1]])
    full = homography @ to_unit
    full /= full[2, 2]
    centre, heading, ground_width = pose(full, width, height)
    turn = turn_between(expected.heading, heading)
    covariance = _covariance(homography, model, best, inliers, complex(*centre))
    refusal, needed, margin = _doubt(best, runner_up), _FAR_SUPPORT * MIN_SUPPORT, _OFF_MAP * ground_width
    if refusal is None and turn is not None and abs(turn) > _FAR_TURN and best.support < needed:
        refusal = Reason("turned far", {"degrees": abs(turn), "needed": needed, "support": best.support})
    elif refusal is None and (cells := _cells(best.u[inliers])) < MIN_CELLS:
        refusal = Reason("cells", {"inliers": int(inliers.sum()), "cells": cells, "all": _GRID**2})
    elif refusal is None and bounds is not None:
        is_inside = (
            bounds[0] - margin <= centre[0] <= bounds[2] + margin
            and bounds[1] - margin <= centre[1] <= bounds[3] + margin
        )
        refusal = None if is_inside else Reason("off the map")
    return Registration(
        refusal,
        matcher.name,
        model,
        len(best.u),
        int(inliers.sum()),
        best.support,
        full,
        centre,
        heading,
        ground_width,
        turn,
        covariance,
    )


def _homography(best: _Candidate, inliers: BoolArray, aspect: float) -> tuple[Float64Array, str, BoolArray]:
    """Return the homography from u to metres, its model, and its inliers; a similarity unless a homography is clearly better."""
    a, b = best.a, best.b
    similarity = np.array([[a.real, -a.imag, b.real], [a.imag, a.real, b.imag], [0, 0, 1]])
    radius = _TIGHT * best.radius
    source, target = (np.stack([z.real, z.imag], axis=1) for z in (best.u, best.m - b))
    if inliers.sum() < 20:
        return similarity, "similarity", inliers
    try:
        magsac, _ = cv2.findHomography(source, target, cv2.USAC_MAGSAC, radius, maxIters=2000, confidence=0.999)
    except cv2.error:
        return similarity, "similarity", inliers
    if magsac is None or not _plausible(homography := np.asarray(magsac, np.float64), abs(a), aspect):
        return similarity, "similarity", inliers
    residuals = np.linalg.norm(apply_homography(homography, source) - target, axis=1)
    if (residuals < radius).sum() < 1.25 * (best.residuals < radius).sum() + 4:
        return similarity, "similarity", inliers
    return translation((b.real, b.imag)) @ homography, "homography", residuals < best.radius


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
    homography: Float64Array, model: str, best: _Candidate, inliers: BoolArray, centre: complex
) -> Float64Array:
    """Return the covariance of the centre in square metres, (2, 2), from residuals and geometry of the inliers.

    Relief and tilt make residuals of neighbours alike, so each cell of the grid counts as one observation.
    """
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
    gram = design.T @ design * (min(_cells(u), len(u)) / len(u)) + 1e-9 * np.eye(len(columns))
    spread = float(np.linalg.inv(gram)[0, 0])
    moved = centre - best.b
    between = np.array([moved.real, moved.imag]) / 2
    return variance * spread + np.outer(between, between)


def _doubt(best: _Candidate, runner_up: _Rival) -> Reason | None:
    """Return the reason if the support is too low for a place, else None."""
    if best.support < MIN_SUPPORT:
        support = max(best.support, 0.0)
        return Reason("support", {"support": support, "matches": best.matches, "needed": MIN_SUPPORT})
    return _rivalled(best.support, best.b, runner_up)


def _rivalled(support: float, b: complex, rival: _Rival) -> Reason | None:
    """Return the reason if another place has nearly the support of place `b`, else None."""
    if support >= MIN_RATIO * rival.support:
        return None
    return Reason("rival", {"support": support, "other": rival.support, "metres": abs(rival.b - b)})


def _cells(u: Complex) -> int:
    """Count the cells of a grid over the photo that hold at least one of the points."""
    cells: Int64Array = np.floor((np.stack([u.real, u.imag]) + 0.5) * _GRID).astype(np.int64)
    return len(np.unique(cells[0] * 1000 + cells[1]))
