"""Measured figures and tables, kept in a file so that nothing is measured twice."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from pathlib import Path

import msgspec
import numpy as np

from lpn.core.checksums import crc_of_values
from lpn.core.errors import InputError
from lpn.core.files import exclusive_lock, write_json
from lpn.core.formats import decode_json
from lpn.explain.centre import VIEWS, centre_box, centre_shares
from lpn.models.base import Model
from lpn.reproduce.record import TableRecord
from lpn.reproduce.sources import TASKS, Source
from lpn.reproduce.tables import Measure, TableRow, Values
from lpn.tasks.changes import turned, with_parts
from lpn.tasks.measure import Result
from lpn.tasks.opening import lazy_task
from lpn.training.provenance import Provenance, here

log = logging.getLogger(__name__)

FORMAT = "lpn-measured/3"
_CENTRE = (
    "Protocol: the last feature map of each test picture without its mirror, summed over channels; the share of the sum in the "
    "cells whose centres lie in the middle half of height and width, which are {}; mean over pictures."
)


class MeasuredFigures(msgspec.Struct, frozen=True):
    """The figures of one network.

    Attributes:
        values: in percent, one for each column of the table.
        protocol: the evaluation protocol in one sentence.
        made: where the figures come from.
    """

    values: Values
    protocol: str
    made: Provenance


class _MeasurementsFile(msgspec.Struct):
    format: str
    checksum: int
    figures: dict[str, MeasuredFigures]
    tables: dict[str, TableRecord]


class MeasurementStore:
    """A cache of measured figures by what they were measured on, and the tables made of them, in one JSON file.

    Several processes may use the same file: each reads it again before it adds to it.

    Raises:
        InputError: when a later version of lpn wrote the file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._file = self._read()

    def figures(
        self, row: TableRow, measure: Measure, model: Model, data: Sequence[Source], released: bool = False
    ) -> MeasuredFigures:
        """Return a row's figures, measuring them if they are not cached; see `Scale.released`."""
        digests = [source.test_digest(measure) for source in data]
        key = json.dumps(
            [model.fingerprint, measure, digests, row.rotate, row.parts, row.branch]
            + (["released"] if released else [])
        )
        if key not in self._file.figures:
            self._add(_measured(row, measure, model, data, released), key)
        return self._file.figures[key]

    def reload(self) -> None:
        """Read the file again, for what other processes have added."""
        self._file = self._read()

    def keep(self, table: TableRecord) -> None:
        """Write a finished table into the file."""
        self._add(table, table.key)

    def _add(self, value: MeasuredFigures | TableRecord, key: str) -> None:
        with exclusive_lock(self.path.parent, wait=True):
            self._file = self._read()
            if isinstance(value, TableRecord):
                self._file.tables[key] = value
            else:
                self._file.figures[key] = value
            self._file.checksum = _checksum(self._file)
            write_json(self.path, msgspec.to_builtins(self._file), ensure_ascii=False)

    def _read(self) -> _MeasurementsFile:
        try:
            return read_measurements(self.path)
        except FileNotFoundError:
            pass
        except (OSError, ValueError, RecursionError):
            log.warning("%s cannot be read or is damaged; its figures are measured again.", self.path)
        return _MeasurementsFile(FORMAT, 0, {}, {})


def read_measurements(path: Path) -> _MeasurementsFile:
    """Read a file of measured figures.

    Raises:
        InputError: when a later version of lpn wrote it.
        OSError, ValueError, RecursionError: when it cannot be read, or is damaged.
    """
    file = decode_json(path.read_bytes(), _MeasurementsFile, path, FORMAT, InputError)
    if file.checksum != _checksum(file):
        raise ValueError("another checksum")
    return file


def _checksum(file: _MeasurementsFile) -> int:
    return crc_of_values(json.loads(msgspec.json.encode([file.figures, file.tables])))


def _measured(row: TableRow, measure: Measure, model: Model, data: Sequence[Source], released: bool) -> MeasuredFigures:
    if measure == "centre":
        means = tuple(
            100 * float(np.mean(list(centre_shares(model, data[0].dataset.gallery(view), view)))) for view in VIEWS
        )
        return MeasuredFigures(means, _CENTRE.format(_box(model)), here())
    tasks = (
        lazy_task(model, source.dataset, task, branch=row.branch, released=released)
        for source in data
        for task in TASKS[measure]
    )
    results = [with_parts(turned(task, row.rotate) if row.rotate else task, row.parts).evaluate() for task in tasks]
    return MeasuredFigures(
        tuple(value for result in results for value in _values(result, measure)), results[0].sentence, here()
    )


def _box(model: Model) -> str:
    """Give the centre's share of the cells, which is a quarter only if sides are multiples of four."""
    sizes = dict.fromkeys(model.map_size(view) for view in VIEWS)
    return " or ".join(f"{100 * centre_box(*size).mean():.1f} % of {size[0]} x {size[1]} cells" for size in sizes)


def _values(result: Result, measure: Measure) -> Values:
    if measure == "both ways":
        return result.recall["1"], result.ap
    return tuple(result.recall[key] for key in ("1", "5", "10", "1%")) if measure == "ground" else (result.ap,)
