"""Retrieval over a map: windows and frames described by an LPN, and windows ranked for each frame.

A frame is turned north-up, cut to a square with the ground of a window of the pyramid, and described as a drone picture; windows
are described as satellite tiles. A frame of unknown width on the ground is compared with windows of all sizes. A frame of unknown
or uncertain heading is described at several turns.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError, PictureError
from lpn.core.files import cache_folder
from lpn.core.filled_cache import FilledCache
from lpn.core.views import View
from lpn.descriptors.cache import in_cache
from lpn.descriptors.store import DescriptorKind, Row
from lpn.descriptors.writer import PartialStore, fill_store, write_store
from lpn.flight.files import Flight, Frame
from lpn.flight.files.cut import CUT, FrameReader, cut_size
from lpn.flight.locate.index_windows import WindowIndex
from lpn.flight.locate.map_windows import describe_windows
from lpn.flight.maps import Map, Window
from lpn.models.base import Model, normalise, whitened
from lpn.retrieval import scoring

if TYPE_CHECKING:
    from lpn.flight.locate.shipped import ShippedAnswers

# Ratio of one size of the pyramid to the next, and the most sizes without a known width.
_PYRAMID = 1.4
_SIZES = 5
# Number of tried headings if none is certain.
_TURNS = 8
# Fewest distinct frames for centring: the mean of fewer holds their own differences. Frames of a greater cosine are alike.
MIN_DISTINCT = 20
ALIKE = 0.99
# Turns in degrees from an aircraft's heading that its pictures mostly have, as it drifts and banks.
_AIRCRAFT_TURNS = (0.0, -10.0, 10.0, -20.0, 20.0)
# Any other heading must be better by this many standard deviations of the frame's scores.
_OTHER_TURN = 1.5
# Added to the variances of whitening, as a share of their mean: few samples estimate small variances badly.
_SHRINKAGE = 1.0
# Most bytes of frames' scores in memory: a sequence uses each frame's a dozen times.
_HELD_SCORES = 1 << 26


@dataclass(frozen=True, eq=False)
class RankedWindows:
    """The best windows of a map for one frame.

    Attributes:
        indices: windows, best first, (K,) int64.
        scores: weighted mean cosines, (K,) float64.
        headings: heading in degrees of each best score, (K,) float64.
        cosines: of each part, (K, n) float32.
        contributions: of each part to the squared distance 2 - 2 score, (K, n) float32.
    """

    indices: Int64Array
    scores: Float64Array
    headings: Float64Array
    cosines: Float32Array
    contributions: Float32Array


@dataclass(frozen=True, eq=False)
class MapRetrieval:
    """Scores of all windows for all frames.

    Attributes:
        windows: of the map.
        places: their centres in metres, (W, 2) float64.
        sizes: their sides in metres, (W,) float64.
        windows_described: (W, n, D) float32.
        frames_described: descriptors of each frame at its headings, (headings, n, D) float32, without the last T - 1 if turned
            windows replace these; None for an unreadable frame.
        headings: of each frame in degrees.
        levels: the size of window that each frame was cut for; NaN if all sizes are compared.
        cut_shares: share of each frame's width that its square shows, see `lpn.flight.files.cut.cut_square`, (N,).
        pixels: side of the described pictures.
        means: the mean descriptor that was subtracted, by view, (n, D); empty without centring.
        broken: the error of each unreadable frame.
        notes: sentences about the description.
        whitening: the matrix that multiplied each centred part, (n, D, D); None without whitening.
        by_aircraft: frames whose first five headings are within 20 degrees of an aircraft's.
        overlap: share of a window's side that its neighbour also covers.
        turned_windows: descriptors of windows at further headings, evenly turned, (T - 1, W, n, D); None unless an index has
            them. They are compared with a frame's first description, and stand for the last T - 1 of its headings.
    """

    windows: list[Window]
    places: Float64Array
    sizes: Float64Array
    windows_described: Float32Array
    frames_described: list[Float32Array | None]
    headings: list[list[float]]
    levels: Float64Array
    cut_shares: Float64Array
    pixels: int
    means: dict[View, Float32Array]
    broken: dict[int, str]
    notes: list[str] = field(default_factory=list)
    whitening: Float32Array | None = None
    by_aircraft: frozenset[int] = frozenset()
    overlap: float = 0.75
    turned_windows: Float32Array | None = None
    _scores: FilledCache[Float64Array] = field(
        default_factory=lambda: FilledCache(_HELD_SCORES, lambda scores: scores.nbytes), init=False, repr=False
    )

    def scores(self, frame: int) -> Float64Array:
        """Return the score of each window at its best heading, (W,)."""
        best: Float64Array = self.scores_by_heading(frame).max(axis=1)
        return best

    def scores_by_heading(self, frame: int) -> Float64Array:
        """Return the score of each window at each of the frame's headings, (W, H); (W, 1) zeros for an unreadable frame.

        Headings more than 20 degrees from an aircraft's lose 1.5 standard deviations of the frame's scores. Windows of other
        sizes get the lowest best score of a window.
        """
        return self._scores.get(frame, lambda: self._scored(frame))

    def _scored(self, frame: int) -> Float64Array:
        described = self.frames_described[frame]
        if described is None:
            return np.zeros((len(self.windows), 1))
        flat = self.windows_described.reshape(len(self.windows), -1)
        scores = (flat @ described.reshape(len(described), -1).T).astype(np.float64)
        if self.turned_windows is not None and len(self.headings[frame]) > len(described):
            turned = self.turned_windows.reshape(-1, flat.shape[1]) @ described[0].reshape(-1)
            scores = np.concatenate([scores, turned.reshape(-1, len(flat)).T], axis=1)
        if frame in self.by_aircraft:
            scores[:, len(_AIRCRAFT_TURNS) :] -= _OTHER_TURN * scores.std()
        if not np.isnan(self.levels[frame]):
            scores[self.sizes != self.levels[frame]] = scores.max(axis=1).min()
        scores.flags.writeable = False  # it is cached
        return scores

    def best_turn(self, frame: int) -> int:
        """Return the index of the heading at which a frame's best window has its score."""
        scores = self.scores_by_heading(frame)
        return int(scores[scores.max(axis=1).argmax()].argmax())

    def first(self, frame: int, k: int, apart: float = 0.0) -> Int64Array:
        """Return the k best windows of a frame, best first; overlaps with better ones are at most 1 - `apart` of a side."""
        return self.best_apart(self.scores(frame), k, apart)

    def best_apart(self, values: Float64Array, k: int, apart: float = 0.0) -> Int64Array:
        """Return the k windows of the greatest values (W,), with the overlaps of `first`."""
        order = np.argsort(-values, kind="stable")
        kept: list[int] = []
        for i in order.tolist():
            near = np.abs(self.places[kept] - self.places[i]).max(axis=1, initial=0)
            if (near >= apart * np.maximum(self.sizes[kept], self.sizes[i])).all():
                kept.append(i)
            if len(kept) == k:
                break
        return np.array(kept, np.int64)

    def top(self, frame: int, k: int, apart: float = 0.0) -> RankedWindows:
        """Return the windows of `first` with the contributions of their parts."""
        scores = self.scores_by_heading(frame)
        values, best = scores.max(axis=1), scores.argmax(axis=1)
        order = self.first(frame, k, apart)
        described = self.frames_described[frame]
        n = self.windows_described.shape[1]
        if described is None:
            none = np.zeros((0, n), np.float32)
            return RankedWindows(order[:0], values[:0], values[:0], none, none)
        cosines = np.stack([scoring.part_cosines(*self._compared(frame, best[i], i))[0] for i in order])
        headings = np.array([self.headings[frame][best[i]] for i in order])
        return RankedWindows(
            order, values[order], headings, cosines, scoring.contributions(cosines, scoring.part_weights(n))
        )

    def _compared(self, frame: int, heading: int, window: int) -> tuple[Float32Array, Float32Array]:
        """Return the descriptors to compare at a frame's heading: the frame's (n, D), and the window's (1, n, D)."""
        described = self.frames_described[frame]
        assert described is not None
        if heading < len(described):
            return described[heading], self.windows_described[window : window + 1]
        assert self.turned_windows is not None
        return described[0], self.turned_windows[heading - len(described), window : window + 1]


