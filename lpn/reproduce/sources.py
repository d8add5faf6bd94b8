"""The data sets of a reproduction by role, and digests of their pictures."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

from lpn.core.consoles import Console
from lpn.core.errors import InputError
from lpn.core.views import views_of
from lpn.datasets import Dataset, Picture, open_dataset
from lpn.datasets.integrity import check_test_split, lists_of
from lpn.datasets.rendered import is_rendered
from lpn.reproduce.tables import DataRole, Measure
from lpn.training.training_set import TrainingSet

# The tasks of each measure.
TASKS: dict[Measure, tuple[str, ...]] = {
    "both ways": ("drone-to-satellite", "satellite-to-drone"),
    "ground": ("street-to-satellite",),
    "landmarks": ("street-to-street",),
    "centre": ("drone-to-satellite", "satellite-to-drone"),
}


@dataclass(eq=False)
class Source:
    """A data set, and whether it is a rendered world."""

    dataset: Dataset
    rendered: bool
    _digests: dict[str, str] = field(default_factory=dict, init=False)
    _places: dict[tuple[str, ...], TrainingSet] = field(default_factory=dict, init=False)

    @property
    def name(self) -> str:
        """Name of the data set in tables."""
        return "World" if self.rendered else self.dataset.root.resolve().name

    @property
    def kind(self) -> str:
        """Kind of the data set in a table's title."""
        return "a rendered world" if self.rendered else self.dataset.kind

    @cached_property
    def has_google(self) -> bool:
        """True if there are train/google pictures."""
        return bool(self.dataset.train("google"))

    def places(self, sets: tuple[str, ...]) -> TrainingSet:
        """Return the training set with the picture sets `sets`, see `Recipe.sets`, read once; DataError without places."""
        if sets not in self._places:
            self._places[sets] = TrainingSet(self.dataset, Console(quiet=True), sets)
        return self._places[sets]

    def sizes(self, measure: Measure) -> str:
        """Count queries and gallery pictures of each task, with the known counts of the complete data set."""
        published, texts = self.dataset.published_sizes, []
        for task in TASKS[measure]:
            query, gallery = views_of(task)
            counts = []
            for role, view, pictures in (
                ("query", query, self.dataset.queries(query)),
                ("gallery", gallery, self.dataset.gallery(gallery)),
            ):
                full = published.get(f"test/{role}_{view}") or published.get(f"test/{view}")
                counts.append(out_of(len(pictures), full.pictures if full else None))
            texts.append(f"{task} {counts[0]} queries, {counts[1]} pictures in the gallery")
        return ", ".join(texts)

    def training_digest(self, sets: tuple[str, ...]) -> str:
        """Hash the list of training pictures; a trained network is reused for the same list only."""
        if (key := " ".join(sets)) not in self._digests:
            lists = {name: self.dataset.train(name) for name in sets}
            self._digests[key] = _digest(self.dataset.root, lists, None)
        return self._digests[key]

    def test_digest(self, measure: Measure) -> str:
        """Hash the test pictures and their true matches."""
        if measure not in self._digests:
            truth = {task: self.dataset.truth(task) for task in TASKS[measure]}
            listed = {
                task: [[t.good.tolist(), t.junk.tolist()] for t in truths] for task, truths in truth.items() if truths
            }
            # Sorted, so that the order of the lists does not matter.
            lists = dict(sorted(lists_of(self.dataset, TASKS[measure]).items()))
            self._digests[measure] = _digest(self.dataset.root, lists, dict(sorted(listed.items())))
        return self._digests[measure]

    def check(self, measure: Measure) -> None:
        """Raise LPNError if a task is missing, a picture is broken, or `geo.csv` does not cover the pictures."""
        check_test_split(self.dataset, TASKS[measure])


# The data role of each measure, and the form of each role's data.
MEASURED_ON: dict[Measure, DataRole] = {
    "both ways": "places",
    "ground": "panoramas",
    "landmarks": "landmarks",
    "centre": "places",
}
LAYOUTS: dict[DataRole, str] = {
    "places": "places as in University-1652",
    "panoramas": "panoramas and tiles as in CVUSA",
    "landmarks": "landmarks as in Oxford5k or Paris6k",
}


def out_of(count: int, full: int | None) -> str:
    """Format a count, with the total if it is known."""
    return f"{count:,}" if full is None else f"{count:,} of {full:,}"


def open_sources(data: Sequence[str]) -> dict[DataRole, list[Source]]:
    """Open the data sets of --data by role: several of landmarks, in the paper's order, at most one of each other role.

    Raises:
        LPNError: when an argument is not a data set, two have the same role, or a world is not completely rendered.
    """
    roles: dict[DataRole, list[Source]] = {}
    for folder in data:
        source = Source(open_dataset(folder), is_rendered(Path(folder)))
        role: DataRole = "panoramas" if source.dataset.panoramas else "places"
        if "street-to-street" in source.dataset.tasks():
            role = "landmarks"
        elif role in roles:
            one, other = roles[role][0].dataset.root, source.dataset.root
            raise InputError(f"--data names two data sets of {role}, {one} and {other}; give one of them at a time.")
        roles.setdefault(role, []).append(source)
    return {role: sorted(of_role, key=lambda source: source.dataset.kind) for role, of_role in roles.items()}


def _digest(root: Path, lists: dict[str, list[Picture]], truth: object) -> str:
    rows = {
        name: [(str(p.path.relative_to(root)), p.path.stat().st_size, p.label, p.box) for p in pictures]
        for name, pictures in lists.items()
    }
    return hashlib.sha256(json.dumps([rows, truth]).encode()).hexdigest()[:16]
