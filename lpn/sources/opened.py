"""An opened source: its tasks and models."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Protocol, Self

from lpn.core.errors import InputError
from lpn.core.files import printable

if TYPE_CHECKING:
    from lpn.models.base import Model
    from lpn.sources.recognise import TaskSource
    from lpn.tasks.task import Task


@dataclass(frozen=True, eq=False)
class OpenedSource:
    """The tasks of a source.

    Attributes:
        tasks: one, or all that the source offers.
        model: the network that describes further pictures, calibrated or centred like the source; None without one.
        network: the model before calibration and centring.
        notes: sentences about the files, for the user.
    """

    tasks: Sequence[Task]
    model: Model | None = None
    network: Model | None = None
    notes: Sequence[str] = ()

    @property
    def task(self) -> Task:
        """The first task."""
        return self.tasks[0]

    def graded(self) -> tuple[Task, Collection[int]]:
        """Return the first task for grading, and its ungraded queries, for which no tile is certainly right.

        Raises:
            LPNError: if a file cannot be used.
        """
        return self.task, ()

    def named(self, model_name: str) -> Self:
        """Return the source with another display name of its model."""
        return replace(self, tasks=[replace(task, model_name=printable(model_name)) for task in self.tasks])


def weighted(task: Task, weights: Sequence[float] | None, neighbours: int = 0) -> Task:
    """Return a task with part weights (None for equal ones), and CSLS over K neighbours (0 for none).

    Raises:
        InputError: if the number of weights is wrong, or there are fewer queries than K.
    """
    from lpn.retrieval import csls, scoring

    scoring.part_weights(task.contract.n_parts, weights)
    if neighbours:
        csls.check_neighbours(neighbours, len(task.query_labels))
    return replace(task, weights=weights, neighbours=neighbours)


def open_with_notes(
    source: TaskSource, file: Path | None, names: Sequence[str] = (), weights: Sequence[float] | None = None
) -> OpenedSource:
    """Open a source with only its first task, including the user's tags and notes.

    Args:
        file: the notes, read first; None takes notes.csv in the folder of the queries.
        names, weights: see `TaskSource.open`.

    Raises:
        DataError: if the notes are damaged; other errors as `TaskSource.open`.
    """
    from lpn.core.demo import own_file
    from lpn.tasks import notes

    named = None if file is None else notes.read_notes(file)
    opened = source.open(names, weights)
    first = opened.task
    read = notes.read_notes(own_file(first.root, notes.NAME)) if named is None else named
    return replace(opened, tasks=[replace(first, notes=read)])


class Named(Protocol):
    """Something with a name, such as a picture or a frame."""

    @property
    def name(self) -> str:
        """The name."""
        ...


def query_positions(names: Sequence[str], queries: Sequence[Named], data_name: str) -> list[int]:
    """Return the positions of queries by their names, each once.

    Raises:
        InputError: if a name has no query; the message has the nearest names.
    """
    places = {query.name: place for place, query in reversed(list(enumerate(queries)))}
    for name in names:
        if name not in places:
            near = get_close_matches(name, places, 3, 0.5) or [queries[0].name]
            raise InputError(
                f"{printable(data_name)} has no query {printable(name)}; did you mean {' or '.join(map(printable, near))}?"
            )
    return [places[name] for name in dict.fromkeys(names)]
