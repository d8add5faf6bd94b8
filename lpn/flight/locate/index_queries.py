"""The frames of a flight as queries over an index of windows."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array
from lpn.core.files import printable
from lpn.core.progress import report_progress
from lpn.core.views import views_of
from lpn.datasets import Picture
from lpn.datasets.geo import Position
from lpn.descriptors.parallel_inference import describe_each
from lpn.flight.files import Flight, Frame
from lpn.flight.files.cut import CUT, FrameReader, TurnedFrame, cut_size
from lpn.flight.locate.retrieval import tried_headings
from lpn.flight.maps import Map, NamedWindow
from lpn.index import Index
from lpn.index.queries import IndexQueries, fitting_tasks, view_pair
from lpn.models.base import Model, normalise

log = logging.getLogger(__name__)

# Searches by drawn descriptors that show how large windows are, and tiles that each returns.
_PROBES, _PROBED = 2, 100


def flight_queries(
    model: Model,
    flight: Flight,
    basemap: Map,
    index: Index,
    root: Path,
) -> IndexQueries:
    """Describe frames as they are compared with the windows of an index.

    A frame is turned north-up by its heading. Where that is not certain, it takes the one of `tried_headings` whose nearest
    window is nearest; if the index holds turned windows, these stand for the other headings. Where its width on the ground is
    known, it is cut to the nearest size of window that the index holds. A window shows a frame's place if it holds the frame's
    tag. A frame that cannot be read is logged and noted; its place is not known.

    Args:
        basemap: map of the windows.
        root: folder of the flight, where a person's notes are kept.

    Raises:
        InputError: if the model's branches have roles, and it has one view.
        StoreError: if the index holds descriptors of another model.
    """
    name = fitting_tasks(model, [view_pair(model)], index)[0]
    held, pixels = _some_windows(index), max(model.input_size)
    sizes, turned_windows = sorted({one.size for one in held}), any(one.heading for one in held)
    cuts: list[TurnedFrame] = []
    owners: list[int] = []
    for i, frame in enumerate(flight.frames):
        headings = tried_headings(frame, (0.0,) if turned_windows else None)
        turned = [TurnedFrame(frame, heading, _share(frame, sizes), pixels) for heading in headings]
        cuts += turned
        owners += [i] * len(turned)
    view, model = views_of(name)[0], model.for_task(*views_of(name))
    described = np.zeros((len(cuts), model.n_parts, model.embedding), np.float32)
    good, done = np.zeros(len(cuts), bool), 0
    unreadable: set[int] = set()
    reader = FrameReader(pixels)

    def prepared(cut: TurnedFrame) -> Float32Array:
        return model.prepare(reader(cut.frame.file, cut.heading, cut.share), view)

    for batch in describe_each(model, cuts, prepared, view):
        described[batch.items], good[batch.items] = batch.descriptors, True
        for j, error in batch.broken:
            if owners[j] not in unreadable:
                log.warning("%s", error)
            unreadable.add(owners[j])
        done += len(batch.items) + len(batch.broken)
        report_progress("Describing frames", done, len(cuts))
    chosen = [
        _best(index, described, [j for j, owner in enumerate(owners) if owner == i], good)
        for i in range(len(flight.frames))
    ]
    spots = np.where(good[chosen][:, None], _tags(flight.frames, basemap), math.nan)
    return IndexQueries(
        name=name,
        data_name=printable(f"{flight.name} over {basemap.name}"),
        root=root,
        pictures=[
            _picture(flight.frames[i], i, cuts[j], owners.count(i), root, i in unreadable) for i, j in enumerate(chosen)
        ],
        descriptors=described[chosen],
        places=[_place(frame) for frame in flight.frames],
        spots=spots,
    )


def _some_windows(index: Index) -> list[NamedWindow]:
    """Return some windows that an index holds, which tell its sizes and headings, by searches for drawn descriptors."""
    shape = _PROBES, index.kind.n_parts, index.kind.embedding
    drawn = normalise(np.random.default_rng(0).standard_normal(shape).astype(np.float32))
    names = (name for one in drawn for name in index.search(one, None, _PROBED).ids)
    return [window for name in names if (window := NamedWindow.parse(name)) is not None]


def _share(frame: Frame, sizes: Sequence[float]) -> float:
    """Return the share of a frame's width that its square shows."""
    share, cut = CUT * min(1.0, frame.height / frame.width), cut_size(frame)
    if cut is None or not sizes:
        return share
    return share * min(sizes, key=lambda size: abs(math.log(size / cut))) / cut


def _best(index: Index, described: Float32Array, turns: Sequence[int], good: BoolArray) -> int:
    """Return which of a frame's turns has the nearest window; the first if none can be read."""
    if len(turns) == 1 or not good[turns[0]]:
        return turns[0]
    return max(turns, key=lambda turn: float(index.search(described[turn], None, 1).scores[0]))


def _tags(frames: Sequence[Frame], basemap: Map) -> Float64Array:
    """Return each frame's tag in metres of the map's frame, (N, 2), NaN without one."""
    degrees = [
        (math.nan, math.nan) if f.latitude is None or f.longitude is None else (f.latitude, f.longitude) for f in frames
    ]
    latitude, longitude = np.array(degrees, np.float64).reshape(-1, 2).T
    return basemap.frame.xy(latitude, longitude)


def _picture(frame: Frame, label: int, cut: TurnedFrame, turns: int, root: Path, unreadable: bool) -> Picture:
    file = frame.file if frame.file.is_relative_to(root) else root / frame.name
    note = f"heading {cut.heading:.0f}°, best of {turns}" if turns > 1 else ""
    note = "cannot be read" if unreadable else note
    return Picture(file, label, printable(frame.name), note=note, cut=cut)


def _place(frame: Frame) -> Position | None:
    if frame.latitude is None or frame.longitude is None:
        return None
    height = frame.flying_height
    if height is None or height <= 0:
        return Position(frame.latitude, frame.longitude)
    return Position(frame.latitude, frame.longitude, altitude=height, heading=0.0)