def heading_is_certain(frame: Frame) -> bool:
    """Tell whether a frame's heading is its picture's, not a course or an aircraft's."""
    return frame.heading is not None and frame.heading_source not in ("course", "aircraft")


def tried_headings(frame: Frame, turns: Sequence[float] | None = None) -> list[float]:
    """Return the headings of a frame in degrees: its own if certain, else 8, or 12 for an aircraft's.

    Args:
        turns: headings of turned windows, from 0 on; None if windows are north up and the frame is turned.
    """
    about = _AIRCRAFT_TURNS if frame.heading_source == "aircraft" else (0.0,)
    others = tuple(360 / _TURNS * k for k in range(1, _TURNS)) if turns is None else tuple(turns[1:])
    return [((frame.heading or 0.0) + turn) % 360 for turn in (*about, *(() if heading_is_certain(frame) else others))]


def pyramid_sizes(basemap: Map, frames: Sequence[Frame]) -> list[float]:
    """Return sides of windows in metres: of frames of known width, else from small to most of the map."""
    cuts = [cut for frame in frames if (cut := cut_size(frame)) is not None]
    if cuts:
        low, high = np.log(np.quantile(cuts, (0.02, 0.98)))
        count = int(np.ceil((high - low) / np.log(_PYRAMID))) or 1
        return [float(size) for size in np.exp(low + (np.arange(count) + 0.5) * (high - low) / count)]
    side = 0.6 * min(basemap.bounds[2] - basemap.bounds[0], basemap.bounds[3] - basemap.bounds[1])
    largest = min(side, 300.0)
    return [largest / _PYRAMID**i for i in reversed(range(_SIZES))]


