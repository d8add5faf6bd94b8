"""The expected answer of each page, computed directly with `lpn.retrieval`, without any code of the app."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from random import Random
from typing import Any, NamedTuple
from urllib.parse import urlencode

import cv2
import numpy as np

import lpn
from lpn import descriptors, retrieval
from lpn.core import images
from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import DataError
from lpn.core.views import View, views_of
from lpn.datasets import Picture, Truth, open_dataset
from lpn.descriptors.transforms import Change
from lpn.retrieval import Match, Ranking, scoring

# Number of tiles in the strip.
SHOWN = 6
# Tolerance of a printed number: half a unit of its third digit, and as much for another order of summation in batches.
PRINTED = 0.001
# Scores closer than this may be in either order, for the same reason.
EQUAL = 1e-4
# Least cosine per part between the stored descriptor of a tile and that of its picture.
NEAR = 0.999


class UploadedPicture(NamedTuple):
    """An uploaded picture: a unique file name and the file's bytes."""

    name: str
    content: bytes


@dataclass(frozen=True)
class ClientState:
    """The choices of one client that its ranking depends on.

    Attributes:
        task: a task's name, such as "drone-to-satellite".
        query: position among the task's queries; it stays while an uploaded picture is shown.
        angle: degrees counter-clockwise by which the photo is turned.
        weights: of the parts; empty for equal ones.
        compare: gallery position of the compared tile; None for the headline's.
        own: an uploaded picture, shown in place of the query.
    """

    task: str
    query: int
    angle: float = 0.0
    weights: tuple[float, ...] = ()
    compare: int | None = None
    own: UploadedPicture | None = None

    def showing(self, **choice: Any) -> ClientState:
        """Show another query, own picture, or task, upright."""
        return replace(self, **({"own": None, "compare": None, "angle": 0.0} | choice))


class ShownTile(NamedTuple):
    """A tile of the strip as it is printed."""

    rank: int
    name: str
    distance: float


class PageContent(NamedTuple):
    """The content of a page: the photo's name, the tiles of the strip, and each part's share of the first distance."""

    photo: str
    tiles: list[ShownTile]
    shares: list[float]


@dataclass(frozen=True, eq=False)
class ReferenceTask:
    """One task with the stored descriptors of its gallery."""

    query_view: View
    queries: list[Picture]
    gallery: list[Picture]
    descriptors: Float32Array
    labels: Int64Array
    truth: list[Truth] | None


