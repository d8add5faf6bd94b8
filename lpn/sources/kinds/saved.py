"""Descriptors by another program, without their network: a result of the published test code, or plain arrays."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.sources.opened import OpenedSource, query_positions, weighted
from lpn.sources.options import SourceOptions
from lpn.sources.recognise import TaskSource, file_names

if TYPE_CHECKING:
    from lpn.retrieval.saved import PublishedResult
    from lpn.tasks.task import Task

_TAKEN = frozenset(("data", "n_parts", "csls", "centre", "parts", "per_query"))


class SavedSource(TaskSource):
    """A source of descriptors alone."""

    @abstractmethod
    def task(self) -> Task:
        """Read the task."""

    def open(self, names: Sequence[str] = (), weights: Sequence[float] | None = None) -> OpenedSource:
        task = self.task()
        query_positions(names, task.queries, task.data_name)
        return OpenedSource([weighted(task, weights, self.options.csls)])


class ResultSource(SavedSource):
    """A result of the published test code on its pictures."""

    noun = "a result of the published test code"
    takes = _TAKEN

    @classmethod
    def recognises(cls, options: SourceOptions) -> bool:
        return options.path.suffix.lower() == ".mat" and options.gallery is None

    @property
    def title(self) -> str:
        return file_names(*(path for path in (self.options.path, self.options.data) if path is not None))

    def task(self) -> Task:
        from lpn.datasets import open_dataset
        from lpn.tasks.saved import saved_task
        from lpn.tasks.task import no_pictures

        if self.options.data is None:
            raise no_pictures(printable(self.options.path.name))
        saved, dataset = self.load(), open_dataset(self.options.data)
        saved.check_norms()  # contributions of parts require these norms
        return saved_task(saved, dataset)

    def to_measure(self) -> list[Task]:
        from lpn.datasets import open_dataset
        from lpn.tasks.saved import saved_task

        dataset = None if self.options.data is None else open_dataset(self.options.data)
        return [weighted(saved_task(self.load(), dataset), None, self.options.csls)]

    def load(self) -> PublishedResult:
        """Read the result, see `load_saved` for the errors."""
        from lpn.retrieval.saved import check_n_parts, load_saved

        return load_saved(self.options.path, check_n_parts(self.options.n_parts))


class ArraySource(SavedSource):
    """Descriptors of any model as plain arrays."""

    noun = "arrays of descriptors"
    takes = _TAKEN | {"gallery", "paths", "order"}

    @classmethod
    def recognises(cls, options: SourceOptions) -> bool:
        ending = options.path.suffix.lower()
        return ending in (".npy", ".npz") or (ending == ".mat" and options.gallery is not None)

    @property
    def title(self) -> str:
        return file_names(*(path for path in (self.options.path, self.options.gallery) if path is not None))

    def task(self) -> Task:
        from lpn.retrieval.saved import check_n_parts
        from lpn.tasks.saved import array_task

        options = self.options
        n_parts = None if options.n_parts is None else check_n_parts(options.n_parts)
        gallery = options.path if options.gallery is None else options.gallery
        return array_task(options.path, gallery, options.paths, n_parts, options.order, options.data)

    def to_measure(self) -> list[Task]:
        paths = self.options.paths
        if paths is None:
            raise InputError("Plain arrays are measured with their list of pictures; give it as --paths.")
        task = self.task()
        known, places = task.known, task.geometry
        by_metres = places is not None and None not in places.queries
        if known is not None and (known.any() or not by_metres):
            raise InputError(
                f"{int((~known).sum())} of {len(known)} queries have no label in {paths.name}, so their truth is unknown; add "
                "their labels."
            )
        return [weighted(task, None, self.options.csls)]
