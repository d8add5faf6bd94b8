"""A task whose whole gallery is in memory, so that every tile has a rank."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

from lpn import retrieval
from lpn.core.arrays import Float32Array
from lpn.retrieval import Ranking, csls, metrics, scoring
from lpn.retrieval.csls import CslsTerms
from lpn.retrieval.metrics import Retrieval
from lpn.tasks import query_outcomes
from lpn.tasks.query_outcomes import Outcomes
from lpn.tasks.ranking_cache import ResumableRanking
from lpn.tasks.task import LazyArray, RankUnderWeights, Task


@dataclass(frozen=True, eq=False, kw_only=True)
class GalleryTask(Task):
    """A task over a gallery in memory.

    Attributes:
        gallery_descriptors: (G, n, D), without part weights.
    """

    gallery_descriptors: LazyArray = LazyArray()  # noqa: RUF009 (no default: see the class)

    @property
    def tiles(self) -> int:
        return len(self.gallery_descriptors)

    @property
    def depth(self) -> int | None:
        return None

    @property
    def approximate(self) -> bool:
        return False

    @property
    def lists_gallery(self) -> bool:
        return True

    @property
    def gallery_description(self) -> str:
        return f"{self.tiles:,} {'tiles' if self.gallery_view == 'satellite' else 'gallery pictures'}"

    def sides(self) -> tuple[Float32Array, Float32Array]:
        return self.query_descriptors, self.gallery_descriptors

    @cached_property
    def compared(self) -> tuple[Float32Array, Float32Array]:
        return csls.scaled(*self.sides(), self.neighbours) if self.neighbours else self.sides()

    @property
    def csls_tiles(self) -> Float32Array | None:
        """The tiles' terms of CSLS, see `CslsTerms`, (G, n); None without it."""
        return -self.contract.n_parts * self.compared[1][..., -1] if self.neighbours else None

    def ranking(self) -> ResumableRanking:
        return ResumableRanking(*self.compared, self.query_labels, self.gallery_labels, self.truth)

    @cached_property
    def retrieved(self) -> Retrieval:
        queries, gallery = self.compared
        factors = query_outcomes.weight_factors(queries, self.weights)
        return metrics.retrieve(queries, self.query_labels, gallery, self.gallery_labels, self.truth, factors)

    def outcomes_of(self, ranking: Retrieval) -> Outcomes:
        return query_outcomes.outcomes_of(ranking, *self.compared, self.weights, self.known)

    def stored_descriptor(self, index: int) -> Float32Array:
        return cast(Float32Array, self.gallery_descriptors[index])

    def tile_name(self, index: int) -> str:
        return self.gallery[index].name

    def find_tile(self, name: str) -> int | None:
        return next((i for i, tile in enumerate(self.gallery) if tile.name == name), None)

    def start_search(
        self, query: int | None, descriptor: Float32Array, lengths: Float32Array | None = None
    ) -> RankUnderWeights:
        return _GalleryRanks(self, query, descriptor, lengths)


class _GalleryRanks:
    """Ranks a gallery in memory: the part cosines are computed once, and serve all weights."""

    def __init__(
        self, task: GalleryTask, query: int | None, descriptor: Float32Array, lengths: Float32Array | None
    ) -> None:
        self._task, self._query, self._lengths = task, query, lengths
        self._cosines = scoring.part_cosines(descriptor, task.gallery_descriptors)
        # A region's score has no constants, and so none of CSLS.
        tiles = None if lengths is not None else task.csls_tiles
        self._csls = None if tiles is None else CslsTerms.of_query(self._cosines, tiles, task.neighbours)
        self._last: tuple[bytes, Ranking] | None = None

    def __call__(self, weights: Float32Array, also: int | None = None) -> Ranking:
        del also  # every tile is ranked
        if self._last is None or self._last[0] != weights.tobytes():
            label_and_truth = self._task.label_and_truth(self._query)
            ranking = retrieval.rank(
                self._cosines,
                weights,
                self._task.gallery_labels,
                *label_and_truth,
                lengths=self._lengths,
                csls=self._csls,
            )
            self._last = weights.tobytes(), ranking
        return self._last[1]
