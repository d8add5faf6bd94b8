"""Retrieval over a map: windows and frames described by an LPN, and windows ranked for each frame.

A frame is turned north-up, cut to a square with the ground of a window of the pyramid, and described as a drone picture; windows
are described as satellite tiles, or read from an index (`lpn index --map`). A frame of unknown width on the ground is compared
with windows of all sizes. A frame of unknown or uncertain heading is described at several turns, unless an index holds turned
windows.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec
import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError, PictureError
from lpn.core.files import cache_folder, printable
from lpn.core.filled_cache import FilledCache
from lpn.core.views import View
from lpn.descriptors.cache import in_cache
from lpn.descriptors.store import DescriptorKind, Row, WindowsRecord
from lpn.descriptors.writer import PartialStore, fill_store, write_store
from lpn.flight.files import Flight, Frame
from lpn.flight.files.cut import CUT, FrameReader, cut_size
from lpn.flight.maps import Map, NamedWindow, Window
from lpn.flight.maps.named_window import WindowCut
from lpn.index import Index, open_index
from lpn.models.base import Model, normalise, whitened
from lpn.retrieval import scoring

if TYPE_CHECKING:
    from lpn.flight.locate.shipped import ShippedAnswers

# Ratio of one size of the pyramid to the next, and the most sizes without a known width.
_PYRAMID = 1.4
_SIZES = 5
# Number of tried headings if none is certain.
_TURNS = 8
# Least distance between the centres of a frame's best windows, as a share of their side: overlapping windows show one place.
APART = 0.5
# Minimum of distinct frames for centring: a mean of fewer frames keeps their differences. A cosine above ALIKE: not distinct.
MIN_DISTINCT = 20
ALIKE = 0.99
# Usual turns of pictures from the aircraft's heading, in degrees, as it drifts and banks.
_AIRCRAFT_TURNS = (0.0, -10.0, 10.0, -20.0, 20.0)
# Any other heading must be better by this many standard deviations of the frame's scores.
_OTHER_TURN = 1.5
# Added to the variances of whitening, as a share of their mean: few samples estimate small variances badly.
_SHRINKAGE = 1.0
# Maximum of bytes of frames' scores in memory: the sequence reads the scores of each frame a dozen times.
_HELD_SCORES = 1 << 26
# Up to this many windows of an index are all compared with each frame: 400 MB with 4 parts of 512 numbers.
MOST = 50_000
# With a larger index: the windows that each description of a frame is compared with, and their minimum in a long flight.
NEAREST, _FEWEST = 500, 20


class WindowRecord(msgspec.Struct, frozen=True):
    """A ranked window of a frame: its place and side in metres, score, heading, part cosines, and part contributions."""

    x: float
    y: float
    size: float
    score: float = 0.0
    heading: float = 0.0
    cosines: list[float] = []
    contributions: list[float] = []


@dataclass(frozen=True)
class FrameViews:
    """The squares of a frame to describe.

    Attributes:
        level: the size of window that the frame is cut for; NaN if its width on the ground is unknown, so that windows of all
            sizes are compared.
        share: of the frame's width that the squares show, see `lpn.flight.files.cut.cut_square`.
        headings: of the comparison in degrees.
        described: the frame is described at this many of the first headings; turned windows replace the others.
        aircraft: whether the first five headings are within 20 degrees of the aircraft's heading.
    """

    level: float
    share: float
    headings: list[float]
    described: int = 1
    aircraft: bool = False

    @classmethod
    def of(cls, frame: Frame, sizes: Sequence[float], turns: Sequence[float] = (0.0,)) -> FrameViews:
        """Return the squares of a frame for windows of these sizes in metres, and of these turns in degrees, from 0 on."""
        level, share, cut = math.nan, CUT * min(1.0, frame.height / frame.width), cut_size(frame)
        if cut is not None:
            level = float(min(sizes, key=lambda size: abs(math.log(size / cut))))
            share *= level / cut
        aircraft, replaced = frame.heading_source == "aircraft", len(turns) - 1
        others = turns[1:] if replaced else [360 / _TURNS * k for k in range(1, _TURNS)]
        tried = [*(_AIRCRAFT_TURNS if aircraft else (0.0,)), *others]
        if heading_is_certain(frame):
            tried, replaced = [0.0], 0
        headings = [((frame.heading or 0.0) + turn) % 360 for turn in tried]
        return cls(level, share, headings, len(headings) - replaced, aircraft)


@dataclass(frozen=True, eq=False)
class WindowGallery:
    """The described windows of a map.

    Attributes:
        windows: of the map.
        overlap: share of a window's side that its neighbour also covers.
        described: (W, n, D) float32.
        turned: descriptors at further headings, evenly turned, (T - 1, W, n, D); None unless an index has them. They are
            compared with a frame's first description, and stand for the last T - 1 of its headings.
    """

    windows: list[Window]
    overlap: float
    described: Float32Array
    turned: Float32Array | None = None

    @cached_property
    def places(self) -> Float64Array:
        """The centres in metres, (W, 2)."""
        return np.array([(window.x, window.y) for window in self.windows])

    @cached_property
    def sizes(self) -> Float64Array:
        """The sides in metres, (W,)."""
        return np.array([window.size for window in self.windows])

    @cached_property
    def levels(self) -> list[float]:
        """The sides that occur, ascending."""
        return [float(size) for size in np.unique(self.sizes)]

    @cached_property
    def side(self) -> float:
        """The median side in metres."""
        return float(np.median(self.sizes))

    @property
    def step(self) -> float:
        """The metres from one window to the next, at least 1."""
        return max(self.side * (1 - self.overlap), 1.0)

    def compared(self, views: FrameViews) -> BoolArray:
        """Return for each window whether a frame is compared with it, (W,)."""
        return np.asarray(math.isnan(views.level) | (self.sizes == views.level))

    def scores(self, views: FrameViews, described: Float32Array | None) -> Float64Array:
        """Return the score of each window at each of a frame's headings, (W, H); (W, 1) zeros for an unreadable frame.

        Headings more than 20 degrees from an aircraft's lose 1.5 standard deviations of the frame's scores. Windows that are not
        compared get the lowest of all windows' best scores.

        Args:
            described: the frame at its described headings, (H, n, D); None if it is unreadable.
        """
        if described is None:
            return np.zeros((len(self.windows), 1))
        flat = self.described.reshape(len(self.windows), -1)
        scores = (flat @ described.reshape(len(described), -1).T).astype(np.float64)
        if self.turned is not None and len(views.headings) > len(described):
            turned = self.turned.reshape(-1, flat.shape[1]) @ described[0].reshape(-1)
            scores = np.concatenate([scores, turned.reshape(-1, len(flat)).T], axis=1)
        if views.aircraft:
            scores[:, len(_AIRCRAFT_TURNS) :] -= _OTHER_TURN * scores.std()
        if not math.isnan(views.level):
            scores[~self.compared(views)] = scores.max(axis=1).min()
        return scores

    def best(self, views: FrameViews, described: Float32Array, scores: Float64Array, k: int) -> list[WindowRecord]:
        """Return the k best windows of a frame by its `scores` whose centres lie half a side apart, best first."""
        values, headings = scores.max(axis=1), scores.argmax(axis=1)
        kept: list[int] = []
        found: list[WindowRecord] = []
        for i in np.argsort(-values, kind="stable").tolist():
            off = np.abs(self.places[kept] - self.places[i]).max(axis=1, initial=0)
            if (off < APART * np.maximum(self.sizes[kept], self.sizes[i])).any():
                continue
            kept.append(i)
            turn, place = int(headings[i]), self.windows[i]
            if turn < len(described):
                cosines = scoring.part_cosines(described[turn], self.described[i : i + 1])[0]
            else:
                assert self.turned is not None
                cosines = scoring.part_cosines(described[0], self.turned[turn - len(described), i : i + 1])[0]
            parts = scoring.contributions(cosines[None], scoring.part_weights(len(cosines)))[0]
            told = float(values[i]), views.headings[turn], cosines.tolist(), parts.tolist()
            found.append(WindowRecord(place.x, place.y, place.size, *told))
            if len(found) == k:
                break
        return found


@dataclass(frozen=True, eq=False)
class MapRetrieval:
    """Scores of all windows of a map for all frames of a flight.

    Attributes:
        gallery: the windows.
        views: of each frame.
        frames_described: descriptors of each frame at its described headings, (H, n, D); None for an unreadable frame.
        pixels: side of the described pictures.
        broken: the error of each unreadable frame.
        means: the mean descriptor that was subtracted, by view, (n, D); empty without centring.
        whitening: the matrix that multiplied each centred part, (n, D, D); None without whitening.
        notes: sentences about the description.
    """

    gallery: WindowGallery
    views: list[FrameViews]
    frames_described: list[Float32Array | None]
    pixels: int
    broken: dict[int, str]
    means: dict[View, Float32Array] = field(default_factory=dict)
    whitening: Float32Array | None = None
    notes: list[str] = field(default_factory=list)
    _scores: FilledCache[Float64Array] = field(
        default_factory=lambda: FilledCache(_HELD_SCORES, lambda scores: scores.nbytes), init=False, repr=False
    )

    def scores(self, frame: int) -> Float64Array:
        """Return the score of each window at its best heading, (W,)."""
        best: Float64Array = self.scores_by_heading(frame).max(axis=1)
        return best

    def scores_by_heading(self, frame: int) -> Float64Array:
        """Return the read-only scores of a frame, (W, H), see `WindowGallery.scores`."""

        def scored() -> Float64Array:
            scores = self.gallery.scores(self.views[frame], self.frames_described[frame])
            scores.flags.writeable = False  # it is cached
            return scores

        return self._scores.get(frame, scored)

    def best_turn(self, frame: int) -> int:
        """Return the index of the heading at which a frame's best window has its score."""
        scores = self.scores_by_heading(frame)
        return int(scores[scores.max(axis=1).argmax()].argmax())

    def first(self, frame: int, k: int) -> Int64Array:
        """Return the k best windows of a frame, best first."""
        order: Int64Array = np.argsort(-self.scores(frame), kind="stable")[:k]
        return order

    def best(self, frame: int, k: int) -> list[WindowRecord]:
        """Return the k best windows of a readable frame, see `WindowGallery.best`."""
        described = self.frames_described[frame]
        assert described is not None
        return self.gallery.best(self.views[frame], described, self.scores_by_heading(frame), k)


