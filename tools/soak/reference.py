"""The direct computation of every answer with `lpn.retrieval`, without any code of the app."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
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
from lpn.retrieval import Ranking, scoring
from tools.soak.page import UPRIGHT, Cell, ClientState, PageContent, UploadedPicture

# Number of ranked tiles on a page.
SHOWN = 10
# Tolerance of a printed number: half a unit of its third digit, and as much for another order of summation in batches.
PRINTED = 0.001
# Scores closer than this may be in either order, for the same reason.
EQUAL = 1e-4
SIGNS = {True: "✓", False: "✗", None: "?"}
# Least cosine per part between the stored descriptor of a tile and that of its picture.
NEAR = 0.999


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
    """Computes what a page must show; all threads may use it.

    Queries are described here; the gallery's descriptors are the stored ones, of which a sample is checked. LPNError when the
    data set or the model cannot be used.
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
                stored = descriptors.shipped_or_cached(opened, gallery, views[1], data, "gallery").descriptors
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
        names = [self._model.contract.names(view) for view in self._model.views]
        self.names = [" / ".join(dict.fromkeys(of_part)) for of_part in zip(*names, strict=True)]
        self._lock = threading.Lock()
        self._described = lru_cache(maxsize=5000)(self._describe)

    def sliders(self) -> dict[str, list[float]]:
        """All values of each slider, by label."""
        reach = [side // 2 for side in self._model.input_size]
        down, right = ([float(shift) for shift in range(-most, most + 1)] for most in reach)
        angles, factors = [float(angle) for angle in range(-180, 181)], [round(0.05 * step, 2) for step in range(81)]
        found = {"Rotate": angles, "Shift right": right, "Shift down": down, "Zoom": factors[5:]}
        return found | {f"Weight {name}": factors[:41] for name in self.names}

    def first(self, task: str, query: int) -> ClientState:
        """A query of a task without any change."""
        weights, switches = ({f"{kind} {name}": 1.0 for name in self.names} for kind in ("Weight", "Part"))
        return ClientState(task, query, {**UPRIGHT, **weights, **switches})

    def label(self, state: ClientState) -> str:
        """The name of the shown query or uploaded picture."""
        return state.own_picture.name if state.own_picture else self.tasks[state.task].queries[state.query].name

    def address(self, state: ClientState) -> dict[str, str]:
        """The parameters of the page's URL; an ambiguous name is replaced by a position, such as ~3."""
        task, controls = self.tasks[state.task], state.controls
        found = {"task": state.task, "query": "own" if state.own_picture else _called(task.queries, state.query)}
        for key, (label, usual) in zip(("angle", "shift", "down", "zoom"), UPRIGHT.items(), strict=True):
            found |= {key: f"{controls[label]:.10g}"} if controls[label] != usual else {}
        weights = [controls[f"Weight {name}"] for name in self.names]
        found |= {"weights": ",".join(f"{weight:.10g}" for weight in weights)} if set(weights) != {1.0} else {}
        off = [str(part + 1) for part, name in enumerate(self.names) if not controls[f"Part {name}"]]
        found |= {"off": ",".join(off)} if off else {}
        if state.tile is not None:
            found["with"] = state.tile if state.tile == "truth" else _called(task.gallery, state.tile)
        return found | {key: "1" for key, is_open in (("why", state.why), ("lab", state.lab)) if is_open}

    def same_place(self, state: ClientState, task: str, preferred: int) -> int:
        """A query of another task with the place of the state's query: the preferred one if it has it, else the first, else 0."""
        if state.own_picture:
            return 0
        label, queries = self.tasks[state.task].queries[state.query].label, self.tasks[task].queries
        same = (index for index, query in enumerate(queries) if query.label == label)
        return preferred if queries[preferred].label == label else next(same, 0)

    def own_picture(self, rng: Random, name: str) -> UploadedPicture:
        """A rotated query as a JPEG file."""
        picture = rng.choice(self.tasks[rng.choice(list(self.tasks))].queries).load()
        piece = images.shrink(images.rotate(picture, rng.uniform(-180, 180)), 320)
        done, content = cv2.imencode(".jpg", piece[..., ::-1])
        assert done
        return UploadedPicture(f"{name}.jpg", content.tobytes())

    def ranking(self, state: ClientState) -> Ranking:
        """The ranking of the whole gallery for a state."""
        task, own, controls = self.tasks[state.task], state.own_picture, state.controls
        query = task.queries[state.query]
        angle, right, down, zoom = (controls[label] for label in UPRIGHT)
        change = Change(angle, round(right), zoom, round(down)).for_picture(query)
        with self._lock:
            descriptor = self._described(state.task, state.query, own, change)
        truth = None if own or task.truth is None else task.truth[state.query]
        weights = [controls[f"Weight {name}"] * controls[f"Part {name}"] for name in self.names]
        # All parts count alike when every one is off or has weight 0.
        of_parts = scoring.part_weights(self.parts, weights if any(weights) else [1.0] * self.parts)
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
        expected, truth = ranking.top(SHOWN), ranking.positive()
        below = truth is not None and truth.rank > len(expected)
        expected += [truth] if truth is not None and below else []
        if (len(shown.tiles), shown.below) != (len(expected), below):
            yield f"{len(shown.tiles)} tiles are shown, {shown.below} below; expected {len(expected)}, {int(below)}"
            return
        for tile, match in zip(shown.tiles, expected, strict=True):
            # The match of this rank, or another of equal score; the gap is that of the rank.
            other = ranking.find(int(tile[0])) if ranking.holds(int(tile[0])) else match
            here = other if abs(other.score - match.score) <= EQUAL else match
            rank = float(tile[1]) if here is not match and abs(float(tile[1]) - match.rank) == 1 else match.rank
            name, gap = gallery[here.index].name, [] if match.gap is None else [match.gap]
            line = [here.index, rank, SIGNS[here.true], name, here.distance2, *gap, *map(float, here.contributions)]
            if not _same(tile, line):
                yield f"a line of the ranking is {tile}; expected {line}"
        compared = ranking.find(int(shown.tiles[0][0]))
        if state.tile == "truth":
            compared = truth or compared
        elif state.tile is not None and ranking.holds(state.tile):
            compared = ranking.find(state.tile)
        chosen = {"top": str(shown.tiles[0][0]), "chosen": str(compared.index)}
        if chosen.items() - shown.status.items():
            yield f"the status line says {shown.status}; expected {chosen}"
        numbers = ranking.weights, compared.cosines, compared.contributions
        rows = zip(self.names, *(values.tolist() for values in numbers), strict=True)
        table: list[list[Cell]] = [[name, round(100 * weight), *others] for name, weight, *others in rows]
        table.append(["sum", 100, compared.score, compared.distance2])
        if len(shown.pair) != len(table) or not all(map(_same, shown.pair, table)):
            yield f"the compared pair is {shown.pair}; expected {table}"


def _same(here: list[Cell], there: list[Cell]) -> bool:
    """Compare a printed line with the expected one."""
    return len(here) == len(there) and all(
        one == other if isinstance(one, str) or isinstance(other, str) else abs(one - other) <= PRINTED
        for one, other in zip(here, there, strict=True)
    )


def _called(entries: list[Picture], index: int) -> str:
    name = entries[index].name
    plain = name == printable(name) and name not in ("own", "truth") and name[:1] != "~"
    first = next(i for i, entry in enumerate(entries) if entry.name == name)
    return name if plain and first == index else f"~{index}"
