"""One query against a gallery: `python -m bench.search`.

The peers are NumPy's product with the whole gallery and a partial sort, and faiss's flat index. Ours is
`lpn.index.ExactIndex`, memory-mapped, in the three precisions, with equal and with other part weights; it gives names, scores,
and the vectors of the top 100, as the peers do. The limit is reading the vectors once, by the quickest of a few ways to
read them; float16 and int8 are to take half of what float32 may. All take turns in one process, and the tables give medians.

Descriptors are drawn about centres, as those of places are. `--growth` makes the table of larger galleries, up to a million
tiles, of which one index at a time lies on disk (8 kB a tile, at most 12, and as much again while segments are gathered);
`--recall` that of faiss's inverted lists; both leave out the other figures.
"""

from __future__ import annotations

import argparse
import itertools
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from rich.console import Console
from rich.table import Table

import bench.figures
from bench.figures import Figure, below, machine, show, within
from lpn import explain
from lpn.index import ExactIndex, Kind
from lpn.index.scan import PRECISIONS
from lpn.machine import usable_cores
from lpn.model import FloatArray, normalise

KIND = Kind("bench", 4, 512)
TILES = (951, 51_355)
SMALL = 1000
"""Tiles up to which a search is to take a millisecond at most."""
OTHER = (0.5, 0.3, 0.2, 0.0)
TOP = 100
THREADS = min(8, usable_cores())
BLOCK = 4096
QUERIES = 20
Task = Callable[[int], object]


