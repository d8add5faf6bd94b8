"""Calibration without labels: the zoom at which drone pictures and tiles show equal ground, and the mean of each view.

Height and lens decide how much more or less ground a drone picture shows than a tile. For their ratio r, the middle 1/r of
a drone picture is compared with whole tiles (r >= 1), or whole drone pictures with the middle r of the tiles (r < 1).
Pictures at equal scale have nearer neighbours. So the common ratio is the one with the greatest mean over drone pictures of
    s(r) = max over tiles t of <q(r), t>,

for descriptors less the mean of their view at this zoom. Then each drone picture takes the k that maximises
s(r STEP^k) - PRIOR k^2, k = -2 .. 2. No label enters.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from lpn import descriptors
from lpn.core import images
from lpn.core.arrays import Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.descriptors.transforms import MAX_SCALE, UNCHANGED, Change
from lpn.models.base import Model, normalise
from lpn.models.contract import Role

# The factor between tried ratios.
STEP = 2**0.25
# The cost, in cosine, of one step from the common ratio; without a cost, a weak network follows its noise.
PRIOR = 0.02
# Bounds in steps: of the common ratio from 1, and of one picture's ratio from the common ratio.
_MOST_STEPS, _OWN_STEPS = 8, 2
# Minimum number of pictures of a view for a mean, and maximum of each view for the choice of the common ratio.
MIN_PICTURES = 20
_MOST_DRONES, _MOST_TILES = 200, 1000
_SEED = 0


@dataclass(frozen=True, eq=False)
class ZoomLevel:
    """One possible zoom of drone pictures.

    Attributes:
        zoom: see `Picture.zoom`.
        cost: subtracted from a picture's cosine at this zoom before zooms are compared.
        mean: of all drone pictures at this zoom, (n, D).
    """

    zoom: float
    cost: float
    mean: Float32Array


@dataclass(frozen=True, eq=False)
class Calibration:
    """Zooms and means that compensate for differences from the training pictures.

    Attributes:
        means: the mean descriptor of each view at the zoom of its pictures, (n, D).
        zooms: the zoom of each picture by its file.
        tried: mean of s(r) by the ratio r, see this module; empty if the views are not drone and satellite.
        ratio: the common ratio.
        levels: the possible zooms of drone pictures; empty without ratios.
        tiles: descriptors of tiles, (T, n, D), for the choice of an uploaded picture's zoom.
    """

    means: Mapping[View, Float32Array]
    zooms: Mapping[View, Mapping[Path, float]]
    tried: Mapping[float, float]
    ratio: float
    levels: Sequence[ZoomLevel]
    tiles: Float32Array

    def pictures(self, view: View, pictures: Sequence[Picture]) -> list[Picture]:
        """Return the pictures with their zoom, and with a note that names it."""
        zooms = self.zooms[view]
        moved = []
        for picture in pictures:
            zoom = zooms[picture.path]
            note = "" if zoom == 1 else f"zoomed by {zoom:.2f}"
            moved.append(replace(picture, zoom=zoom, note=", ".join(filter(None, (picture.note, note)))))
        return moved

    def read(
        self,
        model: Model,
        pictures: Sequence[Picture],
        view: View,
        read: descriptors.Reader = descriptors.cached_descriptors,
        change: Change = UNCHANGED,
    ) -> Float32Array:
        """Return the calibrated descriptors of changed pictures, (N, n, D).

        Raises:
            InputError: if the scale of the change and the zoom of a picture multiply to more than 16.
        """
        zooms = np.array([self.zooms[view][picture.path] for picture in pictures])
        if change.scale * zooms.max(initial=1) > MAX_SCALE:
            raise InputError(
                f"The scale is {change.scale:g}, and the calibration zooms {view} pictures by up to {zooms.max():.3g}; "
                f"expected a scale of at most {MAX_SCALE / zooms.max():.3g}."
            )

        def at(some: Sequence[Picture], zoom: float) -> Float32Array:
            return read(model, some, view, replace(change, scale=change.scale * zoom))

        return normalise(by_zoom(model, pictures, zooms, at) - self.means[view])

    def stored(
        self, model: Model, pictures: Sequence[Picture], view: View, root: Path, role: Role, read: descriptors.Reader
    ) -> Float32Array:
        """Return the calibrated descriptors of queries or gallery: those that ship with `root`, else read."""
        shipped = descriptors.shipped_only(self.applied(model), pictures, view, root, role)
        return self.read(model, pictures, view, read) if shipped is None else shipped

    def applied(self, model: Model) -> Model:
        """Return the model that subtracts the means. Contributions stay exact; the length of the mean's term is held."""
        moved = model.centred(self.means)
        moved.contract = replace(moved.contract, title=f"{moved.contract.title}, calibrated")
        return moved

    def own_zoom(self, model: Model, picture: UInt8Array, view: View) -> float:
        """Return the zoom of an uploaded picture (H, W, 3). For a drone picture it is chosen as in `calibrate`.

        Args:
            model: with or without the calibration.

        Raises:
            InputError: if the calibration has no pictures of the view.
        """
        if view not in self.zooms:
            raise InputError(
                f"The calibration is for {' and '.join(self.zooms)} pictures, and this one is of {view}; change the view."
            )
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
            f"{view} pictures zoomed by {min(factors):.2f}" + (f" to {max(factors):.2f}" if len(factors) > 1 else "")
            for view, zooms in self.zooms.items()
            if (factors := set(zooms.values())) != {1.0}
        ]
        return ", ".join(
            [f"calibrated without labels on {counts} pictures", *zoomed, "the mean of each view subtracted"]
        )

    def to_dict(self) -> dict[str, Any]:
        """The calibration as JSON values, without the means: pictures by zoom, and s(r) by ratio."""
        counts = {
            view: {f"{zoom:.3f}": count for zoom, count in sorted(Counter(zooms.values()).items())}
            for view, zooms in self.zooms.items()
        }
        tried = {f"{ratio:.3f}": value for ratio, value in sorted(self.tried.items())}
        return {"ratio": self.ratio, "tried": tried, "pictures": counts}


