"""Calibrate on pictures without labels: the zoom at which drone pictures and tiles show the same ground, and each view's mean.

A drone's picture shows more ground than its tile, or less, by its height and lens. For the ratio r of both, the middle 1/r of
a drone picture is compared with whole tiles (r >= 1), or whole drone pictures with the middle r of the tiles (r < 1).
Pictures at one scale have nearer neighbours. So the ratio of all is the one with the greatest mean over drone pictures of

    s(r) = max over tiles t of <q(r), t>,

for descriptors from which the mean of their view at this zoom is subtracted. Then each drone picture takes the k that maximises
s(r STEP^k) - PRIOR k^2, k = -2 .. 2. No label enters.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lpn import descriptors
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, Int64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors.transforms import UNCHANGED, Change
from lpn.models.base import Model, normalise

# The factor between tried ratios.
STEP = 2**0.25
# What one step from the ratio of all costs in cosine, so that a weak network does not follow its noise.
PRIOR = 0.02
# Steps from 1 that the ratio of all may have, and from it that of one picture.
_MOST_STEPS, _OWN_STEPS = 8, 2
# Pictures of a view that a mean needs, and that the ratio of all is chosen by at most.
MIN_PICTURES = 20
_MOST_DRONES, _MOST_TILES = 200, 1000
_SEED = 0


@dataclass(frozen=True, eq=False)
class Level:
    """One zoom that a drone picture may have.

    Attributes:
        zoom: see `Picture.zoom`.
        cost: what a picture's cosine at this zoom must gain.
        mean: of all drone pictures at this zoom, (n, D).
    """

    zoom: float
    cost: float
    mean: Float32Array


@dataclass(frozen=True, eq=False)
class Calibration:
    """Zooms and means that make up for pictures unlike those of the training.

    Attributes:
        means: the mean descriptor of each view at the zoom of its pictures, (n, D).
        zooms: the zoom of each picture by its file; 1 for others.
        tried: mean of s(r) by the ratio r, see this module; empty if the views are not those of drone and satellite.
        ratio: the ratio of all.
        levels: the zooms that a drone picture may have; empty without ratios.
        tiles: descriptors of tiles, (T, n, D), that the zoom of one's own picture is chosen by.
    """

    means: Mapping[View, Float32Array]
    zooms: Mapping[View, Mapping[Path, float]]
    tried: Mapping[float, float]
    ratio: float
    levels: Sequence[Level]
    tiles: Float32Array

    def pictures(self, view: View, pictures: Sequence[Picture]) -> list[Picture]:
        """Return the pictures with their zoom, which a note tells."""
        zooms = self.zooms[view]
        return [
            replace(picture, zoom=zooms.get(picture.path, 1.0), note=_note(picture, zooms.get(picture.path, 1.0)))
            for picture in pictures
        ]

    def read(
        self,
        model: Model,
        pictures: Sequence[Picture],
        view: View,
        read: descriptors.Reader = descriptors.cached_descriptors,
        change: Change = UNCHANGED,
    ) -> Float32Array:
        """Return the calibrated descriptors of changed pictures, (N, n, D)."""
        zooms = np.array([self.zooms[view].get(picture.path, 1.0) for picture in pictures])
        found = np.zeros((len(pictures), model.n_parts, model.embedding), np.float32)
        for zoom in np.unique(zooms):
            rows = np.flatnonzero(zooms == zoom)
            some = [pictures[row] for row in rows.tolist()]
            found[rows] = read(model, some, view, replace(change, scale=change.scale * float(zoom)))
        return normalise(found - self.means[view])

    def stored(self, model: Model, pictures: Sequence[Picture], view: View) -> descriptors.StoredDescriptors:
        """Return the calibrated descriptors of pictures from the user's cache, and their digest."""
        found = self.read(model, pictures, view)
        return descriptors.StoredDescriptors(found, hashlib.sha256(found.tobytes()).hexdigest())

    def applied(self, model: Model) -> Model:
        """Return the model that subtracts the means; contributions stay exact, with the length of the mean's term held."""
        return model.centred(self.means)

    def own_zoom(self, model: Model, picture: UInt8Array, view: View) -> float:
        """Return the zoom of one's own picture (H, W, 3), that of a drone chosen as for the others; `model` may be calibrated."""
        if view != "drone" or not self.levels:
            return next(iter(self.zooms[view].values()))
        plain, best, most = model.centred({}), 1.0, -np.inf
        for level in self.levels:
            prepared = plain.prepare(images.zoom(picture, level.zoom), "drone")
            described = plain.descriptors(prepared[None], "drone")
            value = float(_nearest(normalise(described - level.mean), self.tiles)[0]) - level.cost
            if value > most:
                best, most = level.zoom, value
        return best

    def describe(self) -> str:
        """Return the calibration as a clause: "calibrated without labels on ... pictures, ..."."""
        counts = " and ".join(f"{len(zooms):,} {view}" for view, zooms in self.zooms.items())
        zoomed = [
            f"{view} pictures zoomed by {min(found):.2f}" + (f" to {max(found):.2f}" if len(found) > 1 else "")
            for view, zooms in self.zooms.items()
            if (found := set(zooms.values())) != {1.0}
        ]
        return ", ".join(
            [f"calibrated without labels on {counts} pictures", *zoomed, "the mean of each view subtracted"]
        )

    def to_dict(self) -> dict[str, Any]:
        """The calibration as JSON values, without the means: pictures by zoom, and s(r) by ratio."""
        counts = {
            view: {f"{zoom:.3f}": count for zoom, count in zip(*_counts(zooms), strict=True)}
            for view, zooms in self.zooms.items()
        }
        tried = {f"{ratio:.3f}": value for ratio, value in sorted(self.tried.items())}
        return {"ratio": self.ratio, "tried": tried, "pictures": counts}