def drawn(count: int, seed: int = 0) -> Iterator[tuple[int, FloatArray]]:
    """Descriptors in blocks, each with the number of its first: 20 tiles about each centre, and centres about one mean."""
    for start in range(0, count, BLOCK):
        rng = np.random.default_rng([seed, start])
        size = min(BLOCK, count - start)
        shape = (KIND.n_parts, KIND.embedding)
        centres = rng.standard_normal((size // 20 + 1, *shape), np.float32)
        about = centres[np.arange(size) // 20] + 0.7 * rng.standard_normal((size, *shape), np.float32)
        yield start, normalise(about + np.random.default_rng(7).standard_normal(shape, np.float32))


def queries(gallery: FloatArray) -> FloatArray:
    """Tiles seen otherwise: some of them with noise of their own, (Q, n, D)."""
    rng = np.random.default_rng(1)
    chosen = gallery[rng.integers(0, len(gallery), QUERIES)]
    noise = rng.standard_normal(chosen.shape, np.float32) / np.float32(KIND.numbers**0.5)
    return normalise(chosen + np.float32(0.8) * noise)


def medians(tasks: dict[str, Task], rounds: int) -> dict[str, float]:
    """Median milliseconds of each task; each round has another query."""
    numbers = {name: itertools.count() for name in tasks}
    each = {name: lambda name=name: tasks[name](next(numbers[name]) % QUERIES) for name in tasks}
    return bench.figures.medians(each, rounds)


def readers(rows: FloatArray) -> dict[str, Task]:
    """Ways to read every number once, shared by threads."""
    # As integers, of which a sum waits for none before it.
    numbers = rows.reshape(-1).view(np.int32)
    shares = np.array_split(numbers, THREADS)
    pool = ThreadPoolExecutor(THREADS)
    return {
        f"read by {name}": lambda _, how=how: list(pool.map(how, shares))
        for name, how in {"or": np.bitwise_or.reduce, "max": np.max}.items()
    }


def top(scores: FloatArray) -> Any:
    """Positions of the highest scores, in order."""
    k = min(TOP, len(scores))
    found = np.argpartition(scores, len(scores) - k)[len(scores) - k :]
    return found[np.argsort(-scores[found])]


def peers(gallery: FloatArray, asked: FloatArray, weights: FloatArray) -> dict[str, Task]:
    """NumPy, and faiss where it is installed; both give positions, scores, and vectors."""
    flat = gallery.reshape(len(gallery), KIND.numbers)
    vectors = [KIND.rescaled(query, weights).astype(np.float32) for query in asked]

    def by_numpy(number: int) -> object:
        scores = flat @ vectors[number]
        found = top(scores)
        return found, scores[found], flat[found]

    tasks: dict[str, Task] = {"NumPy": by_numpy}
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
    """An index with a gallery added in blocks."""
    for start, block in drawn(count):
        index.add([f"{start + i:07d}" for i in range(len(block))], block)
    return index


def compare(count: int, folder: Path, rounds: int) -> list[Figure]:
    """The figures of one gallery."""
    gallery = np.concatenate([block for _, block in drawn(count)])
    asked = queries(gallery)
    equal, other = explain.part_weights(KIND.n_parts), explain.part_weights(KIND.n_parts, OTHER)
    indexes = {name: filled(ExactIndex.create(folder / f"{count}-{name}", KIND, name), count) for name in PRECISIONS}
    tasks = readers(gallery) | peers(gallery, asked, equal)
    for name, index in indexes.items():
        for said, weights in (("", equal), (", other weights", other)):
            tasks[f"{name}{said}"] = lambda i, index=index, weights=weights: index.search(asked[i], weights, TOP)
    found = medians(tasks, rounds)
    for index in indexes.values():
        index.close()
    limit = min(value for name, value in found.items() if name.startswith("read"))
    faiss = found.get("faiss flat")
    title = f"search {count:,} x {KIND.numbers}, top {TOP} with vectors"
    made = []
    for name in (name for name in found if name.startswith(PRECISIONS)):
        what = f"{title}, {name}"
        if count <= SMALL:
            made.append(below(what, found[name], 1, peer=faiss))
        elif name.startswith("float32"):
            made.append(within(what, found[name], limit, 1.3, peer=faiss))
        else:
            made.append(Figure(what, found[name], "ms", faiss, limit, "0.65 x limit", found[name] <= 0.65 * limit))
    made.append(Figure(f"the same by NumPy, {count:,} x {KIND.numbers}", found["NumPy"], "ms", faiss, limit))
    return made


def grow(counts: list[int], folder: Path, rounds: int, console: Console) -> None:
    """Time, disk, and memory against the size of the gallery; a process for each row, and one index on disk at a time."""
    table = Table(title=f"growth, top {TOP} with vectors, {machine()}, medians of {rounds}")
    for column in (
        "tiles",
        "index",
        "add, s",
        "first search, ms",
        "search, ms",
        "disk, MB",
        "memory, MB",
        "with maps, MB",
    ):
        table.add_column(column, justify="right")
    for count in counts:
        for name in PRECISIONS:
            command = [sys.executable, "-m", "bench.search", "--row", name, "--tiles", str(count)]
            command += ["--rounds", str(rounds), "--folder", str(folder)]
            done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True)
            table.add_row(f"{count:,}", name, *json.loads(done.stdout))
    console.print(table)


def row(count: int, name: Any, folder: Path, rounds: int) -> list[str]:
    """One row of the growth table, in this process."""
    with tempfile.TemporaryDirectory(dir=folder) as place:
        with ProcessPoolExecutor(1) as another:  # whose memory is not counted
            added = another.submit(added_seconds, count, name, Path(place) / "index").result()
        asked = queries(next(drawn(count))[1])
        before = anonymous()
        index = ExactIndex(Path(place) / "index")
        started = time.perf_counter()
        index.search(asked[0], None, TOP)
        first = time.perf_counter() - started
        took = medians({"": lambda i: index.search(asked[i], None, TOP)}, rounds)[""]
        disk = sum(file.stat().st_size for file in Path(place).rglob("*") if file.is_file())
        own = anonymous() - before
        index.close()
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    return [f"{added:.1f}", f"{1000 * first:.1f}", f"{took:.2f}", f"{disk / 1e6:,.0f}", f"{own:,.0f}", f"{peak:,.0f}"]


def added_seconds(count: int, name: Any, folder: Path) -> float:
    """Make an index of a drawn gallery; the seconds without those of drawing."""
    index, seconds = ExactIndex.create(folder, KIND, name), 0.0
    for start, block in drawn(count):
        names = [f"{start + i:07d}" for i in range(len(block))]
        began = time.perf_counter()
        index.add(names, block)
        seconds += time.perf_counter() - began
    index.close()
    return seconds


def anonymous() -> float:
    """Resident memory of this process that is of no file, in MB."""
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("RssAnon")) / 1000


def nearest(count: int, asked: FloatArray, k: int) -> list[set[str]]:
    """The true k nearest of each query, by drawing the gallery once more."""
    vectors = np.stack([KIND.rescaled(query, None).astype(np.float32) for query in asked])
    best = np.full((len(asked), k), -np.inf, np.float32)
    names = np.zeros((len(asked), k), np.int64)
    for start, block in drawn(count):
        scores = np.concatenate([best, vectors @ block.reshape(len(block), KIND.numbers).T], axis=1)
        of = np.concatenate([names, np.broadcast_to(start + np.arange(len(block)), (len(asked), len(block)))], axis=1)
        order = np.argsort(-scores, axis=1)[:, :k]
        best, names = np.take_along_axis(scores, order, 1), np.take_along_axis(of, order, 1)
    return [{f"{name:07d}" for name in row} for row in names.tolist()]


def recall(count: int, folder: Path, rounds: int, codes: Any, console: Console) -> None:
    """Recall at 10 against time of faiss's inverted lists, by how many are looked through."""
    from lpn.index.faiss import FaissIndex

    table = Table(title=f"faiss {codes} on {count} tiles x {KIND.numbers}, top 10, {machine()}, medians of {rounds}")
    for column in ("nprobe", "depth", "recall@10, %", "ms"):
        table.add_column(column, justify="right")
    asked = queries(next(drawn(count))[1])
    with tempfile.TemporaryDirectory(dir=folder) as place:
        index = FaissIndex.create(Path(place) / "index", KIND, codes)
        started = time.perf_counter()
        filled(index, count)
        added = time.perf_counter() - started
        truth = nearest(count, asked, 10)
        for nprobe, depth in ((1, 4), (4, 4), (16, 8), (32, 8), (64, 16), (128, 32)):
            index.nprobe, index.depth = nprobe, depth
            hits = sum(len(truth[i] & set(index.search(query, None, 10).ids)) for i, query in enumerate(asked))
            took = medians({"": lambda i: index.search(asked[i], None, 10)}, rounds)[""]
            table.add_row(str(nprobe), str(depth), f"{100 * hits / (10 * len(asked)):.1f}", f"{took:.2f}")
        index.close()
    console.print(table, f"Added in {added:.0f} s, lists and codes learnt.")


def figures(counts: Sequence[int] = TILES, folder: Path | None = None, rounds: int = 20) -> list[Figure]:
    """The figures of some galleries."""
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
    parser.add_argument("--codes", choices=("sq8", "pq"), default="pq", help="of faiss in that table")
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
