"""An index of tiles, searched with queries of a data set or of a folder of pictures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from lpn.core.errors import InputError
from lpn.core.files import printable
from lpn.sources.opened import OpenedSource, query_positions, weighted
from lpn.sources.options import SourceOptions
from lpn.sources.recognise import NETWORK, TaskSource, file_names

if TYPE_CHECKING:
    from lpn.index import Index
    from lpn.index.queries import IndexQueries
    from lpn.models.base import Model


class IndexSource(TaskSource):
    """An index of tiles, searched with queries of a data set or of a folder of pictures."""

    noun = "an index"
    # The map that windows are cut from; None without one.
    basemap: Any = None
    takes = NETWORK | {"data", "pictures", "csls", "parts", "centre", "per_query"}

    @classmethod
    def recognises(cls, options: SourceOptions) -> bool:
        from lpn.index import is_index

        return is_index(options.source or "")

    @property
    def title(self) -> str:
        return f"{file_names(self.options.file)} and the index"

    def open(self, names: Sequence[str] = (), weights: Sequence[float] | None = None) -> OpenedSource:
        from lpn.index import open_index
        from lpn.index.task import index_task
        from lpn.retrieval import scoring

        model = self.options.load()
        scoring.part_weights(model.n_parts, weights)
        with open_index(self.where) as index:
            queries = self.queries(model, index)
            query_positions(names, queries.pictures, queries.data_name)
            task = index_task(model, self.options.name, index, queries, self.basemap)
        return OpenedSource([weighted(task, weights, self.options.csls)], model, model)

    @property
    def where(self) -> str:
        """The folder or address of the index."""
        return self.options.source or ""

    def queries(self, model: Model, index: Index) -> IndexQueries:
        """Open the queries to search for."""
        from lpn.datasets import open_dataset
        from lpn.index.queries import dataset_queries, picture_queries

        if self.options.pictures is not None:
            return picture_queries(model, self.options.pictures, index, self.options.data)
        if self.options.data is None:
            raise InputError(
                f"{printable(self.options.path.name)} has tiles and no queries; give a data set as --data, or a folder of "
                "pictures as --pictures."
            )
        return dataset_queries(model, open_dataset(self.options.data), index)
