"""What is measured for a row, kept in a file so that nothing is measured twice."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

from lpn.datasets import Dataset
from lpn.evaluate import evaluate
from lpn.files import write_whole
from lpn.model import Model
from lpn.reproduce.paper import Values
from lpn.reproduce.tables import Measure, Row


class Notebook:
    """Figures measured so far, by what they were measured on, in one JSON file."""

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            held: Any = json.loads(path.read_bytes())
        except (OSError, ValueError):
            held = {}
        self._held: dict[str, list[float]] = held if isinstance(held, dict) else {}

    def values(self, row: Row, measure: Measure, model: Model, data: Sequence[Dataset]) -> Values:
        """The row's figures in percent, one for each column of its table; measured when they are not there yet."""
        names = [dataset.root.resolve().name for dataset in data]
        key = json.dumps([model.fingerprint, measure, names, row.rotate, row.parts, row.branch])
        if key not in self._held:
            self._held[key] = list(_measured(row, measure, model, data))
            write_whole(self.path, (json.dumps(self._held, indent=1) + "\n").encode())
        return tuple(self._held[key])


def _measured(row: Row, measure: Measure, model: Model, data: Sequence[Dataset]) -> Values:
    if measure == "both ways":
        ways = [
            evaluate(model, data[0], task, row.rotate, row.parts)
            for task in ("drone-to-satellite", "satellite-to-drone")
        ]
        return tuple(value for way in ways for value in (way.recall["1"], way.ap))
    if measure == "ground":
        recall = evaluate(model, data[0], "street-to-satellite").recall
        return tuple(recall[key] for key in ("1", "5", "10", "1%"))
    return tuple(evaluate(model, dataset, "street-to-street", branch=row.branch).ap for dataset in data)


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean of some seeds' values, and half of the distance between the lowest and the highest."""
    return sum(values) / len(values), (max(values) - min(values)) / 2


def by_column(seeds: Sequence[Values]) -> list[tuple[float, float]]:
    """Mean and spread of each column."""
    return [spread(cast("tuple[float, ...]", column)) for column in zip(*seeds, strict=True)]


Measured = Mapping[str, Sequence[Values]]
"""For each row's label, the values of each seed."""
