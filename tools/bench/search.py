"""One query against a gallery: `python -m tools.bench search`.

The peers are NumPy's product with the whole gallery and a partial sort, and faiss's flat index. Ours is
`lpn.index.folder`, memory-mapped, with equal and with other part weights; it gives names, scores,
and the vectors of the top 100, as the peers do. The limit is reading the vectors once, by the quickest of a few ways to
read them. All take turns in one process, and the tables give medians.

Descriptors are drawn about centres, as those of places are, and positions uniformly over a rectangle, of which a box holds a
hundredth; there, NumPy picks out the tiles within and scores these.
"""

from __future__ import annotations

import itertools
import tempfile
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.resources import usable_cores
from lpn.index import DegreeBox, DescriptorKind, base, create_index
from lpn.models.base import normalise
from lpn.retrieval import scoring
from tools.bench import figures as measuring
from tools.bench.figures import Figure

KIND = DescriptorKind("bench", 4, 512)
TILES = (951, 51_355)
OTHER = (0.5, 0.3, 0.2, 0.0)
# South-west and north-east of the rectangle over which tiles lie.
CORNERS = (46.0, 6.0), (47.0, 8.0)
# Has a hundredth of its area.
BOX: DegreeBox = (46.4, 6.6, 46.5, 6.8)
TOP = 100
THREADS = min(8, usable_cores())
BLOCK = 4096
QUERIES = ROUNDS = 20
Task = Callable[[int], object]


def drawn(count: int, seed: int = 0) -> Iterator[tuple[int, Float32Array]]:
    """Draw descriptors in blocks, with the index of each block's first: 20 tiles around each centre, centres around one mean."""
    for start in range(0, count, BLOCK):
        rng = np.random.default_rng([seed, start])
        size = min(BLOCK, count - start)
        shape = (KIND.n_parts, KIND.embedding)
        centres = rng.standard_normal((size // 20 + 1, *shape), np.float32)
        about = centres[np.arange(size) // 20] + 0.7 * rng.standard_normal((size, *shape), np.float32)
        yield start, normalise(about + np.random.default_rng(7).standard_normal(shape, np.float32))


def places(start: int, count: int) -> Float64Array:
    """Random positions of a block's tiles, (count, 2)."""
    return np.random.default_rng([2, start]).uniform(*CORNERS, (count, 2))


def queries(gallery: Float32Array) -> Float32Array:
    """Queries: random tiles with noise, (Q, n, D)."""
    rng = np.random.default_rng(1)
    chosen = gallery[rng.integers(0, len(gallery), QUERIES)]
    noise = rng.standard_normal(chosen.shape, np.float32) / np.float32(KIND.numbers**0.5)
    return normalise(chosen + np.float32(0.8) * noise)


def medians(tasks: dict[str, Task]) -> dict[str, float]:
    """Median milliseconds of each task; each round has another query."""
    numbers = {name: itertools.count() for name in tasks}

    def run(name: str) -> object:
        return tasks[name](next(numbers[name]) % QUERIES)

    return measuring.medians({name: partial(run, name) for name in tasks}, ROUNDS)


def readers(rows: Float32Array) -> dict[str, Task]:
    """Tasks that read every number once, divided among threads."""
    # Sums of integers have no chain of rounding that serialises them.
    numbers = rows.reshape(-1).view(np.int32)
    shares = np.array_split(numbers, THREADS)
    pool = ThreadPoolExecutor(THREADS)

    def read(reduce: Callable[[Any], Any], _: int) -> object:
        return list(pool.map(reduce, shares))

    return {"read by or": partial(read, np.bitwise_or.reduce), "read by max": partial(read, np.max)}


def top(scores: Float32Array) -> Any:
    """Positions of the highest scores, in order."""
    k = min(TOP, len(scores))
    found = np.argpartition(scores, len(scores) - k)[len(scores) - k :]
    return found[np.argsort(-scores[found])]


def peers(gallery: Float32Array, asked: Float32Array, weights: Float32Array) -> dict[str, Task]:
    """NumPy, and faiss where it is installed; both give positions, scores, and vectors."""
    flat = gallery.reshape(len(gallery), KIND.numbers)
    positions = np.concatenate([places(start, min(BLOCK, len(flat) - start)) for start in range(0, len(flat), BLOCK)])
    vectors = [base.rescaled(KIND, query, weights).astype(np.float32) for query in asked]

    def by_numpy(number: int) -> object:
        scores = flat @ vectors[number]
        found = top(scores)
        return found, scores[found], flat[found]

    def in_box(number: int) -> object:
        inside = np.flatnonzero(base.within(positions, BOX))
        scores = flat[inside] @ vectors[number]
        found = top(scores)
        return inside[found], scores[found], flat[inside[found]]

    tasks: dict[str, Task] = {"NumPy": by_numpy, "NumPy in a box": in_box}
    try:
        faiss: Any = import_module("faiss")
    except ImportError:
        return tasks
    index = faiss.IndexFlatIP(KIND.numbers)
    index.add(flat)

    def by_faiss(number: int) -> object:
        scores, found = index.search(vectors[number][None], min(TOP, len(flat)))
        return found, scores, flat[found[0]]

    return tasks | {"faiss flat": by_faiss}


def filled(index: Any, count: int) -> Any:
    """Add a drawn gallery to an index."""
    for start, block in drawn(count):
        index.add([f"{start + i:07d}" for i in range(len(block))], block, places(start, len(block)))
    return index


def compare(count: int, folder: Path) -> list[Figure]:
    gallery = np.concatenate([block for _, block in drawn(count)])
    asked = queries(gallery)
    equal, other = scoring.part_weights(KIND.n_parts), scoring.part_weights(KIND.n_parts, OTHER)
    index = filled(create_index(folder / str(count), KIND), count)
    tasks = readers(gallery) | peers(gallery, asked, equal)

    def search(weights: Float32Array, box: base.DegreeBox | None, number: int) -> object:
        return index.search(asked[number], weights, TOP, box)

    ours: dict[str, Task] = {
        "float32": partial(search, equal, None),
        "float32, other weights": partial(search, other, None),
        "float32, a box of 1 %": partial(search, equal, BOX),
    }
    found = medians(tasks | ours)
    index.close()
    limit = min(value for name, value in found.items() if name.startswith("read"))
    faiss = found.get("faiss flat")
    title = f"search {count:,} x {KIND.numbers}, top {TOP} with vectors"
    *whole, box = ours
    return [
        *(Figure(f"{title}, {task}", found[task], "ms", faiss, limit) for task in whole),
        Figure(f"{title}, {box} (peer: NumPy)", found[box], "ms", found["NumPy in a box"]),
        Figure(f"the same by NumPy, {count:,} x {KIND.numbers}", found["NumPy"], "ms", faiss, limit),
    ]


def figures() -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder:
        return [figure for count in TILES for figure in compare(count, Path(folder))]
