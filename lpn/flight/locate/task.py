"""A flight over a map as a task, and its frames as queries over an index of windows.

Frames are the queries, windows of the map are the gallery. So a flight has all that a task offers: rankings, contributions,
evidence, outcomes, reports. No picture is described again, and windows are cut from the map on demand.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.tables import Column, number_column, text_column
from lpn.core.views import views_of
from lpn.datasets import Picture, Truth
from lpn.datasets.geo import Position
from lpn.flight.files import Flight
from lpn.flight.files.cut import TurnedFrame
from lpn.flight.locate.located import STAGES, LocatedFlight
from lpn.flight.locate.retrieval import (
    FrameViews,
    MapRetrieval,
    describe_frames,
    heading_is_certain,
    owners_of,
    recorded_windows,
    turns_of,
)
from lpn.flight.locate.verdict import judge
from lpn.flight.maps import Map
from lpn.flight.maps.named_window import WindowCut, caption_of, describe_place
from lpn.index import Index
from lpn.index.queries import IndexQueries, fitting_tasks, view_pair
from lpn.models.base import Model
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task, descriptor_clauses

log = logging.getLogger(__name__)

TASK = "drone-to-satellite"
_OFF_TAG = "Distance from the photo's GPS tag, or from its correction by hand; tags themselves may be metres off"
# The name of the column of `stage_columns` that has a sentence for each frame.
REASON = "reason"
# Verdicts in words, by the verdict's stage.
_VERDICTS = {
    "registration": "registered",
    "sequence": "by its neighbours",
    "retrieval": "not verified",
    None: "not located",
}


def flight_task(model: Model, model_name: str, located: LocatedFlight, root: Path) -> Task:
    """Return the task of a located flight; query i is frame i, and gallery picture j is window j of the retrieval.

    Scores are those of the retrieval. If it centred and whitened the descriptors, so does the task's model (`Model.centred`). A
    frame that was described at several headings is a query at the heading of its best window, with its whole ranking.

    The true tiles of a frame are the windows that contain the place of `LocatedFlight.photographed` (the tag, or the
    registration if tags are late). If its width on the ground is known, windows of other sizes are junk, as the retrieval does
    not rank them. The truth of an unreadable frame, or one without such a place, is unknown.

    Args:
        model_name: the model's name to display.
        root: the flight's folder, which holds a person's notes.

    Raises:
        InputError: if the flight was located without a model, or the model lacks a view.
    """
    retrieval = located.retrieval
    if retrieval is None:
        raise InputError("The flight was located without a model, so there is no ranking to explore; give a model.")
    gallery = retrieval.gallery
    if gallery.turned is not None:
        raise InputError(
            "The index has turned windows, which cannot be explored here; give the flight as SOURCE with --index."
        )
    for view in ("satellite", "drone"):
        model.check_view(view)
    headings, queries = [], np.zeros((len(located.frames), *gallery.described.shape[1:]), np.float32)
    for i, (views, described) in enumerate(zip(retrieval.views, retrieval.frames_described, strict=True)):
        turn = 0 if described is None else retrieval.best_turn(i)
        headings.append(views.headings[turn])
        if described is not None:
            queries[i] = described[turn]
    if retrieval.means:
        model = model.centred(retrieval.means, retrieval.whitening)
    first, several = len(queries), len(set(gallery.sizes.tolist())) > 1
    tasks = zip(located.frames, retrieval.views, headings, strict=True)
    return Task(
        name=TASK,
        model=model,
        model_name=printable(model_name),
        data_name=printable(f"{located.flight.name} over {located.basemap.name}"),
        root=root,
        contract=model.contract,
        clauses=descriptor_clauses(model.contract),
        map_sizes={view: model.map_size(view) for view in model.views},
        queries=[
            _query(TurnedFrame(one.frame, heading, views.share, retrieval.pixels), i, len(views.headings), root)
            for i, (one, views, heading) in enumerate(tasks)
        ],
        # Windows are named by their centre in metres from the map's origin, and by their side if it varies.
        gallery=[
            Picture(
                root / "windows" / str(j),
                first + j,
                describe_place(window, several),
                cut=WindowCut(located.basemap, window, retrieval.pixels),
                caption=caption_of(window),
            )
            for j, window in enumerate(gallery.windows)
        ],
        query_labels=np.arange(first, dtype=np.int64),
        gallery_labels=np.arange(first, first + len(gallery.windows), dtype=np.int64),
        query_descriptors=queries,
        gallery_descriptors=gallery.described,
        truth=_truth(located, retrieval),
        geometry=_geometry(located, retrieval),
        columns=_columns(located, retrieval, headings),
    )


def flight_queries(model: Model, flight: Flight, basemap: Map, index: Index, root: Path) -> IndexQueries:
    """Describe frames as queries over the windows of an index.

    A frame is turned north-up by its heading. If that is uncertain, the tried heading with the nearest window is taken; turned
    windows of the index replace turns of the frame. A frame of known width on the ground is cut to the nearest size of window in
    the index. Windows that contain a frame's tag are its true tiles. An unreadable frame is logged and noted, and its place is
    unknown.

    Args:
        basemap: map of the windows.
        root: folder of the flight, which holds a person's notes.

    Raises:
        InputError: if a model with roles has only one view, or the index was made for other tiles than windows
            of the map.
        StoreError: if the index holds descriptors of another model.
    """
    name = fitting_tasks(model, [view_pair(model)], index)[0]
    record, pixels = recorded_windows(index, basemap), max(model.input_size)
    views = [FrameViews.of(frame, record.sizes, turns_of(record)) for frame in flight.frames]
    described, broken = describe_frames(model.for_task(*views_of(name)), flight.frames, views, views_of(name)[0])
    owners = owners_of(views)
    pictures, chosen, places = [], [], []
    spots = basemap.frame.xy(*flight.degrees.T)
    for i, (frame, one) in enumerate(zip(flight.frames, views, strict=True)):
        turns, best = np.flatnonzero(owners == i).tolist(), 0
        if (error := broken.get(turns[0])) is not None:
            log.warning("%s", error)
            spots[i] = math.nan
        elif len(turns) > 1:
            best = int(np.argmax([index.search(described[turn], None, 1).scores[0] for turn in turns]))
        cut = TurnedFrame(frame, one.headings[best], one.share, pixels)
        pictures.append(_query(cut, i, one.described, root, "" if error is None else "cannot be read"))
        chosen.append(turns[best])
        known = frame.latitude is not None and frame.longitude is not None
        places.append(_above(flight.degrees[i], frame.flying_height) if known else None)
    data_name = printable(f"{flight.name} over {basemap.name}")
    return IndexQueries(name, data_name, root, pictures, described[chosen], places, spots=spots)


def _query(cut: TurnedFrame, label: int, tried: int, root: Path, note: str = "") -> Picture:
    file = cut.frame.file if cut.frame.file.is_relative_to(root) else root / cut.frame.name
    if tried > 1 and not note:
        note = f"heading {cut.heading:.0f}°, best of {tried}"
    return Picture(file, label, cut.frame.name, note=note, cut=cut)


def _above(degrees: Float64Array, height: float | None, width: float | None = None) -> Position:
    """Return a position above a place, of a north-up picture that is `width` metres wide."""
    latitude, longitude = degrees.tolist()
    if height is None or height <= 0:
        return Position(latitude, longitude)
    fov = None if width is None else 2 * math.degrees(math.atan(width / 2 / height))
    return Position(latitude, longitude, altitude=height, heading=0.0, fov=fov, width=width)


def _truth(located: LocatedFlight, retrieval: MapRetrieval) -> list[Truth]:
    none, gallery = np.zeros(0, np.int64), retrieval.gallery
    others: dict[float, Int64Array] = {}
    truth = []
    for i, (place, views) in enumerate(zip(located.photographed, retrieval.views, strict=True)):
        compared = gallery.compared(views)
        junk = none if math.isnan(views.level) else others.setdefault(views.level, np.flatnonzero(~compared))
        if place is None or i in retrieval.broken:
            truth.append(Truth(none, junk, known=False))
            continue
        holds = np.all(np.abs(gallery.places - place) <= gallery.sizes[:, None] / 2, axis=1)
        truth.append(Truth(np.flatnonzero(compared & holds), junk))
    return truth


def _geometry(located: LocatedFlight, retrieval: MapRetrieval) -> GalleryGeometry:
    """Return the positions; a frame is above its photographed place, with a picture as wide as the compared windows."""
    degrees, gallery = located.basemap.frame.degrees, retrieval.gallery
    tiles = [
        Position(float(latitude), float(longitude), width=float(size))
        for (latitude, longitude), size in zip(degrees(gallery.places), gallery.sizes, strict=True)
    ]
    middle = (gallery.places.min(axis=0) + gallery.places.max(axis=0)) / 2
    positions: list[Position | None] = []
    for one, place, views in zip(located.frames, located.photographed, retrieval.views, strict=True):
        level = None if math.isnan(views.level) else views.level
        height = None if level is None else one.frame.flying_height
        positions.append(None if place is None else _above(degrees([place])[0], height, level))
    return GalleryGeometry(positions, tiles, _above(degrees([middle])[0], None), gallery.places - middle, gallery.side)


def _columns(located: LocatedFlight, retrieval: MapRetrieval, headings: list[float]) -> list[Column]:
    frames = [one.frame for one in located.frames]
    times = located.flight.times
    since = times - np.nanmin(times) if np.isfinite(times).any() else times
    columns = [
        _numbers("seconds", since.tolist(), "s"),
        _numbers("altitude", [frame.flying_height for frame in frames], "m"),
        _numbers("heading", headings, "°"),
        _numbers("pitch", [frame.pitch for frame in frames], "°"),
        _numbers("roll", [frame.roll for frame in frames], "°"),
    ]
    sources = [
        str(frame.heading_source) if heading_is_certain(frame) else f"best of {len(retrieval.views[i].headings)}"
        for i, frame in enumerate(frames)
    ]
    columns.append(text_column("heading from", sources))
    return [column for column in columns if column.known.any()]


def stage_columns(located: LocatedFlight) -> list[Column]:
    """Return columns for each frame: metres from its tag, the registration, the verdict, and its reason.

    A person's correction replaces the tag, see `LocatedFrame.truth`.
    """
    verdicts = [judge(frame) for frame in located.frames]
    answers = [frame.stages.get("registration") for frame in located.frames]
    columns = [
        *(
            _numbers(f"{stage} off tag", [one.error(stage) for one in located.frames], "m", _OFF_TAG)
            for stage in STAGES[1:]
        ),
        text_column("registration", ["" if answer is None else answer.state for answer in answers]),
        _numbers("inliers", [None if answer is None else answer.inliers for answer in answers]),
        text_column("verdict", ["contradicted" if one.contradicted else _VERDICTS[one.stage] for one in verdicts]),
        text_column(REASON, [one.reason for one in verdicts]),
    ]
    return [column for column in columns if column.known.any()]


def _numbers(name: str, values: Sequence[float | None], unit: str = "", about: str = "") -> Column:
    return number_column(name, [math.nan if value is None else round(value, 2) for value in values], unit, about=about)