def calibrate(
    model: Model,
    pictures: Mapping[View, Sequence[Picture]],
    read: descriptors.Reader = descriptors.cached_descriptors,
) -> Calibration:
    """Choose the zoom of drone pictures and tiles, and take the mean descriptor of each view.

    The ratio of all is sought from 1 in steps of 2^(1/4), as long as one of two steps is better, within a factor of 4, by at most
    200 drone pictures and 1,000 tiles. All drone pictures are described at up to five zooms then. Views other than drone and
    satellite, panoramas, and unrolled tiles keep their zoom.

    Args:
        model: see `Model.for_task`.
        pictures: of each view, those that are searched with and those that are searched; equal files count once.

    Raises:
        InputError: if there are not two views, one has fewer than 20 pictures, or the model lacks one.
    """
    if len(pictures) != 2:
        raise InputError(
            f"A calibration compares two views, and the pictures are of {' and '.join(pictures)}; choose a task of two views, or "
            "leave --calibrate out."
        )
    pictures = {
        view: list({picture.path: picture for picture in of_view}.values()) for view, of_view in pictures.items()
    }
    for view, of_view in pictures.items():
        model.check_view(view)
        if len(of_view) < MIN_PICTURES:
            raise InputError(
                f"A calibration takes the mean of each view's descriptors, and there are {len(of_view)} {view} pictures; "
                f"expected {MIN_PICTURES} or more, so leave --calibrate out."
            )
    if not _comparable(model, pictures):
        means = {view: read(model, of_view, view, UNCHANGED).mean(axis=0) for view, of_view in pictures.items()}
        zooms = {view: dict.fromkeys((one.path for one in of_view), 1.0) for view, of_view in pictures.items()}
        return Calibration(means, zooms, {}, 1.0, (), np.zeros((0, model.n_parts, model.embedding), np.float32))
    of_all, tried = _step_of_all(model, pictures, read)
    of_tiles, own = STEP ** max(-of_all, 0), max(of_all, 0)
    tiles = read(model, pictures["satellite"], "satellite", Change(scale=of_tiles))
    of_satellite = tiles.mean(axis=0)
    tiles = normalise(tiles - of_satellite)
    steps = [step for step in range(-_OWN_STEPS, _OWN_STEPS + 1) if own + step >= 0]
    found = [read(model, pictures["drone"], "drone", Change(scale=STEP ** (own + step))) for step in steps]
    levels = [
        Level(STEP ** (own + step), PRIOR * step**2, described.mean(axis=0))
        for step, described in zip(steps, found, strict=True)
    ]
    values = [
        _nearest(normalise(described - level.mean), tiles) - level.cost
        for described, level in zip(found, levels, strict=True)
    ]
    chosen: Int64Array = np.stack(values).argmax(axis=0)
    taken = np.stack([found[level][row] for row, level in enumerate(chosen)])
    zooms = {
        "satellite": dict.fromkeys((picture.path for picture in pictures["satellite"]), of_tiles),
        "drone": {picture.path: levels[level].zoom for picture, level in zip(pictures["drone"], chosen, strict=True)},
    }
    return Calibration(
        {"satellite": of_satellite, "drone": taken.mean(axis=0)},
        {view: zooms[view] for view in pictures},
        tried,
        STEP**of_all,
        levels,
        _sample(tiles, _MOST_TILES),
    )


