"""The training set: the pictures of each place, and a cache of decoded pictures.

Training uses all views of a place. A place needs at least two, because one alone has nothing to compare.
"""

from __future__ import annotations

import hashlib
import json
import threading
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from lpn.core import images
from lpn.core.arrays import UInt8Array
from lpn.core.consoles import Console
from lpn.core.errors import DataError, InputError
from lpn.core.files import first_few
from lpn.core.views import VIEWS, View, branch_of
from lpn.datasets import Dataset, Folder, Picture
from lpn.datasets.integrity import list_errors, picture_errors

# Size limit of the cache of decoded pictures.
CACHE_BYTES = 2_000_000_000


class Fold(NamedTuple):
    """One held-out part of the places of a training set, for cross-validation.

    Attributes:
        number: from 0.
        folds: the number of parts, which are equal or differ by one place.
        seed: of the split, independent of a recipe's.
    """

    number: int
    folds: int
    seed: int = 0


class Trainable(NamedTuple):
    """The places of a training set, by their labels.

    Attributes:
        places: those to train on, which have pictures of two views.
        left_out: those with pictures of one view alone.
        gaps: for each set, the `places` without a picture in it; a set without such places is absent.
    """

    places: list[int]
    left_out: list[int]
    gaps: dict[str, list[int]]


def trainable(labels: Mapping[str, Collection[int]]) -> Trainable:
    """Return the places that can be trained on, by the labels of each set (satellite, drone, street, google).

    Pictures of google are of the street view.
    """
    views: dict[int, set[View]] = {}
    for name, of in labels.items():
        for label in of:
            views.setdefault(label, set()).add(branch_of(name))
    places = sorted(label for label, of_place in views.items() if len(of_place) > 1)
    gaps = {name: sorted(set(places).difference(of)) for name, of in labels.items()}
    return Trainable(places, sorted(set(views).difference(places)), {name: of for name, of in gaps.items() if of})