def retrieve(
    model: Model,
    basemap: Map,
    flight: Flight,
    sizes: Sequence[float] | None = None,
    overlap: float = 0.75,
    centre: bool = True,
    indexed: WindowIndex | None = None,
    shipped: ShippedAnswers | None = None,
) -> MapRetrieval:
    """Describe windows and frames, or read earlier descriptions from the user's cache.

    Args:
        sizes: sides of windows in metres; by default those of `pyramid_sizes`.
        overlap: share of a window's side that its neighbour also covers.
        centre: whether to subtract the mean descriptors of windows and of frames, part by part, against differences of the views
            that are new to the model, and to whiten the parts, see `whitening_of`. With fewer than 20 distinct frames neither is
            done, with a note.
        indexed: an index of described windows, which replaces `sizes` and `overlap`.
        shipped: descriptors that ship with the flight, used if they fit the windows and frames.

    Raises:
        InputError: if the model lacks a view, or no window of the map has data.
    """
    query: View = "drone" if "drone" in model.views else "satellite"
    model.check_view("satellite")
    chosen = sorted((indexed and indexed.sizes) or sizes or pyramid_sizes(basemap, flight.frames))
    windows = [] if indexed is not None else basemap.pyramid(chosen, overlap)
    if indexed is None and not windows:
        raise InputError(
            f"No window of {chosen[0]:.0f} m or more fits on the map {basemap.name}; give a smaller size of windows with --size."
        )
    turns = [0.0] if indexed is None else indexed.turns
    side = max(model.input_size)
    views = [frame_views(frame, chosen, turns) for frame in flight.frames]
    levels, cut_shares = np.array([one.level for one in views]), np.array([one.share for one in views])
    headings = [one.headings for one in views]
    notes = _size_notes(flight.frames, levels)
    tiles = None if shipped is None or indexed is not None else shipped.windows(windows, side)
    if indexed is None and tiles is None:
        tiles = described_windows(model, basemap, windows)
    broken: dict[int, PictureError] = {}
    if shipped is not None and (ready := shipped.frames(flight, headings, cut_shares)) is not None:
        queries = ready
    else:
        queries, broken = describe_frames(model, flight.frames, views, query)
    if indexed is not None:
        windows, vectors, told = indexed.near(queries)
        tiles, overlap = vectors.reshape(-1, *vectors.shape[2:]), indexed.overlap
        notes += told
    assert tiles is not None
    owner = owners_of(views)
    bad = {int(owner[j]): str(error) for j, error in broken.items()}
    good = ~np.isin(owner, list(bad))
    means: dict[View, Float32Array] = {}
    whitening = None
    if centre:
        first = np.unique(owner[good], return_index=True)[1]
        if (distinct := _distinct(queries[good][first])) >= MIN_DISTINCT:
            of_tiles, of_queries = tiles.mean(axis=0), queries[good].mean(axis=0)
            means = {"satellite": of_tiles} | ({} if query == "satellite" else {query: of_queries})
            whitening = whitening_of(tiles - of_tiles, queries[good] - of_queries)
            tiles, queries = (
                normalise(whitened(a - b, whitening)) for a, b in ((tiles, of_tiles), (queries, of_queries))
            )
        else:
            notes.append(
                f"Descriptors were not centred by view: that needs {MIN_DISTINCT} distinct photos, and the flight has "
                f"{distinct}."
            )
    described_frames = [None if i in bad else queries[owner == i] for i in range(len(flight.frames))]
    places = np.array([(window.x, window.y) for window in windows])
    window_sizes = np.array([window.size for window in windows])
    by_aircraft = frozenset(i for i, frame in enumerate(flight.frames) if frame.heading_source == "aircraft")
    upright, turned = tiles[: len(windows)], tiles[len(windows) :]
    return MapRetrieval(
        windows,
        places,
        window_sizes,
        upright,
        described_frames,
        headings,
        levels,
        cut_shares,
        side,
        means,
        bad,
        notes,
        whitening,
        by_aircraft,
        overlap,
        turned.reshape(len(turns) - 1, *upright.shape) if len(turns) > 1 else None,
    )