def _comparable(model: Model, pictures: Mapping[View, Sequence[Picture]]) -> bool:
    """Return whether both views show ground from above, so that a zoom makes sense."""
    flat = not any(picture.panorama for of_view in pictures.values() for picture in of_view)
    return set(pictures) == {"drone", "satellite"} and flat and not any(map(model.contract.unrolled, pictures))


def _step_of_all(
    model: Model, pictures: Mapping[View, Sequence[Picture]], read: descriptors.Reader
) -> tuple[int, dict[float, float]]:
    """Return the power of STEP with the nearest neighbours, and the mean cosine at each tried ratio."""
    drones, tiles = _sample(pictures["drone"], _MOST_DRONES), _sample(pictures["satellite"], _MOST_TILES)
    tried: dict[float, float] = {}

    def value(step: int) -> float:
        ratio = STEP**step
        if ratio not in tried:
            query = read(model, drones, "drone", Change(scale=STEP ** max(step, 0)))
            gallery = read(model, tiles, "satellite", Change(scale=STEP ** max(-step, 0)))
            query, gallery = (normalise(side - side.mean(axis=0)) for side in (query, gallery))
            tried[ratio] = float(_nearest(query, gallery).mean())
        return tried[ratio]

    best = 0
    for direction in (1, -1):
        step, behind = direction, 0
        # One step may be worse by chance.
        while behind < 2 and abs(step) <= _MOST_STEPS:
            best, behind = (step, 0) if value(step) > value(best) else (best, behind + 1)
            step += direction
    return best, tried


def _sample(values: Any, most: int) -> Any:
    """Return at most so many of a sequence or an array's rows, in their order."""
    if len(values) <= most:
        return values
    rows = np.sort(np.random.default_rng(_SEED).choice(len(values), most, replace=False))
    return values[rows] if isinstance(values, np.ndarray) else [values[row] for row in rows]


def _nearest(query: Float32Array, gallery: Float32Array) -> Float64Array:
    """Return the cosine of each query (Q, n, D) with the nearest of a gallery (G, n, D), (Q,)."""
    flat = gallery.reshape(len(gallery), -1).T
    # Blocks of queries, as the product of 10^5 with 10^5 would fill the memory.
    return np.concatenate(
        [(block.reshape(len(block), -1) @ flat).max(axis=1) for block in np.split(query, range(1000, len(query), 1000))]
    ).astype(np.float64)


def _counts(zooms: Mapping[Path, float]) -> tuple[list[float], list[int]]:
    values, counts = np.unique(list(zooms.values()), return_counts=True)
    return values.tolist(), counts.tolist()


def _note(picture: Picture, zoom: float) -> str:
    return ", ".join(filter(None, (picture.note, f"zoomed by {zoom:.2f}" if zoom != 1 else "")))
