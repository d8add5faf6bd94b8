"""Poses of all photos of AnyVisLoc or OrthoLoC against the exact ones, summarised as the released protocols do.

OrthoLoC   each photo over the orthophoto of its own sample, with the exact field of view and no other prior; median errors of
           position in space and of rotation among the poses, and the share of all photos within both of two thresholds
           (ortholoc/benchmarking/benchmark.py at d931732)
AnyVisLoc  each photo over its scene's map, with the exact heading, pitch, and height (pose_priori yp); errors in the plane, and
           the share of all photos within a radius (run_avl.py at ec73927)
"""

from __future__ import annotations

import hashlib
import json
import re
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec
import numpy as np

from lpn.core.errors import DataError
from lpn.core.files import cache_folder, printable
from lpn.core.posed_samples import SampleFolder, SampleLayout, references
from lpn.flights import make_flight
from lpn.locate.ground import MapFeatures
from lpn.locate.line_records import LineRecords
from lpn.locate.located import LocatedFlight, LocatedFrame
from lpn.locate.matchers import open_matchers
from lpn.locate.options import LocateOptions
from lpn.locate.pose_errors import pose_errors
from lpn.locate.registered_stage import FORMAT, register_frame
from lpn.maps import Map, MapOptions
from lpn.maps.posed_scenes import build_scene

_FORMAT = "lpn-poses/1"
# Metres and degrees that count together, and metres alone.
THRESHOLDS = ((0.1, 1.0), (0.25, 2.0), (0.5, 5.0), (2.0, 2.0), (3.0, 3.0), (5.0, 5.0), (5.0, 10.0))
RADII = (1.0, 3.0, 5.0, 10.0, 20.0)
_DOMAIN = re.compile(r"(?:^|_)(R|xDOPDSM|xDOP|xDSM)\d*$")


class MeasuredPhoto(msgspec.Struct, frozen=True):
    """A photo and the errors of its pose.

    Attributes:
        name: of the photo.
        group: its domain shift in OrthoLoC (R, xDOP, xDOPDSM), or its scene in AnyVisLoc.
        metres: from the exact place, in space or, for AnyVisLoc, in the plane; None without a pose.
        degrees: of the rotation between both; None without a pose, NaN where the exact roll is unknown.
        reason: why there is no pose; "" with one.
    """

    name: str
    group: str
    metres: float | None
    degrees: float | None
    reason: str


@dataclass(frozen=True)
class PoseSummary:
    """The protocol's figures of a group of photos.

    Attributes:
        group: its name.
        photos, poses: their numbers.
        metres, degrees: median errors of the poses; NaN without any.
        within: percent of all photos within each threshold, by its name.
    """

    group: str
    photos: int
    poses: int
    metres: float
    degrees: float
    within: dict[str, float]


def measure(
    folders: Sequence[SampleFolder],
    reference: str = "aerial",
    limit: int | None = None,
    options: LocateOptions | None = None,
    on_progress: Callable[[int, int], None] = lambda *_: None,
) -> list[MeasuredPhoto]:
    """Register the photos of folders, each by itself over its own map; maps and pictures are not kept.

    Answers are kept in the user's cache, so a run that was killed goes on where it stopped.

    Args:
        reference: aerial or satellite, the map of AnyVisLoc's scenes.
        limit: the first so many photos of each folder; None for all.
        on_progress: called with the number of photos that are done, and of all.

    Raises:
        DataError: if a scene lacks that map, or its files are damaged.
    """
    options = options or LocateOptions()
    chosen = [(one, one.samples[:limit]) for one in folders if one.samples]
    total = sum(len(samples) for _, samples in chosen)
    names = [matcher.name for matcher in open_matchers(options.matcher)]
    measured: list[MeasuredPhoto] = []
    for folder, samples in chosen:
        key = [_FORMAT, FORMAT, folder.layout, str(folder.folder.resolve()), reference, names]
        digest = hashlib.sha256(json.dumps(key).encode()).hexdigest()[:24]
        records = LineRecords(cache_folder() / "locate" / "poses" / f"{digest}.jsonl", MeasuredPhoto)
        # The photos of a scene share a map, which is made once; a sample of OrthoLoC has its own.
        with TemporaryDirectory(prefix="lpn-poses-") as work:
            scene: _Searched | None = None
            for sample in samples:
                identity = _identity(sample)
                photo = records.get(identity)
                if photo is None:
                    try:
                        searched = scene or _map_of(folder, sample, reference, options, Path(work))
                        scene = searched if folder.layout == "AnyVisLoc" else None
                        photo = _measured(folder, sample, searched, options, Path(work))
                    except _SampleError as error:
                        photo = MeasuredPhoto(sample.stem, _group(folder, sample), None, None, str(error))
                    records.append(identity, photo)
                measured.append(photo)
                on_progress(len(measured), total)
    return measured


