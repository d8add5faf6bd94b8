"""One task of a data set under one model: pictures, descriptors, and what became of every query, computed when asked for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy.typing as npt

from lpn import descriptors, retrieval
from lpn.analysis import notes, query_outcomes
from lpn.analysis.notes import Note
from lpn.analysis.query_outcomes import Outcomes
from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.core.tables import Table
from lpn.core.views import View, views_of
from lpn.datasets import Dataset, Picture, Truth
from lpn.explain import counterfactual
from lpn.models.base import Model
from lpn.models.spec import ModelSpec
from lpn.retrieval import Ranking, metrics, scoring


@dataclass(frozen=True, eq=False)
class Study:
    """What a person looks at.

    Attributes:
        model: None where another program saved the descriptors: then pictures cannot be described again.
        model_name, data_name: how they are called.
        root: the data set's folder.
        task: such as "drone-to-satellite".
        spec: how the descriptors' parts divide a picture.
        map_sizes: (h, w) of the feature map that is divided, for each view.
        queries, gallery: the pictures.
        query_labels, labels: the place each query and each gallery picture shows, (Q,) and (G,).
        truth: true matches and junk of each query where labels do not say them, else None.
        asked, tiles: descriptors of the queries as they are and of the gallery, (Q, n, D) and (G, n, D).
        weights: of the parts, see `scoring.part_weights`; None for equal ones.
        notes: a person's tags and notes by the query's path, see `lpn.analysis.notes`.
    """

    model: Model | None
    model_name: str
    data_name: str
    root: Path
    task: str
    spec: ModelSpec
    map_sizes: Mapping[View, tuple[int, int]]
    queries: Sequence[Picture]
    gallery: Sequence[Picture]
    query_labels: Int64Array
    labels: Int64Array
    truth: Sequence[Truth] | None
    asked: Float32Array
    tiles: Float32Array
    weights: npt.ArrayLike | None = None
    notes: Mapping[str, Note] = field(default_factory=dict)

    @property
    def views(self) -> tuple[View, View]:
        """What queries and gallery show."""
        return views_of(self.task)

    @property
    def part_names(self) -> list[str]:
        """Of each part, as the query is cut."""
        return self.spec.partition(self.views[0]).names()

    @cached_property
    def used(self) -> Float32Array:
        """The part weights, summing to one, (n,)."""
        return scoring.part_weights(self.spec.n_parts, self.weights)

    @cached_property
    def outcomes(self) -> Outcomes:
        """What became of each query."""
        return query_outcomes.build(
            self.asked, self.tiles, self.query_labels, self.labels, self.truth, weights=self.weights
        )

    @cached_property
    def table(self) -> Table:
        """One row for each query: outcome, metadata, tags, and notes; see `failures.table` for what is raised."""
        made = query_outcomes.table(self.root, self.queries, self.gallery, self.outcomes, self.part_names)
        return made.with_columns(notes.columns(dict(self.notes), made.paths))

    @cached_property
    def figures(self) -> dict[str, float]:
        """Recall and AP in percent under the part weights, see `metrics.evaluate`."""
        asked = self.asked if self.weights is None else counterfactual.folded(self.asked, self.weights)
        return metrics.evaluate(asked, self.query_labels, self.tiles, self.labels, self.truth)

    def rank(self, descriptor: Float32Array, query: int | None) -> Ranking:
        """Rank the gallery for a descriptor (n, D) of a query; None for a picture whose place is not known."""
        cosines = scoring.part_cosines(descriptor, self.tiles)
        label = None if query is None else int(self.query_labels[query])
        truth = None if query is None or self.truth is None else self.truth[query]
        return retrieval.rank(cosines, self.used, self.labels, label, truth)


def open_study(
    model: Model,
    model_name: str,
    dataset: Dataset,
    task: str | None = None,
    weights: npt.ArrayLike | None = None,
    notes_file: Path | None = None,
) -> Study:
    """Describe both sides of a task, or read what was described before.

    Args:
        model_name: how it is called.
        task: see `task_of`.
        weights: of the parts, see `scoring.part_weights`.
        notes_file: tags and notes, by default those in the data set's folder.

    Raises:
        InputError: when the two do not offer the task together, or the weights are none.
        LPNError: when notes, pictures, truth, or stores cannot be read.
    """
    task = task_of(model, dataset, task)
    read = notes.read_notes(notes_file or dataset.root / notes.NAME)
    scoring.part_weights(model.n_parts, weights)
    views = views_of(task)
    queries, gallery = dataset.queries(views[0]), dataset.gallery(views[1])
    return Study(
        model,
        printable(model_name),
        printable(dataset.root.resolve().name),
        dataset.root,
        task,
        model.spec,
        {view: model.map_size(view) for view in views},
        queries,
        gallery,
        query_outcomes.labels_of(queries),
        query_outcomes.labels_of(gallery),
        dataset.truth(task),
        descriptors.stored_descriptors(model, queries, views[0], dataset.root, "query"),
        descriptors.stored_descriptors(model, gallery, views[1], dataset.root, "gallery"),
        weights,
        read,
    )


def task_of(model: Model, dataset: Dataset, task: str | None = None) -> str:
    """The task asked for, or the first that the data set offers and the model knows the views of.

    Raises:
        InputError: when the two do not offer it together.
    """
    known = [name for name in dataset.tasks() if set(views_of(name)) <= set(model.views)]
    task = task or (known[0] if known else "")
    if task not in known:
        raise InputError(
            f"The task is {task or 'none'}; {dataset.root.name} and this model offer {', '.join(known) or 'none'} together."
        )
    return task