def heading_is_certain(frame: Frame) -> bool:
    """Tell whether a frame's heading is of its picture, not of a course or an aircraft."""
    return frame.heading is not None and frame.heading_source not in ("course", "aircraft")


def pyramid_sizes(basemap: Map, frames: Sequence[Frame]) -> list[float]:
    """Return sides of windows in metres, from frames of known width; else at most 60 % of the map's shorter side and 300 m."""
    cuts = [cut for frame in frames if (cut := cut_size(frame)) is not None]
    if cuts:
        low, high = np.log(np.quantile(cuts, (0.02, 0.98)))
        count = int(np.ceil((high - low) / np.log(_PYRAMID))) or 1
        return [float(size) for size in np.exp(low + (np.arange(count) + 0.5) * (high - low) / count)]
    side = 0.6 * min(basemap.bounds[2] - basemap.bounds[0], basemap.bounds[3] - basemap.bounds[1])
    largest = min(side, 300.0)
    return [largest / _PYRAMID**i for i in reversed(range(_SIZES))]


def windows_of(basemap: Map, sizes: Sequence[float], overlap: float) -> list[Window]:
    """Return the windows of a map of these sides in metres, smaller ones first; InputError if none has data."""
    windows = basemap.pyramid(sorted(sizes), overlap)
    if not windows:
        raise InputError(
            f"No window of {min(sizes):.0f} m or more fits on the map {basemap.name}; give a smaller size of windows with --size."
        )
    return windows