class Reference:
    """The expected content of a page; thread-safe.

    Queries are described here; the gallery's descriptors are the stored ones, of which a sample is checked. Raises LPNError if
    the data set or the model cannot be used.
    """

    def __init__(self, data: Path, model: Path) -> None:
        opened = lpn.load(model)
        self._model = opened.for_parallel_inference()
        dataset = open_dataset(data)
        self.tasks: dict[str, ReferenceTask] = {}
        for name in dataset.tasks():
            views = views_of(name)
            if set(views) <= set(opened.views):
                gallery = dataset.gallery(views[1])
                stored = descriptors.shipped_or_cached(opened, gallery, views[1], data, "gallery")
                for index in {0, len(gallery) // 2, len(gallery) - 1}:
                    found = retrieval.describe_picture(self._model, gallery[index].load_cropped(), views[1]).descriptor
                    if not scoring.part_cosines(found, stored[index : index + 1]).min() >= NEAR:
                        raise DataError(f"{gallery[index].name} has another descriptor; describe the gallery anew.")
                labels = np.array([entry.label for entry in gallery], np.int64)
                queries, truth = dataset.queries(views[0]), dataset.truth(name)
                self.tasks[name] = ReferenceTask(views[0], queries, gallery, stored, labels, truth)
        if not self.tasks:
            raise DataError(f"The model knows none of the views of {data}; give a data set and a model that fit.")
        self.parts = opened.n_parts
        self._lock = threading.Lock()
        self._described = lru_cache(maxsize=5000)(self._describe)

    def label(self, state: ClientState) -> str:
        """The name of the shown query or uploaded picture."""
        return state.own.name if state.own else self.tasks[state.task].queries[state.query].name

    def address(self, state: ClientState) -> str:
        """The query string of a state; pictures are named by their positions."""
        weights = ",".join(f"{weight:g}" for weight in state.weights)
        found = {"task": state.task, "query": f"~{state.query}", "angle": f"{state.angle:g}", "weights": weights}
        found |= {"scoring": "plain"} | ({} if state.compare is None else {"with": f"~{state.compare}"})
        return urlencode({key: value for key, value in found.items() if value}, safe="~,")

    def own_picture(self, rng: Random, name: str) -> UploadedPicture:
        picture = rng.choice(self.tasks[rng.choice(list(self.tasks))].queries).load()
        piece = images.shrink(images.rotate(picture, rng.uniform(-180, 180)), 320)
        done, content = cv2.imencode(".jpg", piece[..., ::-1])
        assert done
        return UploadedPicture(f"{name}.jpg", content.tobytes())

    def ranking(self, state: ClientState) -> Ranking:
        task, own = self.tasks[state.task], state.own
        query = task.queries[state.query]
        change = Change(state.angle)
        change = change if own else change.for_picture(query)
        with self._lock:
            descriptor = self._described(state.task, state.query, own, change)
        truth = None if own or task.truth is None else task.truth[state.query]
        of_parts = scoring.part_weights(self.parts, state.weights or [1.0] * self.parts)
        cosines = scoring.part_cosines(descriptor, task.descriptors)
        return retrieval.rank(cosines, of_parts, task.labels, None if own else query.label, truth)

    def _describe(self, task: str, query: int, own: UploadedPicture | None, change: Change) -> Float32Array:
        picture = (
            images.decode_picture(own.content, own.name) if own else self.tasks[task].queries[query].load_cropped()
        )
        return retrieval.describe_picture(self._model, picture, self.tasks[task].query_view, change).descriptor

    def failures(self, state: ClientState, shown: PageContent) -> Iterator[str]:
        """Differences between a page and the ranking, one sentence each; none for a right answer."""
        gallery, ranking = self.tasks[state.task].gallery, self.ranking(state)
        if shown.photo != self.label(state):
            yield f"the photo is {shown.photo}; expected {self.label(state)}"
        further = {match.index: match for match in self._further(state, ranking)}
        nearest = {match.index for match in ranking.top(SHOWN)}
        expected = [
            *ranking.top(SHOWN - len(further.keys() - nearest)),
            *(match for index, match in further.items() if index not in nearest),
        ]
        if len(shown.tiles) != len(expected):
            yield f"{len(shown.tiles)} tiles are shown; expected {len(expected)}"
            return
        for tile, match in zip(shown.tiles, expected, strict=True):
            # The match of this rank, or another of equal score.
            equal = [one for one in ranking.top(match.rank + 1) if abs(one.score - match.score) <= EQUAL]
            named = [one for one in equal if gallery[one.index].title == tile.name]
            if not named or abs(tile.distance - named[0].distance2) > PRINTED or abs(tile.rank - match.rank) > 1:
                line = (match.rank, gallery[match.index].title, round(match.distance2, 4))
                yield f"a tile of the strip is {tuple(tile)}; expected {line}"
        first = next((one for one in ranking.top(3) if gallery[one.index].title == shown.tiles[0].name), None)
        if first is None or any(
            abs(one - other) > PRINTED for one, other in zip(shown.shares, first.contributions, strict=True)
        ):
            yield f"the shares are {shown.shares}; expected {None if first is None else first.contributions.tolist()}"

    def _further(self, state: ClientState, ranking: Ranking) -> Iterator[Match]:
        """The positive, and the compared tile unless it is the headline's."""
        truth, first = ranking.positive(), ranking.match(0)
        if truth is not None:
            yield truth
        rival = ranking.hardest_negative() if first.true in (True, None) else truth or ranking.hardest_negative()
        if state.compare is not None and rival is not None and state.compare not in (first.index, rival.index):
            yield ranking.find(state.compare)