def calibrate(
    model: Model,
    lists: Mapping[View, Sequence[Sequence[Picture]]],
    read: descriptors.Reader = descriptors.cached_descriptors,
) -> Calibration:
    """Choose the zoom of drone pictures and tiles, and take the mean descriptor of each view.

    The search for the common ratio goes up and down from 1 in steps of 2^(1/4), to a factor of 4, or until two steps do not help.
    It takes 200 drone pictures and 1,000 tiles at most. Then all drone pictures are described at up to five zooms. Street views,
    panoramas, and unrolled tiles keep their zoom.

    Args:
        model: see `Model.for_task`.
        lists: for each view, its lists of pictures: queries, gallery, or both. They are read one by one; equal files count
            once.

    Raises:
        InputError: if there is only one view, a view has fewer than 20 pictures, or the model lacks a view.
    """
    if len(lists) < 2:
        raise InputError(
            f"A calibration takes the mean of each of two views or more, and all pictures are of {' and '.join(lists)}; leave "
            "--calibrate out."
        )
    sides = _sides(model, lists, read, "A calibration", "leave --calibrate out")
    zooms = {view: dict.fromkeys(side.files, 1.0) for view, side in sides.items()}
    if not _comparable(model, sides):
        means = {view: side.read(0).mean(axis=0) for view, side in sides.items()}
        return Calibration(means, zooms, {}, 1.0, (), np.zeros((0, model.n_parts, model.embedding), np.float32))
    means = {view: side.read(0).mean(axis=0) for view, side in sides.items() if view == "street"}
    of_all, tried = _step_of_all(sides)
    tiles = sides["satellite"].read(max(-of_all, 0))
    means["satellite"] = tiles.mean(axis=0)
    tiles = normalise(tiles - means["satellite"])
    levels: list[ZoomLevel] = []
    drones = sides["drone"]
    best: Float64Array = np.full(len(drones.files), -np.inf)
    chosen, taken = np.zeros(len(best), np.int64), np.zeros((len(best), model.n_parts, model.embedding), np.float32)
    first = max(of_all, 0)
    for step in range(max(-_OWN_STEPS, -first), _OWN_STEPS + 1):
        described = drones.read(first + step)
        level = ZoomLevel(STEP ** (first + step), PRIOR * step**2, described.mean(axis=0))
        value = _nearest(normalise(described - level.mean), tiles) - level.cost
        better = value > best
        taken[better], best[better], chosen[better] = described[better], value[better], len(levels)
        levels.append(level)
    means["drone"] = taken.mean(axis=0)
    zooms["satellite"] = dict.fromkeys(sides["satellite"].files, STEP ** max(-of_all, 0))
    zooms["drone"] = {file: levels[level].zoom for file, level in zip(drones.files, chosen.tolist(), strict=True)}
    return Calibration(means, zooms, tried, STEP**of_all, levels, _sample(tiles, _MOST_TILES))


def ground_ratio(
    model: Model,
    drones: Sequence[Picture],
    tiles: Sequence[Picture],
    read: descriptors.Reader = descriptors.cached_descriptors,
) -> float:
    """Return the common ratio, without labels: the ground's side on drone pictures divided by its side on tiles.

    The search is that of `calibrate`, with at most 200 drone pictures and 1,000 tiles.

    Raises:
        InputError: if there are fewer than 20 pictures of a view, one is not a picture from above, or the model lacks a view.
    """
    model = model.for_task("drone", "satellite")
    sides = _sides(
        model, {"drone": [drones], "satellite": [tiles]}, read, "The ratio of ground", "set ground_ratio yourself"
    )
    if not _comparable(model, sides):
        raise InputError(
            "The ratio of ground is that of drone pictures and whole tiles, and these are panoramas or unrolled; leave it at 1."
        )
    return float(STEP ** _step_of_all(sides)[0])