def retrieve(
    model: Model,
    basemap: Map,
    flight: Flight,
    sizes: Sequence[float] | None = None,
    overlap: float = 0.75,
    index: str | None = None,
    shipped: ShippedAnswers | None = None,
) -> MapRetrieval:
    """Describe windows and frames, or read earlier descriptions from the user's cache.

    The mean descriptors of windows and of frames are subtracted part by part, to remove differences of the views that are new
    to the model. Then the parts are whitened, see `whitening_of`. With fewer than 20 distinct frames, a note replaces both.

    Args:
        sizes: sides of windows in metres; by default from `pyramid_sizes`.
        overlap: share of a window's side that its neighbour also covers.
        index: an index of described windows, a folder or milvus://host:port/collection, which replaces `sizes` and `overlap`.
        shipped: descriptors that ship with the flight, used if they fit the windows and frames.

    Raises:
        InputError: if the model lacks a view, no window of the map has data, or the index holds none of this map.
        StoreError: if there is no index, or it holds descriptors of another model.
    """
    query: View = "drone" if "drone" in model.views else "satellite"
    model.check_view("satellite")
    side, record, turns = max(model.input_size), None, [0.0]
    if index is not None:
        with open_index(index, model.fingerprint) as opened:
            record, held = recorded_windows(opened, basemap), opened.count()
        if not held:
            raise InputError("The index holds no window; fill it with lpn index --map, or leave --index out.")
        sizes, turns = record.sizes, turns_of(record)
    chosen = sorted(sizes or pyramid_sizes(basemap, flight.frames))
    views = [FrameViews.of(frame, chosen, turns) for frame in flight.frames]
    windows = [] if record is not None else windows_of(basemap, chosen, overlap)
    notes = size_notes(flight.frames, views)
    tiles = None if shipped is None or record is not None else shipped.windows(windows, side)
    if record is None and tiles is None:
        tiles = described_windows(model, basemap, windows)
    queries, broken = None if shipped is None else shipped.frames(flight, views), dict[int, PictureError]()
    if queries is None:
        queries, broken = describe_frames(model, flight.frames, views, query)
    if record is not None and index is not None:
        windows, tiles, told = _indexed(index, record, model, basemap, queries)
        overlap, notes = record.overlap, notes + told
    assert tiles is not None
    owner = owners_of(views)
    bad = {int(owner[j]): str(error) for j, error in broken.items()}
    good = ~np.isin(owner, list(bad))
    means: dict[View, Float32Array] = {}
    whitening = None
    first = np.unique(owner[good], return_index=True)[1]
    if (distinct := _distinct(queries[good][first])) >= MIN_DISTINCT:
        of_tiles, of_queries = tiles.mean(axis=0), queries[good].mean(axis=0)
        means = {"satellite": of_tiles} | ({} if query == "satellite" else {query: of_queries})
        whitening = whitening_of(tiles - of_tiles, queries[good] - of_queries)
        tiles, queries = (normalise(whitened(a - b, whitening)) for a, b in ((tiles, of_tiles), (queries, of_queries)))
    else:
        notes.append(
            f"Descriptors were not centred by view: that needs {MIN_DISTINCT} distinct photos, and the flight has {distinct}."
        )
    upright, turned = tiles[: len(windows)], tiles[len(windows) :]
    gallery = WindowGallery(
        windows, overlap, upright, turned.reshape(len(turns) - 1, *upright.shape) if len(turns) > 1 else None
    )
    described = [None if i in bad else queries[owner == i] for i in range(len(views))]
    return MapRetrieval(gallery, views, described, side, bad, means, whitening, notes)