@dataclass(frozen=True)
class FrameViews:
    """The squares of a frame to describe.

    Attributes:
        level: the size of window that the frame is cut for; NaN if its width on the ground is unknown.
        share: of its width that the squares show, see `lpn.flight.files.cut.cut_square`.
        headings: of the comparison in degrees.
        described: number of the first headings that are described; turned windows replace the others.
    """

    level: float
    share: float
    headings: list[float]
    described: int


def frame_views(frame: Frame, sizes: Sequence[float], turns: Sequence[float]) -> FrameViews:
    """Return the squares of a frame for the comparison with windows of these sizes and turns."""
    level, share, cut = math.nan, CUT * min(1.0, frame.height / frame.width), cut_size(frame)
    if cut is not None:
        level = min(sizes, key=lambda size: abs(math.log(size / cut)))
        share *= level / cut
    headings = tried_headings(frame, turns if len(turns) > 1 else None)
    return FrameViews(level, share, headings, len(headings) - (0 if heading_is_certain(frame) else len(turns) - 1))


def owners_of(views: Sequence[FrameViews]) -> Int64Array:
    return np.repeat(np.arange(len(views)), [one.described for one in views])


def describe_frames(
    model: Model, frames: Sequence[Frame], views: Sequence[FrameViews], view: View
) -> tuple[Float32Array, dict[int, PictureError]]:
    """Describe frames, or read earlier descriptions from the user's cache.

    Returns:
        Descriptors, (J, n, D), of each frame at its described headings, and the errors of unreadable frames by their index.
    """
    side = max(model.input_size)
    jobs = [(frames[i], one.share, heading) for i, one in enumerate(views) for heading in one.headings[: one.described]]
    reader = FrameReader(side)

    def of_frame(job: int) -> Float32Array:
        frame, share, heading = jobs[job]
        return model.prepare(reader(frame.file, heading, share), view)

    rows = [_frame_row(frame, heading, share) for frame, share, heading in jobs]
    kind = DescriptorKind.of_model(model, view)
    broken: dict[int, PictureError] = {}

    def fill(partial: PartialStore) -> None:
        fill_store(model, partial, of_frame, view, "Describing frames", broken)

    with in_cache():
        return np.array(write_store(_cached(side, kind, rows), kind, rows, fill, whole=False).float32), broken


