"""Measured figures, cached in a file so that nothing is measured twice."""

from __future__ import annotations

import json
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import cast

import msgspec

from lpn.core.checksums import crc_of_values
from lpn.core.errors import InputError
from lpn.core.files import write_atomic
from lpn.core.formats import decode_json
from lpn.descriptors.transforms import Change
from lpn.models.base import Model
from lpn.reproduce.paper_values import Values
from lpn.reproduce.sources import TASKS, Source
from lpn.reproduce.tables import Measure, TableRow
from lpn.retrieval.evaluate import Result, evaluate
from lpn.retrieval.protocol import Protocol

log = logging.getLogger(__name__)

FORMAT = "lpn-measured/1"


class MeasuredFigures(msgspec.Struct, frozen=True):
    """The figures of one network.

    Attributes:
        values: in percent, one for each column of the table.
        protocol: the evaluation protocol in one sentence.
    """

    values: Values
    protocol: str


class _MeasurementsFile(msgspec.Struct):
    format: str
    checksum: int
    figures: dict[str, MeasuredFigures]


class MeasurementStore:
    """A cache of measured figures by what they were measured on, in one JSON file with a checksum.

    Raises:
        InputError: when a later version of lpn wrote the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._figures: dict[str, MeasuredFigures] = {}
        try:
            file = decode_json(path.read_bytes(), _MeasurementsFile, path, FORMAT, InputError)
            if file.checksum != crc_of_values(msgspec.to_builtins(file.figures)):
                raise ValueError("another checksum")
            self._figures = file.figures
        except FileNotFoundError:
            pass
        except (OSError, ValueError, RecursionError):
            log.warning("%s cannot be read or is damaged; its figures are measured again.", path)

    def figures(self, row: TableRow, measure: Measure, model: Model, data: Sequence[Source]) -> MeasuredFigures:
        """Return a row's figures, measuring them if they are not cached."""
        digests = [source.test_digest(measure) for source in data]
        key = json.dumps([model.fingerprint, measure, digests, row.rotate, row.parts, row.branch])
        if key not in self._figures:
            results = _measure(row, measure, model, data)
            values = [value for result in results for value in _values(result, measure)]
            self._figures[key] = MeasuredFigures(tuple(values), results[0].sentence)
            figures = msgspec.to_builtins(self._figures)
            file = _MeasurementsFile(FORMAT, crc_of_values(figures), self._figures)
            write_atomic(self.path, msgspec.json.format(msgspec.json.encode(file), indent=1) + b"\n")
        return self._figures[key]


def _measure(row: TableRow, measure: Measure, model: Model, data: Sequence[Source]) -> list[Result]:
    protocol = Protocol(Change(row.rotate), row.parts, row.branch)
    return [evaluate(model, source.dataset, task, protocol) for source in data for task in TASKS[measure]]


def _values(result: Result, measure: Measure) -> Values:
    if measure == "both ways":
        return result.recall["1"], result.ap
    return tuple(result.recall[key] for key in ("1", "5", "10", "1%")) if measure == "ground" else (result.ap,)


def spread(values: Sequence[float]) -> tuple[float, float]:
    """Return the mean of the seeds' values, and half the distance between the lowest and the highest."""
    return sum(values) / len(values), (max(values) - min(values)) / 2


def by_column(seeds: Sequence[Values]) -> list[tuple[float, float]]:
    """Return mean and spread of each column."""
    return [spread(cast("tuple[float, ...]", column)) for column in zip(*seeds, strict=True)]


# The values of each network, by its seed or "given", for each row's label.
Measured = Mapping[str, Mapping[str, Values]]
