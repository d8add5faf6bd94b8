"""Quantization of an exported float32 model to 8-bit integers, calibrated on real pictures.

Convolutions and the layers between them are quantised: weights by output channel, activations by their range on the
calibration pictures. Pooling and heads stay in float32 and use the graph's feature map, so evidence stays exact.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from inspect import signature
from pathlib import Path
from typing import cast

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from lpn.core.arrays import Float32Array
from lpn.core.checksums import SEAL, UNSEALED, with_seal
from lpn.core.errors import DataError, InputError
from lpn.core.files import check_writable, printable, write_atomic
from lpn.core.resources import ProviderName
from lpn.core.views import View
from lpn.datasets import Dataset, Picture
from lpn.datasets.integrity import check_whole
from lpn.models.onnx_engine import COMPUTE, Engine, graph_files

# Calibration pictures for each group of views that share weights.
PICTURES = 128
_QUANTISED = frozenset({"Conv", "Relu", "Add", "MaxPool"})


def quantize(
    model: str | Path, dataset: Dataset, out: str | Path, pictures: int = PICTURES, provider: ProviderName = "cpu"
) -> tuple[list[Path], dict[View, float]]:
    """Quantize an exported model so that its convolutions compute in 8 bits.

    Args:
        model: the `.onnx` file, stored as float32; files of further view groups lie beside it.
        dataset: the source of calibration pictures, see `calibration_pictures`.
        out: the file to write; further view groups get files beside it.
        pictures: the number of calibration pictures for each group of views.
        provider: computes the calibration, see `Engine`; before ONNX Runtime 1.21, the CPU does. The 8-bit model is always
            compared on the CPU, as it is made for it.

    Returns:
        The files written, and for each view the mean cosine (-1 .. 1) between both models' descriptors of calibration
        pictures.

    Raises:
        InputError: if `out` does not end in .onnx or is `model`, `model` is not stored as float32, there are no pictures, or
            the named provider is missing or does not work.
        ModelFileError: if the model cannot be loaded.
        PictureError: if calibration pictures are broken.
        OutputError: if `out` cannot be written.
    """
    model, out = Path(model), Path(out)
    if out.suffix != ".onnx":
        raise InputError(f"The output is named {out.name}; expected a name ending in .onnx.")
    if out.resolve() == model.resolve():
        raise InputError(f"{out.name} is the model itself; give another name for the quantised one.")
    if pictures < 1:
        raise InputError(f"{pictures} calibration pictures were asked for; give at least one, such as {PICTURES}.")
    check_writable(out)
    engine = Engine(model, provider=provider)
    if engine.spec is None:
        raise InputError(
            f"{model.name} is {engine.contract.method}; only LPN and SAFA are computed in 8 bits, as what the account of other "
            "methods loses by it was not measured. lpn export --storage int8 makes the file smaller."
        )
    groups = list(engine.contract.groups)
    chosen = [calibration_pictures(dataset, group, pictures) for group in groups]
    check_whole([picture.path for some in chosen for _, picture in some], f"pictures of {dataset.root.name}")
    sources, targets = graph_files(model, groups), graph_files(out, groups)
    graphs = [_quantised(file, engine, some) for file, some in zip(sources, chosen, strict=True)]
    for path, graph in reversed(list(zip(targets, graphs, strict=True))):
        write_atomic(path, graph)
    return targets, _agreement(engine, Engine(out), [pair for some in chosen for pair in some])


def calibration_pictures(dataset: Dataset, views: Sequence[View], count: int) -> list[tuple[View, Picture]]:
    """Choose calibration pictures: each view's share of `count`, spread evenly over its list.

    They come from the training split if it has the view, else from the test split.

    Raises:
        InputError: if the data set has pictures of none of the views.
    """
    lists = {view: _pictures(dataset, view) for view in views}
    lists = {view: found for view, found in lists.items() if found}
    if not lists:
        raise InputError(
            f"{printable(dataset.root.name)} has no {' or '.join(views)} pictures to calibrate by; give a data set that has some."
        )
    share = -(-count // len(lists))
    chosen: list[tuple[View, Picture]] = []
    for view, found in lists.items():
        steps = np.linspace(0, len(found) - 1, min(share, len(found))).round().astype(int)
        chosen += [(view, found[step]) for step in steps]
    return chosen


def _pictures(dataset: Dataset, view: View) -> list[Picture]:
    if found := dataset.train(view):
        return found
    for read in (dataset.gallery, dataset.queries):
        try:
            return read(view)
        except DataError:  # the split lacks the view
            continue
    return []


def _inputs(engine: Engine, view: View, picture: Picture) -> Float32Array:
    """Return the network input of a picture: (1, 3, H, W), or with its mirror (2, 3, H, W)."""
    return engine.with_mirror(engine.prepare(picture.load_cropped(), view))


class _CalibrationReader(CalibrationDataReader):  # type: ignore[misc]
    """Feeds the quantiser one picture at a time."""

    def __init__(self, engine: Engine, pictures: Sequence[tuple[View, Picture]]) -> None:
        self._remaining = iter([(engine, *pair) for pair in pictures])

    def get_next(self) -> dict[str, Float32Array] | None:
        item = next(self._remaining, None)
        return None if item is None else {"images": _inputs(*item)}


def _quantised(file: Path, engine: Engine, pictures: Sequence[tuple[View, Picture]]) -> bytes:
    proto = onnx.load_model(file)
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    if metadata.get(COMPUTE) == "int8":
        raise InputError(f"{file.name} computes in 8 bits already; give the float32 model it was made from.")
    if any(
        weight.data_type != onnx.TensorProto.FLOAT and weight.name.endswith(".stored")
        for weight in proto.graph.initializer
    ):
        raise InputError(
            f"{file.name} is stored in fewer bits than float32; export the model with --storage float32 first."
        )
    before_pooling = _upstream(proto.graph, "features")
    names = [node.name for node in proto.graph.node if node.op_type in _QUANTISED and node.name in before_pooling]
    options = {"calibration_providers": engine.calibration_providers()}
    if "calibration_providers" not in signature(quantize_static).parameters:  # before ONNX Runtime 1.21
        options = {}
    with tempfile.TemporaryDirectory(prefix="lpn-") as folder, _quiet():
        made = Path(folder) / "quantised.onnx"
        quantize_static(
            proto,
            made,
            _CalibrationReader(engine, pictures),
            quant_format=QuantFormat.QDQ,
            per_channel=True,
            activation_type=QuantType.QUInt8,
            weight_type=QuantType.QInt8,
            nodes_to_quantize=names,
            **options,
        )
        result = onnx.load_model(made)
    del result.metadata_props[:]
    onnx.helper.set_model_props(result, {**metadata, COMPUTE: "int8", SEAL: UNSEALED})
    return with_seal(cast(bytes, result.SerializeToString()))


def _upstream(graph: onnx.GraphProto, output: str) -> set[str]:
    """Return the names of the nodes that an output depends on."""
    makers = {name: node for node in graph.node for name in node.output}
    found: set[str] = set()
    left = [output]
    while left:
        node = makers.get(left.pop())
        if node is not None and node.name not in found:
            found.add(node.name)
            left += list(node.input)
    return found


def _agreement(before: Engine, after: Engine, pictures: Sequence[tuple[View, Picture]]) -> dict[View, float]:
    cosines: dict[View, list[float]] = {}
    for view, picture in pictures[:: max(1, len(pictures) // 32)]:
        prepared = _inputs(before, view, picture)[:1]
        one, other = (engine.descriptors(prepared, view)[0] for engine in (before, after))
        cosines.setdefault(view, []).append(float((one * other).sum()))
    return {view: float(np.mean(found)) for view, found in cosines.items()}


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the quantiser's advice on its own internals."""
    logging.disable(logging.WARNING)
    try:
        yield
    finally:
        logging.disable(logging.NOTSET)
