"""A Milvus server's costs: `LPN_MILVUS_PYTHON=... python -m tools.bench.milvus [--tiles 20000] [--structure ivf]`.

Starts the server that the tests start, in an environment of its own with `milvus==2.3.5`, adds synthetic descriptors through
`lpn.index.milvus`, has it build its index, and starts the server anew on what it has stored, so that memory is what searching
takes and none of adding. Then it searches with equal weights for the 10 best, with their vectors, one query after another.
Each structure has a server of its own and all the tiles: some minutes for all three at 20,000 tiles, half an hour at 100,000.

Costs, by structure: tiles added a second (their drawing left out); seconds until the index is built, and until a collection is
loaded, once the server is up; its memory beyond that of an empty one, of its own (`anonymous`) and of files that are mapped,
which the system may take back (`mapped`: vectors that answers were read from, where the index has none); on disk what a cluster
has in object storage (vectors, `data`, and `index`) and in its queue (`queue`, for three days), both before the first search.

Searches, by structure and effort: recall at 10 against brute force and the median time, of all tiles and in a box with one
tile of a hundred; and the median time of a search of all right after a write, which waits until the server has it.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from rich.console import Console
from rich.table import Table

from lpn.core.arrays import Float32Array
from lpn.index import DegreeBox
from lpn.index.milvus import MilvusIndex, Structure
from tools.bench.figures import machine
from tools.bench.search import KIND, drawn, medians, nearest, queries, resident
from tools.fixtures.milvus_server import MilvusServer, indexed, milvus_python

K = 10
# Seconds after which searches wait no longer for what was written just before.
SETTLED = 12
WRITES = 5
# With one of a hundred tiles that lie on the whole equator.
BOX: DegreeBox = (-1.0, -1.8, 1.0, 1.8)
EFFORTS: dict[Structure, tuple[int, ...]] = {
    "flat": (1,),
    "ivf": (8, 32, 128),
    "hnsw": (16, 64, 128),
}
COSTS = (
    "add, tiles/s",
    "index, s",
    "load, s",
    "anonymous, MB",
    "mapped, MB",
    "data, MB",
    "index, MB",
    "queue, MB",
)
SEARCHES = ("effort", "recall@10, %", "ms", "in a box, %", "in a box, ms", "after a write, ms")
# The folders of a server's data, each with the column that counts it.
FOLDERS = {
    "insert_log": "data",
    "delta_log": "data",
    "stats_log": "data",
    "index_files": "index",
    "rocksmq": "queue",
    "rocksmq_meta_kv": "queue",
}


def places(count: int) -> Any:
    """Random positions on the equator, (count, 2)."""
    return np.stack([np.zeros(count), np.random.default_rng(3).uniform(-180, 180, count)], axis=1)


def on_disk(place: Path) -> dict[str, float]:
    """Megabytes of a server's data, by kind."""
    sizes: Counter[str] = Counter()
    for file in (place / "data").rglob("*"):
        if file.is_file():
            sizes[FOLDERS.get(file.relative_to(place / "data").parts[0], "")] += file.stat().st_size
    return {name: size / 1e6 for name, size in sizes.items()}


def measure(structure: Structure, count: int, place: Path, rounds: int) -> tuple[list[str], list[list[str]]]:
    """Measure one structure on a server of its own: its costs, and its searches by effort."""
    asked, at = queries(next(drawn(count))[1]), places(count)
    truths = {box: nearest(count, asked, K, None if box is None else abs(at[:, 1]) <= BOX[3]) for box in (None, BOX)}
    with MilvusServer(milvus_python(), place) as server:
        empty, url = resident(server.pid), f"{server.url}/bench"
        adding = 0.0
        with MilvusIndex.create(url, KIND, structure) as index:
            for start, block in drawn(count):
                names = [f"{start + i:07d}" for i in range(len(block))]
                started = time.perf_counter()
                index.add(names, block, at[start : start + len(block)])
                adding += time.perf_counter() - started
        started = time.perf_counter()
        indexed(server.client(), "bench", structure)
        built = time.perf_counter() - started
        disk = on_disk(place)
        server.kill()
        server.start()
        with MilvusIndex(url, patience=300) as index:
            index._client.release_collection("bench")
            started = time.perf_counter()
            index._client.load_collection("bench")
            loaded = time.perf_counter() - started
            time.sleep(SETTLED)
            rows = [searched(index, effort, asked, truths, rounds) for effort in EFFORTS[structure]]
            memory = resident(server.pid)
            block = next(drawn(1))[1]
            for row, effort in zip(rows, EFFORTS[structure], strict=True):
                index._effort = effort
                row.append(f"{after_writes(index, asked, block, at[:1]):.0f}")
    costs = [f"{count / adding:,.0f}", f"{built:.0f}", f"{loaded:.0f}"]
    costs += [f"{memory[name] - empty[name]:,.0f}" for name in ("anonymous", "mapped")]
    return [*costs, *(f"{disk.get(name, 0):,.0f}" for name in ("data", "index", "queue"))], rows


def searched(
    index: MilvusIndex, effort: int, asked: Float32Array, truths: dict[DegreeBox | None, list[set[str]]], rounds: int
) -> list[str]:
    """Effort, then recall and median milliseconds for all tiles and within the box."""
    index._effort = effort
    row = [str(effort)]
    for box, truth in truths.items():
        hits = sum(
            len(best & set(index.search(query, None, K, box).ids)) for best, query in zip(truth, asked, strict=True)
        )
        took = medians({"": lambda i, box=box: index.search(asked[i], None, K, box)}, rounds)[""]  # type: ignore[misc]
        row += [f"{100 * hits / sum(map(len, truth)):.1f}", f"{took:.1f}"]
    return row


def after_writes(index: MilvusIndex, asked: Float32Array, block: Float32Array, at: Any) -> float:
    """Median milliseconds of a search right after one tile was written again."""
    times = []
    for query in asked[:WRITES]:
        index.add([f"{0:07d}"], block[:1], at)
        started = time.perf_counter()
        index.search(query, None, K)
        times.append(1000 * (time.perf_counter() - started))
    return statistics.median(times)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=20_000, help="tiles of each structure; 1000 at least")
    parser.add_argument("--structure", nargs="+", choices=get_args(Structure), default=get_args(Structure))
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument(
        "--folder", type=Path, default=Path(tempfile.gettempdir()), help="where servers keep their data"
    )
    given = parser.parse_args()
    try:
        milvus_python()
    except pytest.skip.Exception as missing:
        raise SystemExit(f"{missing}: it takes one with milvus==2.3.5, as `make .venv/.milvus` makes it.") from None
    if given.tiles < 1000:
        parser.error(f"there are {given.tiles} tiles; expected 1000 or more")
    about = f"Milvus, {given.tiles:,} tiles x {KIND.numbers} in each structure, {machine()}"
    costs = Table("structure", title=f"{about}: costs")
    searches = Table("structure", title=f"{about}: the {K} best with vectors, medians of {given.rounds}")
    for table, columns in ((costs, COSTS), (searches, SEARCHES)):
        for column in columns:
            table.add_column(column, justify="right")
    for structure in given.structure:
        with tempfile.TemporaryDirectory(dir=given.folder) as place:
            cost, rows = measure(structure, given.tiles, Path(place) / "server", given.rounds)
        costs.add_row(structure, *cost)
        for row in rows:
            searches.add_row(structure, *row)
    Console(width=150).print(costs, searches)


if __name__ == "__main__":
    main()
