"""Measure how faithful evidence is to the model: `python -m tools.bench.faithful [DATA MODEL] [QUERIES]`, or `... faithful lead`.

The curves are those of `tools.fixtures.faithfulness`, as means over queries; the area is the mean of a curve. `lead` measures the
leads of the demo's real flight, with and without the constants on the cells.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path

from rich.console import Console
from rich.table import Table

import lpn
from explorer.cli import Explore
from lpn.core.arrays import FloatingArray
from lpn.core.demo import DEMO
from tools.fixtures.faithfulness import curves, lead_curves

STEPS = 8


def main() -> None:
    """Print the curves."""
    given = sys.argv[1:]
    if given == ["lead"]:
        task = next(iter(Explore().workspaces().open_workspace().tasks.values()))
        title = f"Mean lead of the nearest tile over the second, {len(task.queries)} photos of the demo's real flight"
        leads = lead_curves(task, range(len(task.queries)), STEPS)
        _print(title, {("blurred", name): curve for name, curve in leads.items()})
        return
    data, model = (Path(given[0]), Path(given[1])) if len(given) > 1 else (DEMO, DEMO / "lpn.onnx")
    queries = int(given[-1]) if given and given[-1].isdigit() else 40
    found = curves(data, lpn.load(model), queries, STEPS)
    _print(f"Mean score of {queries} queries with their true tile", found)


def _print(title: str, found: Mapping[tuple[str, str], FloatingArray]) -> None:
    shown = Table(title=title)
    shown.add_column("order")
    for step in range(STEPS + 1):
        shown.add_column(f"{100 * step / STEPS:.0f} %", justify="right")
    shown.add_column("area", justify="right")
    for (kind, name), scores in found.items():
        shown.add_row(f"{kind}, {name}", *(f"{score:.3f}" for score in scores), f"{scores.mean():.3f}")
    Console(width=140).print(shown)


if __name__ == "__main__":
    main()
