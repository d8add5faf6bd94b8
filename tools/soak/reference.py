"""The direct computation of every answer with `lpn.retrieval`, without any code of the app."""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from random import Random

import cv2
import numpy as np

import lpn
from lpn import descriptors, retrieval
from lpn.core import images
from lpn.core.arrays import Float32Array, Int64Array
from lpn.core.errors import DataError
from lpn.core.files import printable
from lpn.core.views import View, views_of
from lpn.datasets import Picture, Truth, open_dataset
from lpn.descriptors.transforms import Change
from lpn.retrieval import Match, Ranking, scoring
from tools.soak.client_state import ClientState, UploadedPicture
from tools.soak.page_content import MatchRow, PageContent

# Number of ranked tiles on a page.
SHOWN = 10
# Tolerance of a printed number: half a unit of its third digit, and as much for another order of summation, since the app may
# describe pictures in batches.
PRINTED = 0.001
# Scores closer than this may be in either order, for the same reason.
EQUAL = 1e-4
SIGNS = {True: "✓", False: "✗", None: "?"}
# Number of gallery tiles to describe again, and the least cosine per part with the stored descriptor.
SAMPLE, NEAR = 8, 0.999
_KEPT = 5000
_SIDE = 320


@dataclass(frozen=True, eq=False)
class ReferenceTask:
    """One task with the stored descriptors of its gallery."""

    query_view: View
    queries: list[Picture]
    gallery: list[Picture]
    descriptors: Float32Array
    labels: Int64Array
    truth: list[Truth] | None

    @cached_property
    def unique(self) -> list[int]:
        """Queries whose name is part of no other query's name, so that a search finds exactly them."""
        names = [entry.name.casefold() for entry in self.queries]
        return [i for i, name in enumerate(names[:400]) if sum(name in other for other in names) == 1]