def owners_of(views: Sequence[FrameViews]) -> Int64Array:
    """Return the index of the frame of each described square."""
    return np.repeat(np.arange(len(views)), [one.described for one in views])


def describe_frames(
    model: Model, frames: Sequence[Frame], views: Sequence[FrameViews], view: View
) -> tuple[Float32Array, dict[int, PictureError]]:
    """Describe frames, or read earlier descriptions from the user's cache.

    Returns:
        Descriptors, (J, n, D), of each frame at its described headings, and the errors of unreadable squares by their index.
    """
    side = max(model.input_size)
    jobs = [(frames[i], one.share, heading) for i, one in enumerate(views) for heading in one.headings[: one.described]]
    reader = FrameReader(side)

    def of_frame(job: int) -> Float32Array:
        frame, share, heading = jobs[job]
        return model.prepare(reader(frame.file, heading, share), view)

    def row(frame: Frame, share: float, heading: float) -> Row:
        file, size, time = frame_identity(frame)
        return Row(f"{file} {heading!r} {share!r}", size or 0, time or 0)

    kind, rows = DescriptorKind.of_model(model, view), [row(*job) for job in jobs]
    broken: dict[int, PictureError] = {}

    def fill(partial: PartialStore) -> None:
        fill_store(model, partial, of_frame, view, "Describing frames", broken)

    with in_cache():
        return np.array(write_store(_cached(side, kind, rows), kind, rows, fill, whole=False).float32), broken


def described_windows(model: Model, basemap: Map, windows: list[Window]) -> Float32Array:
    """Describe windows of a map, mirror included, (W, n, D), or read earlier descriptions from the user's cache.

    A window is cut when it is described, so memory holds only the batches in progress. After a kill, the next call resumes.

    Raises:
        PictureError: if a file of the map is damaged where a window lies.
    """
    side = max(model.input_size)
    # A row identifies its picture by name, size, and time: here the side in pixels stands for the size, and a digest of the map
    # for the time.
    version = int(basemap.digest()[:15], 16)
    rows = [Row(f"{one.x!r},{one.y!r},{one.size!r},{one.heading!r}", side, version) for one in windows]

    def prepare(row: int) -> Float32Array:
        return model.prepare(WindowCut(basemap, windows[row], side)(), "satellite")

    def fill(partial: PartialStore) -> None:
        fill_store(model, partial, prepare, "satellite", "Describing windows")

    folder = _cached(basemap.digest(), model.fingerprint, side, windows)
    with in_cache():
        return np.array(write_store(folder, DescriptorKind.of_model(model, "satellite"), rows, fill).float32)


