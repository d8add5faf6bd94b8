"""One query against a gallery: `python -m tools.bench.search`.

The peers are NumPy's product with the whole gallery and a partial sort, and faiss's flat index. Ours is
`lpn.index.ExactIndex`, memory-mapped, in the three precisions, with equal and with other part weights; it gives names, scores,
and the vectors of the top 100, as the peers do. The limit is reading the vectors once, by the quickest of a few ways to
read them; float16 and int8 have no target. All take turns in one process, and the tables give medians.

Descriptors are drawn about centres, as those of places are, and positions uniformly over a rectangle, of which a box holds a
hundredth; there, NumPy picks out the tiles within and scores these. `--growth` makes the table of larger galleries, up to a
million tiles, of which one index at a time lies on disk (8 kB a tile, at most 12, and as much again while segments are
gathered); `--recall` that of faiss's inverted lists, for each of `--codes`; both leave out the other figures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import AbstractContextManager
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Any, get_args

import numpy as np
from rich.console import Console
from rich.table import Table

from lpn.core.arrays import Float32Array, Float64Array
from lpn.core.resources import usable_cores
from lpn.descriptors import Precision
from lpn.index import DegreeBox, DescriptorKind, ExactIndex, base
from lpn.models.base import normalise
from lpn.retrieval import scoring
from tools.bench import figures as measuring
from tools.bench.figures import Figure, below, machine, show, within

PRECISIONS: tuple[Precision, ...] = get_args(Precision)
KIND = DescriptorKind("bench", 4, 512)
TILES = (951, 51_355)
# Tiles up to which a search is to take a millisecond at most.
SMALL = 1000
OTHER = (0.5, 0.3, 0.2, 0.0)
# South-west and north-east of the rectangle over which tiles lie.
CORNERS = (46.0, 6.0), (47.0, 8.0)
# Has a hundredth of its area.
BOX: DegreeBox = (46.4, 6.6, 46.5, 6.8)
TOP = 100
THREADS = min(8, usable_cores())
BLOCK = 4096
QUERIES = 20
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


def medians(tasks: dict[str, Task], rounds: int) -> dict[str, float]:
    """Median milliseconds of each task; each round has another query."""
    numbers = {name: itertools.count() for name in tasks}

    def run(name: str) -> object:
        return tasks[name](next(numbers[name]) % QUERIES)

    return measuring.medians({name: partial(run, name) for name in tasks}, rounds)


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
    vectors = [KIND.rescaled(query, weights).astype(np.float32) for query in asked]

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


def compare(count: int, folder: Path, rounds: int) -> list[Figure]:
    """Measure one gallery."""
    gallery = np.concatenate([block for _, block in drawn(count)])
    asked = queries(gallery)
    equal, other = scoring.part_weights(KIND.n_parts), scoring.part_weights(KIND.n_parts, OTHER)
    indexes = {name: filled(ExactIndex.create(folder / f"{count}-{name}", KIND, name), count) for name in PRECISIONS}
    tasks = readers(gallery) | peers(gallery, asked, equal)

    def search(index: ExactIndex, weights: Float32Array, box: base.DegreeBox | None, number: int) -> object:
        return index.search(asked[number], weights, TOP, box)

    for name, index in indexes.items():
        for said, weights in (("", equal), (", other weights", other)):
            tasks[f"{name}{said}"] = partial(search, index, weights, None)
        tasks[f"{name}, a box of 1 %"] = partial(search, index, equal, BOX)
    found = medians(tasks, rounds)
    for index in indexes.values():
        index.close()
    limit = min(value for name, value in found.items() if name.startswith("read"))
    faiss = found.get("faiss flat")
    title = f"search {count:,} x {KIND.numbers}, top {TOP} with vectors"
    made = []
    for task in (task for task in found if task.startswith(PRECISIONS)):
        what = f"{title}, {task}"
        if task.endswith("1 %"):
            made.append(Figure(f"{what} (peer: NumPy)", found[task], "ms", found["NumPy in a box"]))
        elif count <= SMALL:
            made.append(below(what, found[task], 1, peer=faiss))
        elif task.startswith("float32"):
            made.append(within(what, found[task], limit, 1.3, peer=faiss))
        else:
            made.append(Figure(what, found[task], "ms", faiss, limit))
    made.append(Figure(f"the same by NumPy, {count:,} x {KIND.numbers}", found["NumPy"], "ms", faiss, limit))
    return made


def grow(counts: list[int], folder: Path, rounds: int, console: Console) -> None:
    """Print time, disk, and memory by size of the gallery, with a process for each row and one index on disk at a time."""
    table = Table(title=f"growth, top {TOP} with vectors, {machine()}, medians of {rounds}")
    for column in (
        "tiles",
        "index",
        "add, s",
        "first search, ms",
        "search, ms",
        "in a box of 1 %, ms",
        "disk, MB",
        "peak of anonymous memory in searches, MB",
        "with maps, MB",
    ):
        table.add_column(column, justify="right")
    for count in counts:
        for name in PRECISIONS:
            command = [sys.executable, "-m", "tools.bench.search", "--row", name, "--tiles", str(count)]
            command += ["--rounds", str(rounds), "--folder", str(folder)]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            table.add_row(f"{count:,}", name, *json.loads(done.stdout))
    console.print(table)


def row(count: int, name: Any, folder: Path, rounds: int) -> list[str]:
    """Measure one row of that table in this process."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        with ProcessPoolExecutor(1) as another:  # whose memory is not counted
            added = another.submit(added_seconds, count, name, Path(place) / "index").result()
        asked = queries(next(drawn(count))[1])
        before = anonymous()
        index = ExactIndex(Path(place) / "index")
        started = time.perf_counter()
        index.search(asked[0], None, TOP)
        first = time.perf_counter() - started
        tasks: dict[str, Task] = {"all": lambda i: index.search(asked[i], None, TOP)}
        tasks["box"] = lambda i: index.search(asked[i], None, TOP, BOX)
        took = medians(tasks, rounds)
        # By searches of their own: looking takes the processor's time from what is measured.
        with Peak() as peak:
            for task in tasks.values():
                for number in range(QUERIES):
                    task(number)
        disk = sum(file.stat().st_size for file in Path(place).rglob("*") if file.is_file())
        index.close()
    maps = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    figures = [f"{added:.1f}", f"{1000 * first:.1f}", f"{took['all']:.2f}", f"{took['box']:.2f}"]
    return [*figures, f"{disk / 1e6:,.0f}", f"{peak.most - before:,.0f}", f"{maps:,.0f}"]