class _Side:
    """All pictures of a view, with each file once."""

    def __init__(self, model: Model, view: View, lists: Sequence[Sequence[Picture]], read: descriptors.Reader) -> None:
        self._model, self._view, self._lists, self._read = model, view, lists, read
        self.pictures = list({picture.path: picture for of_list in lists for picture in of_list}.values())
        self.files = [picture.path for picture in self.pictures]

    def read(self, step: int) -> Float32Array:
        """Return the descriptors of all files at the zoom STEP^step, (N, n, D), read list by list, as tasks read them."""
        described = np.concatenate([self._described(pictures, step) for pictures in self._lists])
        first: dict[Path, int] = {}
        for row, path in enumerate(picture.path for pictures in self._lists for picture in pictures):
            first.setdefault(path, row)
        return described[[*first.values()]]

    def sample(self, most: int, step: int) -> Float32Array:
        """Return the descriptors of at most `most` pictures, drawn at random, at the zoom STEP^step."""
        return self._described(_sample(self.pictures, most), step)

    def _described(self, pictures: Sequence[Picture], step: int) -> Float32Array:
        return self._read(self._model, pictures, self._view, Change(scale=STEP**step))


def _sides(
    model: Model, lists: Mapping[View, Sequence[Sequence[Picture]]], read: descriptors.Reader, what: str, otherwise: str
) -> dict[View, _Side]:
    """Return the sides of lists; InputError unless the model has each view, and each has enough pictures."""
    sides = {view: _Side(model, view, of_view, read) for view, of_view in lists.items()}
    for view, side in sides.items():
        model.check_view(view)
        if len(side.pictures) < MIN_PICTURES:
            raise InputError(
                f"{what} is measured on {MIN_PICTURES} pictures of each view or more, and there are {len(side.pictures)} {view} "
                f"pictures; {otherwise}."
            )
    return sides


def _comparable(model: Model, sides: Mapping[View, _Side]) -> bool:
    """Return whether two of the views show ground from above, so that a zoom makes sense."""
    above: tuple[View, View] = ("drone", "satellite")
    if any(view not in sides or model.contract.unrolled(view) for view in above):
        return False
    return not any(picture.panorama for view in above for picture in sides[view].pictures)


def _step_of_all(sides: Mapping[View, _Side]) -> tuple[int, dict[float, float]]:
    """Return the power of STEP with the greatest mean cosine of nearest neighbours, and this mean at each tried ratio."""
    drones, tiles, tried = sides["drone"], sides["satellite"], dict[float, float]()

    def value(step: int) -> float:
        ratio = STEP**step
        if ratio not in tried:
            query, gallery = drones.sample(_MOST_DRONES, max(step, 0)), tiles.sample(_MOST_TILES, max(-step, 0))
            tried[ratio] = float(_nearest(centred(query), centred(gallery)).mean())
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
    """Draw at most `most` values of a sequence, or rows of an array, at random with a fixed seed; keep their order."""
    if len(values) <= most:
        return values
    rows = np.sort(np.random.default_rng(_SEED).choice(len(values), most, replace=False))
    return values[rows] if isinstance(values, np.ndarray) else [values[row] for row in rows]


def _nearest(query: Float32Array, gallery: Float32Array) -> Float64Array:
    """Return the cosine of each query (Q, n, D) with its nearest in a gallery (G, n, D), (Q,)."""
    flat = gallery.reshape(len(gallery), -1).T
    # Blocks of queries, because the product of 10^5 with 10^5 would fill the memory.
    return np.concatenate(
        [(block.reshape(len(block), -1) @ flat).max(axis=1) for block in np.split(query, range(1000, len(query), 1000))]
    ).astype(np.float64)


def by_zoom(
    model: Model,
    pictures: Sequence[Picture],
    zooms: Float64Array,
    read: Callable[[Sequence[Picture], float], Float32Array],
) -> Float32Array:
    """Return a model's descriptors of pictures, (N, n, D), read at each of their zooms, (N,)."""
    described = np.zeros((len(pictures), model.n_parts, model.embedding), np.float32)
    for zoom in np.unique(zooms).tolist():
        rows = np.flatnonzero(zooms == zoom)
        described[rows] = read([pictures[row] for row in rows.tolist()], zoom)
    return described


def centred(described: Float32Array) -> Float32Array:
    """Subtract the mean of descriptors (N, n, D) from each of them, part by part, and scale parts to norm 1/sqrt(n) again."""
    return normalise(described - described.mean(axis=0))
