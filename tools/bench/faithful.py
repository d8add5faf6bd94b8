"""Whether evidence points at what matters: `python -m tools.bench.faithful [DATA MODEL] [QUERIES]`.

For queries with their true tile, the cells of the query are blurred one after the other (deletion), or come back in a blurred
picture (insertion), in the order of their evidence, at random, and from the centre outwards. Good evidence makes the score
fall soon in the first and rise soon in the second. Figures are means over queries; the area is the curve's mean.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from rich.console import Console
from rich.progress import track
from rich.table import Table

import lpn
from lpn import explain, retrieval
from lpn.core import images
from lpn.core.demo import DEMO
from lpn.datasets import open_dataset
from lpn.explain import occlusion
from lpn.models.base import Model
from lpn.retrieval import scoring

STEPS = 8


def curves(data: Path, model: Model, queries: int, steps: int = STEPS) -> dict[tuple[str, str], np.ndarray]:
    """Mean scores (steps + 1,) by "deletion" or "insertion" and order, over queries from all over the list."""
    dataset, rng = open_dataset(data), np.random.default_rng(0)
    tiles = {entry.label: entry for entry in dataset.gallery("satellite")}
    entries = [entry for entry in dataset.queries("drone") if entry.label in tiles]
    chosen = [entries[len(entries) * i // queries] for i in range(queries)]
    sums: dict[tuple[str, str], np.ndarray] = {}
    weights = scoring.part_weights(model.n_parts)
    for entry in track(chosen, "Covering", console=Console(stderr=True)):
        picture = images.load_picture(entry.path)
        query = retrieval.describe_picture(model, picture, "drone")
        tile = retrieval.describe_picture(model, images.load_picture(tiles[entry.label].path), "satellite")
        assert query.trace is not None
        total = explain.side(query.trace, tile.descriptor).total(weights).reshape(-1)
        size = query.trace.size
        orders = {
            "evidence": [int(cell) for cell in np.argsort(-total, kind="stable")],
            "random": [int(cell) for cell in rng.permutation(total.size)],
            "centre first": occlusion.centre_first(size),
        }
        for name, order in orders.items():
            for kind in ("deletion", "insertion"):
                found = occlusion.curve(
                    model, picture, "drone", tile.descriptor, weights, order, size, steps, kind == "insertion"
                )
                sums[kind, name] = sums.get((kind, name), 0) + found / queries
    return sums


def main() -> None:
    """Print the curves."""
    given = sys.argv[1:]
    data, model = (Path(given[0]), Path(given[1])) if len(given) > 1 else (DEMO, DEMO / "lpn.onnx")
    queries = int(given[-1]) if given and given[-1].isdigit() else 40
    found = curves(data, lpn.load(model), queries)
    shown = Table(title=f"Mean score of {queries} queries with their true tile")
    shown.add_column("order")
    for step in range(STEPS + 1):
        shown.add_column(f"{100 * step / STEPS:.0f} %", justify="right")
    shown.add_column("area", justify="right")
    for (kind, name), scores in found.items():
        shown.add_row(f"{kind}, {name}", *(f"{score:.3f}" for score in scores), f"{scores.mean():.3f}")
    Console(width=140).print(shown)


if __name__ == "__main__":
    main()