def added_seconds(count: int, name: Any, folder: Path) -> float:
    """Make an index of a drawn gallery, and return the seconds without drawing."""
    index, seconds = ExactIndex.create(folder, KIND, name), 0.0
    for start, block in drawn(count):
        names = [f"{start + i:07d}" for i in range(len(block))]
        began = time.perf_counter()
        index.add(names, block, places(start, len(block)))
        seconds += time.perf_counter() - began
    index.close()
    return seconds


def resident(process: int | str = "self") -> dict[str, float]:
    """Resident memory of a process in MB: its own (`anonymous`), and that of files (`mapped`)."""
    lines = [line.split() for line in Path(f"/proc/{process}/status").read_text().splitlines()]
    values = {line[0]: int(line[1]) / 1000 for line in lines if line and line[0].startswith("Rss")}
    return {"anonymous": values["RssAnon:"], "mapped": values["RssFile:"]}


def anonymous() -> float:
    """Resident memory of this process without mapped files, in MB."""
    return resident()["anonymous"]


class Peak(AbstractContextManager["Peak"]):
    """Records the peak of `anonymous`, sampled about every half millisecond."""

    def __init__(self) -> None:
        self.most = anonymous()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._look)

    def __enter__(self) -> Peak:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()

    def _look(self) -> None:
        while not self._ended.wait(0.0005):
            self.most = max(self.most, anonymous())


