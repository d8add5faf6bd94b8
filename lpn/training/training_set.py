"""The training set: the pictures of each place, and a cache of decoded pictures."""

from __future__ import annotations

import hashlib
import json
import threading
from pathlib import Path
from typing import NamedTuple

import numpy as np
from rich.console import Console

from lpn.core import images
from lpn.core.arrays import Int64Array, UInt8Array
from lpn.core.errors import DataError, InputError
from lpn.core.views import VIEWS, View
from lpn.datasets import Dataset, Picture
from lpn.datasets.integrity import list_errors, picture_errors

# Size limit of the cache of decoded pictures.
CACHE_BYTES = 2_000_000_000


class Fold(NamedTuple):
    """One part of the places of a training set, which is held out of a cross-validation's training.

    Attributes:
        number: from 0.
        folds: the number of parts; they have the same size, or differ by one place.
        seed: of the split, which has nothing to do with a recipe's.
    """

    number: int
    folds: int
    seed: int = 0


class TrainingSet:
    """The training pictures: for each set (satellite, drone, street, google), the files of each place.

    Broken pictures (see `lpn.datasets.integrity`) are left out, with one message.

    Attributes:
        labels: label of each place.
        files: for each set, the files of each place.
        views: the views that are trained.
        panoramas: True if the street pictures cover the full circle.

    Raises:
        DataError: when there are no satellite pictures, there are neither drone nor street pictures, or no place has a
            picture in every set present.
    """

    def __init__(self, dataset: Dataset, console: Console, google: bool = True) -> None:
        sets = {name: dataset.train(name) for name in (*VIEWS, *(["google"] if google else []))}
        by_place = {name: _by_label(pictures) for name, pictures in sets.items() if pictures}
        if "google" in by_place and "street" not in by_place:
            del by_place["google"]
            console.print(
                "train/google is left out: its pictures train the street branch, and there is no train/street."
            )
        if "satellite" not in by_place or not {"drone", "street"} & set(by_place):
            found = ", ".join(f"train/{name}" for name in by_place) or "none"
            raise DataError(
                f"{dataset.root.name} has pictures in {found}; training needs train/satellite and at least one of "
                "train/drone, train/street, as in University-1652."
            )
        _leave_out_broken(by_place, dataset.root, console)
        everywhere = set.intersection(*(set(places) for places in by_place.values()))
        incomplete = sorted(set.union(*(set(places) for places in by_place.values())) - everywhere)
        if incomplete:
            some = ", ".join(f"{label:04d}" for label in incomplete[:5])
            console.print(
                f"{len(incomplete)} places lack a picture in one of {', '.join(by_place)} and are left out: {some}."
            )
        if not everywhere:
            raise DataError(
                f"No place of {dataset.root.name} has a picture in all of {', '.join(by_place)}; nothing to train on."
            )
        self.labels = sorted(everywhere)
        self.files = {name: [places[label] for label in self.labels] for name, places in by_place.items()}
        self.views: tuple[View, ...] = tuple(view for view in VIEWS if view in by_place)
        self.panoramas = dataset.panoramas
        self.root = dataset.root
        self._cache: dict[Path, UInt8Array] = {}
        self._cache_bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.labels)

    def digest(self) -> str:
        """Hash the list of training pictures: a run can be resumed only on the same list."""
        names = {
            name: [[str(file.relative_to(self.root)) for file in place] for place in s]
            for name, s in self.files.items()
        }
        return hashlib.sha256(json.dumps(names, sort_keys=True).encode()).hexdigest()

    def hold_out(self, share: float | Fold, seed: int) -> dict[int, dict[str, list[Path]]]:
        """Remove a share of the places from the training set, chosen by the seed, or the places of a fold.

        Returns:
            The removed places: label -> set -> files.

        Raises:
            InputError: unless the share is 0, or holds out at least 2 places and leaves at least 2.
        """
        if isinstance(share, Fold):
            return self._remove(self._of_fold(share))
        count = round(share * len(self)) if 0 <= share < 1 else 0
        if share and not 2 <= count <= len(self) - 2:
            raise InputError(
                f"The share of places held out is {share:g}, {count} of {len(self)} places; expected 0, or a "
                "share that holds out at least 2 places and leaves at least 2 in training."
            )
        return self._remove(np.random.default_rng([seed, len(self)]).permutation(len(self))[:count])

    def _of_fold(self, fold: Fold) -> Int64Array:
        if not 2 <= fold.folds <= len(self) // 2:
            raise InputError(
                f"The number of folds is {fold.folds}; expected 2 or more, with at least 2 of the {len(self)} places in each."
            )
        order = np.random.default_rng([fold.seed, len(self)]).permutation(len(self))
        return np.array_split(order, fold.folds)[fold.number]

    def _remove(self, places: Int64Array) -> dict[int, dict[str, list[Path]]]:
        out = sorted(places)
        rest = sorted(set(range(len(self))).difference(out))
        held = {self.labels[i]: {name: places[i] for name, places in self.files.items()} for i in out}
        self.labels = [self.labels[i] for i in rest]
        self.files = {name: [places[i] for i in rest] for name, places in self.files.items()}
        return held

    def pictures(self) -> dict[str, list[tuple[Path, int]]]:
        """List all pictures of each set, each with the class of its place."""
        return {
            name: [(file, number) for number, place in enumerate(places) for file in place]
            for name, places in self.files.items()
        }

    def picture(self, path: Path) -> UInt8Array:
        """Decode a picture, or take it from the cache; thread-safe."""
        cached = self._cache.get(path)
        if cached is not None:
            return cached
        picture = images.load_picture(path)
        with self._lock:
            if path not in self._cache and self._cache_bytes + picture.nbytes < CACHE_BYTES:
                self._cache[path] = picture
                self._cache_bytes += picture.nbytes
        return picture


def _leave_out_broken(by_place: dict[str, dict[int, list[Path]]], root: Path, console: Console) -> None:
    """Remove broken pictures from each set, and places without any picture left."""
    files = [file for places in by_place.values() for of_place in places.values() for file in of_place]
    broken = picture_errors(files)
    if not broken:
        return
    console.print(
        f"{len(broken)} of {len(files)} training pictures cannot be used and are left out: {list_errors(broken, root)}.",
        markup=False,
    )
    for places in by_place.values():
        for label, of_place in list(places.items()):
            places[label] = [file for file in of_place if file not in broken]
            if not places[label]:
                del places[label]


def _by_label(pictures: list[Picture]) -> dict[int, list[Path]]:
    places: dict[int, list[Path]] = {}
    for picture in pictures:
        places.setdefault(picture.label, []).append(picture.path)
    return places
