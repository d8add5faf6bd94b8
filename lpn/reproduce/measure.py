"""What is measured for a row, kept in a file so that nothing is measured twice."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

from lpn.core.checksums import crc_of_values
from lpn.core.errors import InputError
from lpn.core.files import write_atomic
from lpn.core.formats import is_newer, newer_version
from lpn.descriptors.transforms import Change
from lpn.models.base import Model
from lpn.reproduce.paper_values import Values
from lpn.reproduce.sources import TASKS, Source
from lpn.reproduce.tables import Measure, TableRow
from lpn.retrieval.evaluate import Result, evaluate
from lpn.retrieval.protocol import Protocol

log = logging.getLogger(__name__)

FORMAT = "lpn-measured/1"


@dataclass(frozen=True)
class MeasuredFigures:
    """What a network did.

    Attributes:
        values: in percent, one for each column of the table.
        protocol: how they were measured, in one sentence.
    """

    values: Values
    protocol: str


class MeasurementStore:
    """Figures measured so far, by what they were measured on, in one JSON file with a checksum of itself.

    Raises:
        InputError: when a later version wrote the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._held: dict[str, MeasuredFigures] = {}
        try:
            self._held = _figures(json.loads(path.read_bytes()), path)
        except FileNotFoundError:
            pass
        except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError):
            log.warning("%s cannot be read or is damaged; what it held is measured again.", path)

    def figures(self, row: TableRow, measure: Measure, model: Model, data: Sequence[Source]) -> MeasuredFigures:
        """The row's figures; measured when they are not there yet."""
        digests = [source.test_digest(measure) for source in data]
        key = json.dumps([model.fingerprint, measure, digests, row.rotate, row.parts, row.branch])
        if key not in self._held:
            results = _measured(row, measure, model, data)
            values = [value for result in results for value in _values(result, measure)]
            self._held[key] = MeasuredFigures(tuple(values), results[0].said)
            figures = {key: asdict(figures) for key, figures in self._held.items()}
            whole = {"format": FORMAT, "checksum": crc_of_values(figures), "figures": figures}
            write_atomic(self.path, (json.dumps(whole, indent=1) + "\n").encode())
        return self._held[key]


def _figures(held: Any, path: Path) -> dict[str, MeasuredFigures]:
    """What a notebook's file holds; an earlier version's is the figures alone."""
    if "format" in held:
        if is_newer(held["format"], FORMAT):
            raise InputError(newer_version(path, held["format"], FORMAT))
        figures = held["figures"]
        if held["format"] != FORMAT or held["checksum"] != crc_of_values(figures):
            raise ValueError("another format or checksum")
        held = figures
    return {key: MeasuredFigures(tuple(map(float, v["values"])), str(v["protocol"])) for key, v in held.items()}


def _measured(row: TableRow, measure: Measure, model: Model, data: Sequence[Source]) -> list[Result]:
    protocol = Protocol(Change(row.rotate), row.parts, row.branch)
    return [evaluate(model, source.dataset, task, protocol) for source in data for task in TASKS[measure]]


def _values(result: Result, measure: Measure) -> Values:
    if measure == "both ways":
        return result.recall["1"], result.ap
    return tuple(result.recall[key] for key in ("1", "5", "10", "1%")) if measure == "ground" else (result.ap,)


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Mean of some seeds' values, and half of the distance between the lowest and the highest."""
    return sum(values) / len(values), (max(values) - min(values)) / 2


def by_column(seeds: Sequence[Values]) -> list[tuple[float, float]]:
    """Mean and spread of each column."""
    return [spread(cast("tuple[float, ...]", column)) for column in zip(*seeds, strict=True)]


Measured = Mapping[str, Mapping[str, Values]]
"""For each row's label, the values of each network: by its seed, or "given"."""