def nearest(count: int, asked: Float32Array, k: int, among: Any = None) -> list[set[str]]:
    """True k nearest tiles of each query, from the gallery drawn again; `among`, (count,) bool, selects tiles."""
    vectors = np.stack([KIND.rescaled(query, None).astype(np.float32) for query in asked])
    best = np.full((len(asked), k), -np.inf, np.float32)
    names = np.zeros((len(asked), k), np.int64)
    for start, block in drawn(count):
        found = vectors @ block.reshape(len(block), KIND.numbers).T
        if among is not None:
            found = np.where(among[start : start + len(block)], found, -np.inf)
        scores = np.concatenate([best, found], axis=1)
        of = np.concatenate([names, np.broadcast_to(start + np.arange(len(block)), (len(asked), len(block)))], axis=1)
        order = np.argsort(-scores, axis=1)[:, :k]
        best, names = np.take_along_axis(scores, order, 1), np.take_along_axis(of, order, 1)
    return [{f"{name:07d}" for name in row} for row in names.tolist()]


def recall(count: int, folder: Path, rounds: int, every: Sequence[Any], console: Console) -> None:
    """Print recall at 10 and time of faiss's inverted lists by number of probed lists, a table per code."""
    asked = queries(next(drawn(count))[1])
    truth = nearest(count, asked, 10)
    for codes in every:
        recall_of(codes, count, asked, truth, folder, rounds, console)


def recall_of(
    codes: Any, count: int, asked: Float32Array, truth: list[set[str]], folder: Path, rounds: int, console: Console
) -> None:
    """Print one of these tables."""
    from lpn.index.faiss import FaissIndex

    table = Table(title=f"faiss {codes} on {count} tiles x {KIND.numbers}, top 10, {machine()}, medians of {rounds}")
    for column in ("nprobe", "depth", "recall@10, %", "ms"):
        table.add_column(column, justify="right")
    with tempfile.TemporaryDirectory(dir=folder) as place:
        index = FaissIndex.create(Path(place) / "index", KIND, codes)
        started = time.perf_counter()
        filled(index, count)
        added = time.perf_counter() - started
        for nprobe, depth in ((1, 4), (4, 4), (16, 8), (32, 8), (64, 16), (128, 32)):
            index.nprobe, index.depth = nprobe, depth
            hits = sum(len(truth[i] & set(index.search(query, None, 10).ids)) for i, query in enumerate(asked))
            took = medians({"": lambda i: index.search(asked[i], None, 10)}, rounds)[""]
            table.add_row(str(nprobe), str(depth), f"{100 * hits / (10 * len(asked)):.1f}", f"{took:.2f}")
        index.close()
    console.print(table, f"Added in {added:.0f} s, lists and codes learnt.")


def figures(counts: Sequence[int] = TILES, folder: Path | None = None, rounds: int = 20) -> list[Figure]:
    """Measure some galleries."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        return [figure for count in counts for figure in compare(count, Path(place), rounds)]


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, nargs="+", default=TILES, help="sizes of the galleries compared")
    parser.add_argument(
        "--growth", type=int, nargs="*", help="sizes of the growth table; 10^3 to 10^6 when none is given"
    )
    parser.add_argument(
        "--recall", type=int, default=0, help="tiles for the table of recall against time, such as 1000000"
    )
    parser.add_argument(
        "--codes", choices=("sq8", "pq"), nargs="+", default=("pq",), help="codes of faiss in such tables"
    )
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--folder", type=Path, default=Path(tempfile.gettempdir()), help="where indexes are made")
    parser.add_argument("--row", choices=PRECISIONS, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.row:
        print(json.dumps(row(given.tiles[0], given.row, given.folder, given.rounds)))
        return
    console = Console(width=120)
    if given.growth is None and not given.recall:
        show("One query against a gallery", figures(given.tiles, given.folder, given.rounds))
    if given.growth is not None:
        grow(given.growth or [10**3, 10**4, 10**5, 10**6], given.folder, given.rounds, console)
    if given.recall:
        recall(given.recall, given.folder, given.rounds, given.codes, console)


if __name__ == "__main__":
    main()