def described_windows(model: Model, basemap: Map, windows: list[Window]) -> Float32Array:
    """Return the descriptors of windows, (W, n, D), using the user's cache."""
    ground = _cached(basemap.digest(), model.fingerprint, max(model.input_size), windows)
    with in_cache():
        return np.array(describe_windows(model, basemap, windows, ground).float32)


def _size_notes(frames: Sequence[Frame], levels: Float64Array) -> list[str]:
    """Return a sentence about frames whose windows, of sides `levels` (N,), differ much from their ground."""
    sides = [(cut, level) for frame, level in zip(frames, levels, strict=True) if (cut := cut_size(frame)) is not None]
    unfit = np.array([pair for pair in sides if abs(np.log(pair[1] / pair[0])) > np.log(_PYRAMID)]).reshape(-1, 2)
    if not len(unfit):
        return []
    seen, compared = (
        f"{least:.0f} m" if round(least) == round(most) else f"{least:.0f} to {most:.0f} m"
        for least, most in zip(unfit.min(axis=0), unfit.max(axis=0), strict=True)
    )
    return [
        f"{len(unfit)} of {len(frames)} photos show squares of {seen} of ground and are compared with windows of {compared}, so "
        f"their answers are poor. Windows within a factor of {_PYRAMID:g} fit: give their sizes with --size, or an index of them."
    ]


def whitening_of(*views: Float32Array) -> Float32Array:
    """Return the symmetric matrices that whiten the parts of centred descriptors, (n, D, D).

    Whitening multiplies each part by (C + s I)^(-1/2). C is the covariance of the parts at norm 1, of all views together, and s
    is its mean variance. Directions that vary within a place as much as between places then count less.

    Args:
        views: descriptors of each view, (N, n, D).
    """
    parts = np.concatenate(views).astype(np.float64)
    parts /= np.maximum(np.linalg.norm(parts, axis=2, keepdims=True), 1e-12)
    matrices = []
    for of_part in parts.transpose(1, 0, 2):
        variances, axes = np.linalg.eigh(of_part.T @ of_part / len(of_part))
        scales = 1 / np.sqrt(np.maximum(variances, 0) + _SHRINKAGE * max(variances.mean(), 1e-12))
        matrices.append((axes * (scales / scales.max())) @ axes.T)
    return np.stack(matrices).astype(np.float32)


def frame_identity(frame: Frame) -> list[Any]:
    """Return path, size, and time of change of a frame's picture."""
    try:
        stat = frame.file.stat()
    except OSError:
        return [str(frame.file), None, None]
    return [str(frame.file.resolve()), stat.st_size, stat.st_mtime_ns]


def _frame_row(frame: Frame, heading: float, share: float) -> Row:
    file, size, time = frame_identity(frame)
    return Row(f"{file} {heading!r} {share!r}", size or 0, time or 0)


def _cached(*key: object) -> Path:
    return cache_folder() / "locate" / "descriptors" / hashlib.sha256(repr(key).encode()).hexdigest()[:24]


def _distinct(described: Float32Array) -> int:
    """Count the descriptors (N, n, D) that differ from all earlier ones, up to the number for centring."""
    kept: list[Float32Array] = []
    for one in described.reshape(len(described), -1):
        if len(kept) < MIN_DISTINCT and all(float(one @ other) < ALIKE for other in kept):
            kept.append(one)
    return len(kept)
