"""The answer file of a challenge: the nearest gallery pictures of each query, by name, for a server that keeps the true matches.

A line holds the names of one query's pictures, nearest first, without endings and with tabs between. Lines are in the order of
the queries. This is the form of University160k's `answer.txt`.
"""

from __future__ import annotations

from pathlib import Path

from lpn.core.files import write_atomic
from lpn.retrieval import field_metrics
from lpn.tasks.task import Task

# Number of pictures a query that the server of University160k takes.
DEPTH = 10


def write_answers(task: Task, file: Path) -> int:
    """Write the answers of a task's queries under equal part weights, and return the number of lines.

    Raises:
        OutputError: when the file cannot be written.
        StoreError: when an index cannot be read.
    """
    lines = ["\t".join(task.gallery[tile].path.stem for tile in tiles) for tiles in _nearest(task)]
    write_atomic(file, "".join(f"{line}\n" for line in lines).encode())
    return len(lines)


def _nearest(task: Task) -> list[list[int]]:
    """Return the gallery positions of each query's nearest pictures."""
    if task.lists_gallery:
        nearest: list[list[int]] = field_metrics.nearest(*task.sides(), DEPTH).tolist()
        return nearest
    searches = (task.start_search(query, descriptor) for query, descriptor in enumerate(task.query_descriptors))
    return [search(task.part_weights).order[:DEPTH].tolist() for search in searches]
