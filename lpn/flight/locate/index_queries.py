"""The frames of a flight as queries over an index of windows."""

from __future__ import annotations

import logging
import math
from pathlib import Path

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Int64Array
from lpn.core.files import printable
from lpn.core.views import views_of
from lpn.datasets import Picture
from lpn.datasets.geo import Position
from lpn.flight.files import Flight, Frame
from lpn.flight.files.cut import TurnedFrame
from lpn.flight.locate.index_windows import recorded_windows
from lpn.flight.locate.retrieval import describe_frames, frame_views, owners_of
from lpn.flight.maps import Map
from lpn.index import Index
from lpn.index.queries import IndexQueries, fitting_tasks, view_pair
from lpn.models.base import Model

log = logging.getLogger(__name__)


def flight_queries(
    model: Model,
    flight: Flight,
    basemap: Map,
    index: Index,
    root: Path,
) -> IndexQueries:
    """Describe frames as they are compared with the windows of an index.

    A frame is turned north-up by its heading. If that is uncertain, the heading of `tried_headings` with the nearest window is
    taken; turned windows of the index replace turns of the frame. A frame of known width on the ground is cut to the nearest size
    of window in the index. Windows that hold a frame's tag are its true ones. An unreadable frame is logged and noted, and its
    place is unknown.

    Args:
        basemap: map of the windows.
        root: folder of the flight, which holds a person's notes.

    Raises:
        InputError: if the model's branches have roles, and it has one view, or the index was made for other tiles than windows
            of the map.
        StoreError: if the index holds descriptors of another model.
    """
    name = fitting_tasks(model, [view_pair(model)], index)[0]
    record, pixels = recorded_windows(index, basemap), max(model.input_size)
    turns = [360 / record.turns * k for k in range(record.turns)]
    views = [frame_views(frame, record.sizes, turns) for frame in flight.frames]
    described, broken = describe_frames(model.for_task(*views_of(name)), flight.frames, views, views_of(name)[0])
    owners = owners_of(views)
    for i in np.unique(owners[list(broken)]) if broken else ():
        log.warning("%s", next(error for j, error in broken.items() if owners[j] == i))
    good = ~np.isin(np.arange(len(owners)), list(broken))
    chosen = [_best(index, described, np.flatnonzero(owners == i), good) for i in range(len(flight.frames))]
    starts = np.searchsorted(owners, np.arange(len(views)))
    cuts = [
        TurnedFrame(frame, one.headings[j - start], one.share, pixels)
        for frame, one, j, start in zip(flight.frames, views, chosen, starts.tolist(), strict=True)
    ]
    spots = np.where(good[chosen][:, None], basemap.frame.xy(*flight.degrees.T), math.nan)
    return IndexQueries(
        name=name,
        data_name=printable(f"{flight.name} over {basemap.name}"),
        root=root,
        pictures=[
            _picture(i, cut, one.described, root, not good[j])
            for i, (cut, one, j) in enumerate(zip(cuts, views, chosen, strict=True))
        ],
        descriptors=described[chosen],
        places=[_place(frame) for frame in flight.frames],
        spots=spots,
    )


def _best(index: Index, described: Float32Array, turns: Int64Array, good: BoolArray) -> int:
    """Return the turn of a frame with the nearest window; the first if the frame is unreadable."""
    if len(turns) == 1 or not good[turns[0]]:
        return int(turns[0])
    scores = [index.search(described[turn], None, 1).scores[0] for turn in turns]
    return int(turns[int(np.argmax(scores))])


def _picture(label: int, cut: TurnedFrame, turns: int, root: Path, unreadable: bool) -> Picture:
    frame = cut.frame
    file = frame.file if frame.file.is_relative_to(root) else root / frame.name
    note = f"heading {cut.heading:.0f}°, best of {turns}" if turns > 1 else ""
    note = "cannot be read" if unreadable else note
    return Picture(file, label, printable(frame.name), note=note, cut=cut)


def _place(frame: Frame) -> Position | None:
    if frame.latitude is None or frame.longitude is None:
        return None
    if (height := frame.flying_height or 0.0) <= 0:
        return Position(frame.latitude, frame.longitude)
    return Position(frame.latitude, frame.longitude, altitude=height, heading=0.0)
