"""A flight over a map as a task: frames are the queries, windows of the map are the gallery.

All views of a task then work for a flight: rankings, contributions, evidence, outcomes, reports. No picture is described again,
and windows are cut from the map on demand.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.tables import Column, number_column, text_column
from lpn.datasets import Picture, Truth
from lpn.datasets.geo import Position
from lpn.flight.files import Frame
from lpn.flight.files.cut import TurnedFrame
from lpn.flight.locate.located import STAGES, LocatedFlight
from lpn.flight.locate.retrieval import MapRetrieval, heading_is_certain
from lpn.flight.locate.verdict import judge
from lpn.flight.maps import Map
from lpn.flight.maps.named_window import WindowCut, caption_of, describe_place
from lpn.models.base import Model
from lpn.tasks.gallery_geometry import GalleryGeometry
from lpn.tasks.task import Task, descriptor_clauses

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

    Scores are the retrieval's. If it centred and whitened the descriptors, so does the task's model (`Model.centred`). A frame
    that was described at several headings is a query at the heading of its best window, and its whole ranking is at this heading.

    The true tiles of a frame are the windows that hold the place of `LocatedFlight.photographed` (the tag, or the registration if
    tags are late). If its width on the ground is known, windows of other sizes are junk, as the retrieval does not rank them. The
    truth of an unreadable frame, or one without such a place, is unknown.

    Args:
        model_name: the model's name to display.
        root: the flight's folder, which holds a person's notes.

    Raises:
        InputError: if the flight was located without a model, or the model lacks a view.
    """
    retrieval = located.retrieval
    if retrieval is None:
        raise InputError("The flight was located without a model, so there is no ranking to explore; give a model.")
    if retrieval.turned_windows is not None:
        raise InputError(
            "The index holds turned windows, in place of turned photos; give the flight as SOURCE with --index."
        )
    for view in ("satellite", "drone"):
        model.check_view(view)
    turns = [0 if i in retrieval.broken else retrieval.best_turn(i) for i in range(len(located.frames))]
    truth, geometry = _truth(located, retrieval), _geometry(located, retrieval)
    queries = _descriptors(retrieval, turns)
    digest = hashlib.sha256(queries.tobytes() + np.ascontiguousarray(retrieval.windows_described).tobytes()).hexdigest()
    if retrieval.means:
        model = model.centred(retrieval.means, retrieval.whitening)
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
            _query(retrieval, i, located.frames[i].frame, retrieval.headings[i][turn], root)
            for i, turn in enumerate(turns)
        ],
        gallery=_gallery(located.basemap, retrieval, root),
        query_labels=np.arange(len(turns), dtype=np.int64),
        gallery_labels=np.arange(len(turns), len(turns) + len(retrieval.windows), dtype=np.int64),
        query_descriptors=queries,
        gallery_descriptors=retrieval.windows_described,
        truth=truth,
        geometry=geometry,
        identity=digest,
        columns=_columns(located, retrieval, turns),
    )


def _query(retrieval: MapRetrieval, i: int, frame: Frame, heading: float, root: Path) -> Picture:
    file = frame.file if frame.file.is_relative_to(root) else root / frame.name
    tried = len(retrieval.headings[i])
    note = f"heading {heading:.0f}°, best of {tried}" if tried > 1 else ""
    cut = TurnedFrame(frame, heading, float(retrieval.cut_shares[i]), retrieval.pixels)
    return Picture(file, i, frame.name, note=note, cut=cut)


def _gallery(basemap: Map, retrieval: MapRetrieval, root: Path) -> list[Picture]:
    """Return windows as pictures, named by their centre in metres from the map's origin, and by their side if it varies."""
    first, several = len(retrieval.headings), len(set(retrieval.sizes.tolist())) > 1
    return [
        Picture(
            root / "windows" / str(j),
            first + j,
            describe_place(window, several),
            cut=WindowCut(basemap, window, retrieval.pixels),
            caption=caption_of(window),
        )
        for j, window in enumerate(retrieval.windows)
    ]


def _descriptors(retrieval: MapRetrieval, turns: list[int]) -> Float32Array:
    """Return the descriptor of each frame at its turn, (Q, n, D); 0 for an unreadable frame."""
    descriptors = np.zeros((len(turns), *retrieval.windows_described.shape[1:]), np.float32)
    for i, turn in enumerate(turns):
        if (described := retrieval.frames_described[i]) is not None:
            descriptors[i] = described[turn]
    return descriptors


def _truth(located: LocatedFlight, retrieval: MapRetrieval) -> list[Truth]:
    none = np.zeros(0, np.int64)
    others: dict[float, Int64Array] = {}
    truth = []
    for i, place in enumerate(located.photographed):
        level = float(retrieval.levels[i])
        if math.isnan(level):
            eligible, junk = np.ones(len(retrieval.windows), bool), none
        else:
            eligible = retrieval.sizes == level
            junk = others.setdefault(level, np.flatnonzero(~eligible))
        if place is None or i in retrieval.broken:
            truth.append(Truth(none, junk, known=False))
            continue
        holds = np.all(np.abs(retrieval.places - place) <= retrieval.sizes[:, None] / 2, axis=1)
        truth.append(Truth(np.flatnonzero(eligible & holds), junk))
    return truth


def _geometry(located: LocatedFlight, retrieval: MapRetrieval) -> GalleryGeometry:
    degrees = located.basemap.frame.degrees
    tiles = [
        Position(float(latitude), float(longitude), width=float(size))
        for (latitude, longitude), size in zip(degrees(retrieval.places), retrieval.sizes, strict=True)
    ]
    middle = (retrieval.places.min(axis=0) + retrieval.places.max(axis=0)) / 2
    latitude, longitude = (float(value) for value in degrees([middle])[0])
    positions = [
        _position(located, frame.frame, place, float(level))
        for frame, place, level in zip(located.frames, located.photographed, retrieval.levels, strict=True)
    ]
    width = float(np.median(retrieval.sizes))
    return GalleryGeometry(positions, tiles, Position(latitude, longitude), retrieval.places - middle, width)


def _position(located: LocatedFlight, frame: Frame, place: Float64Array | None, level: float) -> Position | None:
    """Return a position above the photographed place, for a north-up picture as wide as the compared windows."""
    if place is None:
        return None
    latitude, longitude = (float(value) for value in located.basemap.frame.degrees([place])[0])
    height = frame.flying_height
    if height is None or height <= 0 or math.isnan(level):
        return Position(latitude, longitude)
    fov = 2 * math.degrees(math.atan(level / 2 / height))
    return Position(latitude, longitude, altitude=height, heading=0.0, fov=fov, width=level)


def _columns(located: LocatedFlight, retrieval: MapRetrieval, turns: list[int]) -> list[Column]:
    frames = [one.frame for one in located.frames]
    times = located.flight.times
    since = times - np.nanmin(times) if np.isfinite(times).any() else times
    columns = [
        _numbers("seconds", since.tolist(), "s"),
        _numbers("altitude", [frame.flying_height for frame in frames], "m"),
        _numbers("heading", [retrieval.headings[i][turn] for i, turn in enumerate(turns)], "°"),
        _numbers("pitch", [frame.pitch for frame in frames], "°"),
        _numbers("roll", [frame.roll for frame in frames], "°"),
    ]
    sources = [
        str(frame.heading_source) if heading_is_certain(frame) else f"best of {len(retrieval.headings[i])}"
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
