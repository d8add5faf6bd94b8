"""Measured figures and tables in a file, so that nothing is measured twice."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import cast

import msgspec
import numpy as np
import torch
from torch import nn

from lpn.core.arrays import BoolArray, FloatingArray
from lpn.core.checksums import crc_of_values
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import exclusive_lock, fingerprint, write_json
from lpn.core.formats import decode_json
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.models import checkpoints
from lpn.models.backbones import CHANNELS
from lpn.models.base import Model
from lpn.models.contract import ForwardPass
from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec
from lpn.models.trace import Trace
from lpn.reproduce.record import TableRecord
from lpn.reproduce.sources import TASKS, Source
from lpn.reproduce.tables import Measure, TableRow, Values
from lpn.tasks.changes import turned, with_parts
from lpn.tasks.opening import lazy_task
from lpn.training.recipe import Recipe
from lpn.training.run_folder import Provenance, here

log = logging.getLogger(__name__)

FORMAT = "lpn-measured/3"
# Both views of Figure 7, in the order of its columns.
_VIEWS: tuple[View, ...] = ("drone", "satellite")
_BATCH = 16
_CENTRE = (
    "Protocol: the last feature map of each test picture without its mirror, summed over channels; the share of the sum in the "
    "cells whose centres lie in the middle half of height and width, which are {}; mean over pictures."
)


class MeasuredFigures(msgspec.Struct, frozen=True):
    """The figures of one network.

    Attributes:
        values: in percent, one for each column of the table.
        protocol: the evaluation protocol in one sentence.
        made: the provenance of the figures.
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
    """A cache of measured figures by their inputs, and of the finished tables, in one JSON file.

    Several processes may use one file: each reads it again before it adds to it.

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
            measured = _measured(row, measure, model, data, released)
            self._change(lambda file: file.figures.update({key: measured}))
        return self._file.figures[key]

    def reload(self) -> None:
        """Read the file again for additions of other processes."""
        self._file = self._read()

    def keep(self, table: TableRecord) -> None:
        """Write a finished table into the file."""
        self._change(lambda file: file.tables.update({table.key: table}))

    def _change(self, change: Callable[[_MeasurementsFile], None]) -> None:
        with exclusive_lock(self.path.parent, wait=True):
            self._file = self._read()
            change(self._file)
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
        dataset = data[0].dataset
        shares = [list(centre_shares(model, dataset.gallery(view), view)) for view in _VIEWS]
        # The centre is a quarter of the cells only if sides are multiples of four.
        sizes = dict.fromkeys(model.map_size(view) for view in _VIEWS)
        boxes = [f"{100 * centre_box(*size).mean():.1f} % of {size[0]} x {size[1]} cells" for size in sizes]
        means = tuple(100 * float(np.mean(of_view)) for of_view in shares)
        return MeasuredFigures(means, _CENTRE.format(" or ".join(boxes)), here())
    results = []
    for source in data:
        for name in TASKS[measure]:
            task = lazy_task(model, source.dataset, name, branch=row.branch, released=released)
            results.append(with_parts(turned(task, row.rotate) if row.rotate else task, row.parts).evaluate())
    values: list[float] = []
    for result in results:
        depths = {"both ways": ("1",), "ground": ("1", "5", "10", "1%")}.get(measure, ())
        values += [*(result.recall[depth] for depth in depths), *([] if measure == "ground" else [result.ap])]
    return MeasuredFigures(tuple(values), results[0].sentence, here())


def features_alone(recipe: Recipe, init: Path) -> checkpoints.TorchModel:
    """Make a network whose descriptor is the mean over the last feature map of a pretrained backbone.

    Raises:
        ModelFileError: when `init` lacks weights of that backbone.
    """
    channels = CHANNELS[recipe.backbone, recipe.last_layer]
    spec = ModelSpec(
        recipe.backbone, recipe.last_layer, views=("street",), shared=False, n_parts=1, embedding=channels, classes=1,
        input_size=recipe.input_size,
    )  # fmt: skip
    network = LPN(spec)
    _, _, missing = checkpoints.load_backbone(network, init)
    if missing:
        raise ModelFileError(
            f"{init.name} lacks {', '.join(missing)} of {recipe.backbone}, so its features alone cannot be measured; give a file "
            "of the whole backbone with --init."
        )
    block = network.heads[0].add_block
    linear, norm = cast(nn.Linear, block[0]), cast(nn.BatchNorm1d, block[1])
    with torch.no_grad():
        linear.weight.copy_(torch.eye(channels))
        norm.weight.fill_(1.0)
    print_of = fingerprint(init, also=f"features alone {spec.to_json()}")
    return checkpoints.TorchModel(network.to(checkpoints.best_device()), print_of)


def centre_shares(model: Model, pictures: Sequence[Picture], view: View) -> Iterator[float]:
    """Yield the share of each picture's activation in the centre, see `centre_share`; the mirror is not used.

    Raises:
        InputError: if the model has no cells.
        PictureError: if a picture cannot be read.
    """
    for start in range(0, len(pictures), _BATCH):
        batch = pictures[start : start + _BATCH]
        outputs = model.run(np.stack([model.prepare(picture.load_zoomed(), view) for picture in batch]), view)
        for i in range(len(batch)):
            one = ForwardPass(*(None if values is None else values[i : i + 1] for values in outputs))  # type: ignore[arg-type]
            yield centre_share(Trace.from_pass(model, one, view).activation)


def centre_share(activation: FloatingArray) -> float:
    """Return the share of a channel sum (h, w), see `Trace.activation`, that lies in the centre, from 0 to 1.

    Negative sums count as 0. A map without activation counts as uniform.
    """
    total = np.maximum(activation.astype(np.float64), 0)
    inside = centre_box(*total.shape)
    return float(total[inside].sum() / total.sum()) if total.any() else float(inside.mean())


def centre_box(height: int, width: int) -> BoolArray:
    """Return the mask of cells whose centres lie in the middle half of a map's height and width, (h, w).

    On the 16 x 16 map of a picture of 256 pixels, it is the box of the two inner rings of n = 4, a quarter of the area.
    """
    rows, columns = (abs(2 * np.arange(length) + 1 - length) < length / 2 for length in (height, width))
    return rows[:, None] & columns[None, :]