class Reference:
    """Computes what a page must show.

    Only `label`, `address`, and `own_picture` are thread-safe. Queries are described here; the gallery's descriptors are the
    stored ones, of which a sample is checked.

    Raises:
        LPNError: when the data set or the model cannot be used.
    """

    def __init__(self, data: Path, model: Path) -> None:
        opened = lpn.load(model)
        self._model = opened.for_parallel_inference()
        dataset = open_dataset(data)
        self.sides: dict[str, ReferenceTask] = {}
        for name in dataset.tasks():
            views = views_of(name)
            if not set(views) <= set(opened.views):
                continue
            gallery = dataset.gallery(views[1])
            labels = np.array([entry.label for entry in gallery], np.int64)
            known = descriptors.shipped_or_cached(opened, gallery, views[1], data, "gallery")
            truth = dataset.truth(name)
            self._check_sample(gallery, known.descriptors, views[1])
            self.sides[name] = ReferenceTask(
                views[0], dataset.queries(views[0]), gallery, known.descriptors, labels, truth
            )
        if not self.sides:
            raise DataError(f"The model knows none of the views of {data}; give a data set and a model that fit.")
        self.parts = opened.n_parts
        self.names = self._part_names()
        self.reach = opened.input_size[1] // 2, opened.input_size[0] // 2
        self._picture = lru_cache(maxsize=200)(images.load_picture)
        self._described: OrderedDict[object, Float32Array] = OrderedDict()

    def _check_sample(self, gallery: list[Picture], descriptors: Float32Array, view: View) -> None:
        """Raise DataError when stored descriptors do not belong to their pictures."""
        for index in sorted({round(at) for at in np.linspace(0, len(gallery) - 1, SAMPLE)}):
            picture = images.load_picture(gallery[index].path)
            found = retrieval.describe_picture(self._model, picture, view).descriptor
            least = float(scoring.part_cosines(found, descriptors[index : index + 1]).min())
            if not least >= NEAR:
                raise DataError(
                    f"The stored descriptor of {gallery[index].name} is not that of its picture: the cosine of a part is "
                    f"{least:.3f}. Describe the gallery anew."
                )

    def first(self) -> ClientState:
        """The initial state of a page."""
        return ClientState(next(iter(self.sides)), 0, (1.0,) * self.parts, (True,) * self.parts)

    def label(self, state: ClientState) -> str:
        """The name of the shown query or uploaded picture."""
        return state.own_picture.name if state.own_picture else self.sides[state.task].queries[state.query].name

    def address(self, state: ClientState) -> dict[str, str]:
        """The parameters of the page's URL; an ambiguous name is replaced by a position, such as ~3."""
        side = self.sides[state.task]
        text = {**state.address(), "query": "own" if state.own_picture else _called(side.queries, state.query)}
        if state.tile is not None:
            text["with"] = state.tile if state.tile == "truth" else _called(side.gallery, state.tile)
        return text

    def same_place(self, state: ClientState, task: str, preferred: int) -> int:
        """A query of another task with the place of the state's query: the preferred one if it has it, else the first, else 0."""
        if state.own_picture:
            return 0
        label, queries = self.sides[state.task].queries[state.query].label, self.sides[task].queries
        same = (index for index, query in enumerate(queries) if query.label == label)
        return preferred if queries[preferred].label == label else next(same, 0)

    def own_picture(self, rng: Random, name: str) -> UploadedPicture:
        """A rotated crop of a query as a JPEG file."""
        side = self.sides[rng.choice(list(self.sides))]
        picture = images.load_picture(rng.choice(side.queries).path)
        height, width = (max(length * rng.randint(50, 100) // 100, 8) for length in picture.shape[:2])
        piece = images.shrink(images.rotate(picture[:height, :width], rng.uniform(-180, 180)), _SIDE)
        done, content = cv2.imencode(".jpg", piece[..., ::-1])
        assert done
        return UploadedPicture(f"{name}.jpg", content.tobytes())

    def ranking(self, state: ClientState) -> Ranking:
        """The ranking of the whole gallery for a state."""
        side = self.sides[state.task]
        weights = scoring.part_weights(self.parts, state.values())
        cosines = scoring.part_cosines(self._descriptor(state, side), side.descriptors)
        label = None if state.own_picture else side.queries[state.query].label
        truth = None if state.own_picture or side.truth is None else side.truth[state.query]
        return retrieval.rank(cosines, weights, side.labels, label, truth)

    def failures(self, state: ClientState, shown: PageContent) -> list[str]:
        """Differences between a page and the ranking, one sentence each; empty for a right answer."""
        try:
            return list(self._differences(state, shown, self.ranking(state)))
        except (ValueError, IndexError, StopIteration, KeyError) as error:
            return [f"what the page shows could not be read ({type(error).__name__}: {error})"]

    def _differences(self, state: ClientState, shown: PageContent, ranking: Ranking) -> list[str]:
        side, found = self.sides[state.task], []
        rows = [row for row in shown.rows if not row.below]
        expected, truth = ranking.top(SHOWN), ranking.positive()
        if len(rows) != len(expected):
            found.append(f"{len(rows)} tiles are shown; expected {len(expected)}")
        for row, match in zip(rows, expected, strict=False):
            found += self._row(side, row, self._match_of(ranking, row, match), match.gap)
        below = [row for row in shown.rows if row.below]
        beyond = truth if truth is not None and truth.rank > len(expected) else None
        if len(below) != (beyond is not None):
            found.append(f"{len(below)} true tiles are shown below; expected {int(beyond is not None)}")
        for row, match in zip(below, [beyond] if beyond else [], strict=False):
            found += self._row(side, row, self._match_of(ranking, row, match), match.gap)
        if shown.status.get("top") != str(rows[0].index):
            found.append(f"the status line says tile {shown.status.get('top')}, the list {rows[0].index}")
        compared = ranking.find(rows[0].index)
        if state.tile == "truth":
            compared = truth or compared
        elif state.tile is not None and ranking.holds(state.tile):
            compared = ranking.find(state.tile)
        if shown.status.get("chosen") != str(compared.index):
            found.append(f"tile {shown.status.get('chosen')} is compared; expected {compared.index}")
        return found + self._pair(shown, ranking, compared)

    def _match_of(self, ranking: Ranking, row: MatchRow, match: Match) -> Match:
        """The match of a row: the expected one, or another of equal score."""
        if row.index != match.index and ranking.holds(row.index):
            other = ranking.find(row.index)
            return other if abs(other.score - match.score) <= EQUAL else match
        return match

    def _row(self, side: ReferenceTask, row: MatchRow, match: Match, gap: float | None) -> list[str]:
        """Differences in a row. The gap is that of the rank, since tiles of equal scores may be swapped."""
        if row.index != match.index:
            return [
                f"rank {match.rank} is tile {row.index} at {row.distance}; expected {match.index} at {match.distance2:.3f}"
            ]
        found = []
        if (
            abs(row.rank - match.rank) > 1
            or row.sign != SIGNS[match.true]
            or row.texts[2] != side.gallery[row.index].name
        ):
            expected = f"{match.rank} {SIGNS[match.true]} {side.gallery[row.index].name}"
            found.append(f"tile {row.index} is called {' '.join(row.texts[:3])}; expected {expected}")
        numbers = [("distance", row.distance, match.distance2), ("gap", row.gap, gap)]
        numbers += [
            (f"share {i + 1}", *pair) for i, pair in enumerate(zip(row.shares, match.contributions, strict=True))
        ]
        for what, here, there in numbers:
            if (here is None) != (there is None) or (
                here is not None and there is not None and abs(here - there) > PRINTED
            ):
                found.append(f"tile {row.index} has {what} {here}; expected {there}")
        return found

    def _pair(self, shown: PageContent, ranking: Ranking, compared: Match) -> list[str]:
        """Differences in the table of the compared pair."""
        found, (_, *lines, total) = [], shown.parts
        for i, line in enumerate(lines):
            text = [float(text.rstrip(" %").replace("−", "-")) for text in line[-3:]]
            expected = [100 * ranking.weights[i], compared.cosines[i], compared.contributions[i]]
            if line[0] != self.names[i] or any(
                abs(here - there) > bound
                for here, there, bound in zip(text, expected, (0.51, PRINTED, PRINTED), strict=True)
            ):
                found.append(f"part {line} of the compared pair; expected {[round(float(v), 4) for v in expected]}")
        if len(lines) != self.parts or abs(float(total[-1]) - compared.distance2) > PRINTED:
            found.append(
                f"{len(lines)} parts with sum {total[-1]}; expected {self.parts} with {compared.distance2:.3f}"
            )
        return found

    def _descriptor(self, state: ClientState, side: ReferenceTask) -> Float32Array:
        change = Change(state.angle, state.right, state.zoom, state.down).for_picture(side.queries[state.query])
        entry = side.queries[state.query]
        key = (side.query_view, state.own_picture.name if state.own_picture else (entry.path, entry.box), change)
        if key not in self._described:
            if state.own_picture:
                picture = images.decode_picture(state.own_picture.content, state.own_picture.name)
            else:
                picture = images.crop(self._picture(entry.path), entry.box, entry.name)
            self._described[key] = retrieval.describe_picture(self._model, picture, side.query_view, change).descriptor
            if len(self._described) > _KEPT:
                self._described.popitem(last=False)
        return self._described[key]

    def _part_names(self) -> list[str]:
        names = [self._model.contract.names(view) for view in self._model.views]
        return [" / ".join(dict.fromkeys(of_part)) for of_part in zip(*names, strict=True)]


def _called(entries: list[Picture], index: int) -> str:
    name = entries[index].name
    plain = name == printable(name) and name not in ("own", "truth") and name[:1] != "~"
    first = next(i for i, entry in enumerate(entries) if entry.name == name)
    return name if plain and first == index else f"~{index}"