def recorded_windows(index: Index, basemap: Map) -> WindowsRecord:
    """Return the record of an index's windows; InputError if it was made for other tiles, or for another map."""
    record = index.kind.windows
    if record is None:
        raise InputError("The index does not say which windows of which map it holds; make it with lpn index --map.")
    if record.map != basemap.identity():
        raise InputError(
            f"The index holds windows of another map than {printable(basemap.name)}, or the map changed; make the index again."
        )
    return record


def turns_of(record: WindowsRecord) -> list[float]:
    """Return the headings in degrees at which an index holds each window, from 0 on."""
    return [360 / record.turns * k for k in range(record.turns)]


def _indexed(
    where: str, record: WindowsRecord, model: Model, basemap: Map, described: Float32Array
) -> tuple[list[Window], Float32Array, list[str]]:
    """Return north-up windows to compare with described frames (Q, n, D), their descriptors (T W, n, D), and sentences."""
    notes, turns, whole = [], turns_of(record), record.count * record.turns
    with open_index(where, model.fingerprint) as index:
        held = index.count()
        if whole <= MOST:
            windows = basemap.pyramid(record.sizes, record.overlap)
            named = NamedWindow.all_of(windows, basemap.frame)
        else:
            # One search for each description bounds the memory. Unreadable frames are zeros.
            asked = described[np.abs(described).sum(axis=(1, 2)) > 0]
            if not len(asked):
                raise InputError(
                    "No photo of the flight can be read, so no window of the index can be near one; check the photos."
                )
            wanted = min(NEAREST, max(_FEWEST, MOST // len(asked)), held, index.most or NEAREST)
            found = dict.fromkeys(name for one in asked for name in index.search(one, None, wanted).ids)
            parsed = [one for name in found if (one := NamedWindow.parse(name)) is not None]
            named = list(dict.fromkeys(replace(one, heading=0.0) for one in parsed))
            # A name has its window's side rounded, too.
            windows = [
                Window(one.x, one.y, min(record.sizes, key=lambda size, one=one: abs(size - one.size)))  # type: ignore[misc]
                for one in NamedWindow.all_on(named, basemap.frame)
            ]
        names = [[replace(one, heading=round(turn, 2)).name for turn in turns] for one in named]
        whole_ones = (
            index.holds([name for of_window in names for name in of_window]).reshape(-1, len(turns)).all(axis=1)
        )
        chosen = np.flatnonzero(whole_ones).tolist()
        if not chosen:
            raise InputError("The index holds no window at all of its headings; let lpn index --map go on to its end.")
        vectors = index.read([names[i][k] for k in range(len(turns)) for i in chosen])[0]
    if whole > MOST:
        notes.append(
            f"The index holds {held:,} windows; photos were compared with the {len(vectors):,} most similar ones."
        )
    if held < whole:
        notes.append(
            f"The index holds {held:,} of {whole:,} windows of the map, and photos of the others cannot be located; let "
            "lpn index --map go on to its end."
        )
    return [windows[i] for i in chosen], vectors.astype(np.float32, copy=False), notes


def size_notes(frames: Sequence[Frame], views: Sequence[FrameViews]) -> list[str]:
    """Return a sentence about frames whose windows differ much from their ground."""
    sides = [(cut, one.level) for frame, one in zip(frames, views, strict=True) if (cut := cut_size(frame)) is not None]
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


def _cached(*key: object) -> Path:
    return cache_folder() / "locate" / "descriptors" / hashlib.sha256(repr(key).encode()).hexdigest()[:24]


def _distinct(described: Float32Array) -> int:
    """Count the descriptors (N, n, D) that differ from all earlier ones, up to the number for centring."""
    kept: list[Float32Array] = []
    for one in described.reshape(len(described), -1):
        if len(kept) < MIN_DISTINCT and all(float(one @ other) < ALIKE for other in kept):
            kept.append(one)
    return len(kept)