class TrainingSet:
    """The training pictures: for each set (satellite, drone, street, google), the files of each place.

    Broken pictures (see `lpn.datasets.integrity`) are left out, with one message. The places that
    `trainable` leaves out are named.

    Args:
        names: the sets to train on, see `Recipe.sets`.

    Attributes:
        labels: label of each place.
        files: for each set, the files of each place, possibly none.
        panoramas: True if the street pictures cover the full circle.

    Raises:
        DataError: when there are no satellite pictures, there are neither drone nor street pictures, or no place has
            pictures of two views.
    """

    def __init__(self, dataset: Dataset, console: Console, names: Sequence[str] = (*VIEWS, "google")) -> None:
        if isinstance(dataset, Folder):
            raise dataset.no_task()
        sets = {name: dataset.train(name) for name in (*VIEWS, "google") if name in names}
        if sets.get("google") and not sets.get("street"):
            del sets["google"]
            console.print(
                "train/google is left out: its pictures train the street branch, and there is no train/street."
            )
        by_place = _by_place(sets, dataset.root, console)
        if "satellite" not in by_place or not {"drone", "street"} & set(by_place):
            listed = ", ".join(f"train/{name}" for name in by_place)
            raise DataError(
                f"{dataset.root.name} has {f'pictures in {listed}' if listed else 'no pictures to train on'}; training needs "
                "train/satellite and at least one of train/drone, train/street, as in University-1652, or such pictures in lines "
                "of a pairs.csv with the split train."
            )
        training_places = trainable(by_place)
        if not training_places.places:
            raise DataError(
                f"No place of {dataset.root.name} has pictures in two of {', '.join(by_place)}; nothing to train on."
            )
        if training_places.left_out:
            views = [name for name in by_place if name != "google"]
            lacking = "one" if len(views) == 2 else "all but one"
            console.print(
                f"Places left out, without a picture in {lacking} of {', '.join(views)}: {named(training_places.left_out)}.",
                soft_wrap=True,
            )
        for name, without in training_places.gaps.items():
            console.print(
                f"Places without a picture in {name}, trained on in their other views: {named(without)}.",
                soft_wrap=True,
            )
        self.labels = training_places.places
        self.files = _filled(
            {name: [places.get(label, []) for label in self.labels] for name, places in by_place.items()}
        )
        self.panoramas, self.root = dataset.panoramas, dataset.root
        self._cache: dict[Path, UInt8Array] = {}
        self._cache_bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self.labels)

    @property
    def views(self) -> tuple[View, ...]:
        """The trained views."""
        return tuple(view for view in VIEWS if view in self.files)

    def digest(self) -> str:
        """Hash the list of training pictures: a run can be resumed only on an equal list."""
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
        total = len(self)
        if isinstance(share, Fold):
            if not 2 <= share.folds <= total // 2:
                raise InputError(
                    f"The number of folds is {share.folds}; expected 2 or more, with at least 2 of the {total} places in each."
                )
            order = np.random.default_rng([share.seed, total]).permutation(total)
            out = sorted(np.array_split(order, share.folds)[share.number])
        else:
            count = round(share * total) if 0 <= share < 1 else 0
            if share and not 2 <= count <= total - 2:
                raise InputError(
                    f"The share of places held out is {share:g}, {count} of {total} places; expected 0, or a share that holds "
                    "out at least 2 places and leaves at least 2 in training."
                )
            out = sorted(np.random.default_rng([seed, total]).permutation(total)[:count])
        rest = sorted(set(range(total)).difference(out))
        held = {self.labels[i]: {name: places[i] for name, places in self.files.items()} for i in out}
        self.labels = [self.labels[i] for i in rest]
        self.files = _filled({name: [places[i] for i in rest] for name, places in self.files.items()})
        return held

    def drawn_from(self) -> dict[str, list[list[Path]]]:
        """Return `files` for batches: pictures of google replace missing ones of the street, and the reverse.

        A place then lacks at most one view.
        """
        if not {"street", "google"} <= set(self.files):
            return self.files
        pairs = list(zip(self.files["street"], self.files["google"], strict=True))
        return {
            **self.files,
            "street": [own or other for own, other in pairs],
            "google": [own or other for other, own in pairs],
        }

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


def _filled(files: dict[str, list[list[Path]]]) -> dict[str, list[list[Path]]]:
    """Return the sets that have any pictures."""
    return {name: places for name, places in files.items() if any(places)}


def _by_place(sets: Mapping[str, Sequence[Picture]], root: Path, console: Console) -> dict[str, dict[int, list[Path]]]:
    """Return the files of each place in each set, without broken pictures, emptied places, and emptied sets."""
    files = [picture.path for pictures in sets.values() for picture in pictures]
    if broken := picture_errors(files):
        console.print(
            f"{len(broken)} of {len(files)} training pictures cannot be used and are left out: {list_errors(broken, root)}.",
            markup=False,
        )
    by_place: dict[str, dict[int, list[Path]]] = {}
    for name, pictures in sets.items():
        for picture in pictures:
            if picture.path not in broken:
                by_place.setdefault(name, {}).setdefault(picture.label, []).append(picture.path)
    return by_place


def named(labels: Sequence[int]) -> str:
    """Return the first few places by their numbers, and the number of further ones."""
    return first_few([f"{label:04d}" for label in labels], 12)


def paired_pictures(held: Mapping[int, Mapping[str, Sequence[Path]]]) -> dict[View, list[Picture]]:
    """Return the drone pictures of places, or else their street pictures, and the tiles of these places.

    Args:
        held: the files of each set of each place, see `TrainingSet.hold_out`.

    Raises:
        InputError: if no place has both.
    """
    views: tuple[View, ...] = ("drone", "street")
    for view in views:
        both = {label: sets for label, sets in held.items() if sets.get(view) and sets.get("satellite")}
        if both:
            pair: tuple[View, ...] = (view, "satellite")
            return {
                name: [Picture(file, label, file.name) for label, sets in both.items() for file in sets[name]]
                for name in pair
            }
    raise InputError("No place that is held out has a drone or street picture and a tile; hold out more of them.")