def summarise(layout: SampleLayout, photos: Sequence[MeasuredPhoto]) -> list[PoseSummary]:
    """Return the figures of each group, and of all photos where there are several groups."""
    groups = sorted({photo.group for photo in photos})
    of_groups = [(group, [photo for photo in photos if photo.group == group]) for group in groups]
    return [_summary(layout, *one) for one in [*of_groups, *([("all", list(photos))] if len(groups) > 1 else [])]]


def _summary(layout: SampleLayout, group: str, photos: Sequence[MeasuredPhoto]) -> PoseSummary:
    metres, degrees = (
        np.array([np.nan if value is None else value for value in values], np.float64)
        for values in ([photo.metres for photo in photos], [photo.degrees for photo in photos])
    )
    posed = ~np.isnan(metres)
    if layout == "AnyVisLoc":
        within = {f"<= {radius:g} m": float((metres <= radius).mean()) for radius in RADII}
    else:
        within = {f"{m:g} m, {a:g}°": float(((metres < m) & (degrees < a)).mean()) for m, a in THRESHOLDS}
    known = degrees[posed & ~np.isnan(degrees)]
    return PoseSummary(
        group,
        len(photos),
        int(posed.sum()),
        float(np.median(metres[posed])) if posed.any() else float("nan"),
        float(np.median(known)) if len(known) else float("nan"),
        {name: 100 * share for name, share in within.items()},
    )


@dataclass(frozen=True, eq=False)
class _Searched:
    """A map, and its features by each matcher."""

    basemap: Map
    features: list[MapFeatures]


class _SampleError(Exception):
    """A sample that cannot be read; the message says why."""


def _map_of(folder: SampleFolder, sample: Path, reference: str, options: LocateOptions, work: Path) -> _Searched:
    """Return the map of a photo."""
    place = sample
    if folder.layout == "AnyVisLoc":
        known = references(folder.folder)
        if reference not in known:
            raise DataError(
                f"{printable(str(folder.folder))} has no {reference} map; it has {' and '.join(map(printable, known)) or 'none'}."
            )
        place = folder.folder / known[reference].map_path
    out = work / "map"
    shutil.rmtree(out, ignore_errors=True)
    try:
        basemap = build_scene(place, out, MapOptions())
    except DataError as error:
        if folder.layout == "AnyVisLoc":
            raise
        raise _SampleError(str(error)) from error
    if basemap is None:
        raise _SampleError(f"{printable(str(place))} lacks arrays of OrthoLoC; download it again.")
    return _Searched(
        basemap, [MapFeatures(basemap, matcher, on_disk=False) for matcher in open_matchers(options.matcher)]
    )


def _measured(
    folder: SampleFolder, sample: Path, searched: _Searched, options: LocateOptions, work: Path
) -> MeasuredPhoto:
    """Register a photo, and compare its pose with the exact one."""
    group, basemap = _group(folder, sample), searched.basemap
    try:
        flight = make_flight([sample], work / "flight")
    except DataError as error:
        raise _SampleError(str(error)) from error
    (frame,) = flight.frames
    located = LocatedFrame(frame, basemap.frame.xy(*flight.degrees.T)[0])
    answer = register_frame(basemap, searched.features, located, options, [], [], None)
    located.stages["registration"] = answer
    errors = pose_errors(LocatedFlight(flight, basemap, [located], None, [], None))
    frame.file.unlink()
    if errors is None or not errors.poses:
        return MeasuredPhoto(sample.stem, group, None, None, answer.sentence)
    return MeasuredPhoto(sample.stem, group, float(errors.position[0]), float(errors.turn[0]), "")


def _group(folder: SampleFolder, sample: Path) -> str:
    """Return the domain shift of a sample of OrthoLoC, or the scene of one of AnyVisLoc."""
    if folder.layout == "AnyVisLoc":
        return folder.folder.name
    domain = _DOMAIN.search(sample.stem)
    return domain[1] if domain else "R"


def _identity(sample: Path) -> str:
    """Return what tells a sample from another: its name, size, and time of change."""
    stat = sample.stat()
    return f"{sample.name} {stat.st_size} {stat.st_mtime_ns}"
