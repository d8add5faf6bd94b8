"""A Milvus server's costs: `LPN_MILVUS_PYTHON=... python -m bench.milvus [--tiles 100000]`.

Starts the server that the tests start, in an environment of its own with `milvus==2.3.5`, adds synthetic descriptors through
`lpn.index.milvus`, has it build its index, and searches with equal weights for the 10 best, with their vectors, one
query after another. One table: for each structure and effort the recall at 10 against brute force, the median time of a search,
and what the server took to add and to index them, and takes of memory and disk.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.table import Table

from bench.figures import machine
from bench.search import KIND, drawn, filled, medians, nearest, queries
from lpn.index.milvus import MilvusIndex, Structure
from tests.lpn.milvus_server import Server, milvus_python

K = 10
SETTLED = 12
"""Seconds after which searches wait no longer for what was written just before."""
EFFORTS: dict[Structure, tuple[int, ...]] = {
    "flat": (1,),
    "ivf": (1, 8, 32, 128),
    "sq8": (8, 32, 128),
    "hnsw": (16, 64, 256),
}


def indexed(client: Any, name: str, structure: Structure) -> None:
    """Returns when every tile is in the index and that is loaded; flat ones have none."""
    client.flush(name)
    field = client.list_indexes(name)[0]
    while structure != "flat":
        said = client.describe_index(name, field)
        if not int(said["pending_index_rows"]) and int(said["indexed_rows"]) >= int(said["total_rows"]):
            break
        time.sleep(1)
    client.release_collection(name)
    client.load_collection(name)


def resident(pid: int) -> float:
    """Resident memory of a process in MB."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next(int(line.split()[1]) for line in lines if line.startswith("VmRSS")) / 1000


def measure(structure: Structure, count: int, place: Path, rounds: int) -> list[list[str]]:
    """The rows of one structure, on a server of its own."""
    asked = queries(next(drawn(count))[1])
    truth = nearest(count, asked, K)
    rows = []
    with Server(milvus_python(), place) as server:
        empty = resident(server._server)
        index = MilvusIndex.create(f"{server.url}/bench", KIND, structure)
        started = time.perf_counter()
        filled(index, count)
        added = time.perf_counter() - started
        started = time.perf_counter()
        indexed(index._client, "bench", structure)
        built = time.perf_counter() - started
        time.sleep(SETTLED)
        for effort in EFFORTS[structure]:
            index._effort = effort
            hits = sum(len(truth[i] & set(index.search(query, None, K).ids)) for i, query in enumerate(asked))
            took = medians({"": lambda i: index.search(asked[i], None, K)}, rounds)[""]
            found = [structure, str(effort), f"{100 * hits / (K * len(asked)):.1f}", f"{took:.1f}"]
            memory = f"{resident(server._server) - empty:,.0f}"
            disk = sum(file.stat().st_size for file in place.rglob("*") if file.is_file()) / 1e6
            rows.append([*found, f"{added:.0f}", f"{built:.0f}", memory, f"{disk:,.0f}"])
        index.close()
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tiles", type=int, default=100_000)
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument(
        "--folder", type=Path, default=Path(tempfile.gettempdir()), help="where servers keep their data"
    )
    given = parser.parse_args()
    title = (
        f"Milvus, {given.tiles:,} tiles x {KIND.numbers}, top {K} with vectors, {machine()}, medians of {given.rounds}"
    )
    table = Table(title=title)
    for column in ("structure", "effort", "recall@10, %", "ms", "add, s", "index, s", "memory, MB", "disk, MB"):
        table.add_column(column, justify="right")
    for structure in EFFORTS:
        with tempfile.TemporaryDirectory(dir=given.folder) as place:
            for row in measure(structure, given.tiles, Path(place) / "server", given.rounds):
                table.add_row(*row)
    Console(width=120).print(table)


if __name__ == "__main__":
    main()
