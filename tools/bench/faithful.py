"""Measure how faithful evidence is to the model: `python -m tools.bench.faithful [DATA MODEL] [QUERIES]`.

The curves are those of `tools.fixtures.faithfulness`, as means over queries; the area is the mean of a curve.
"""

from __future__ import annotations

import sys
from pathlib import Path

from rich.console import Console
from rich.table import Table

import lpn
from lpn.core.demo import DEMO
from tools.fixtures.faithfulness import curves

STEPS = 8


def main() -> None:
    """Print the curves."""
    given = sys.argv[1:]
    data, model = (Path(given[0]), Path(given[1])) if len(given) > 1 else (DEMO, DEMO / "lpn.onnx")
    queries = int(given[-1]) if given and given[-1].isdigit() else 40
    found = curves(data, lpn.load(model), queries, STEPS)
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
