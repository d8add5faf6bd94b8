"""Quantization of an exported float32 model to 8-bit integers, calibrated on real pictures.

Convolutions, linear layers, and operations between convolutions are quantised: weights by output channel, activations by their
range on the calibration pictures. Quantization ends at the trunk's maps or tokens. Pooling, regions, gates, norms of pooled
values, and heads after the trunk stay in float32. So parts and their account come from the same maps or tokens, and evidence
stays exact.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple, cast

import numpy as np
import onnx
from onnxruntime.quantization import CalibrationDataReader, QuantFormat, QuantType, quantize_static

from lpn.core.arrays import Float32Array
from lpn.core.checksums import SEAL, UNSEALED, with_seal
from lpn.core.errors import DataError, InputError
from lpn.core.files import check_writable, printable, write_together
from lpn.core.views import View
from lpn.datasets import Dataset, Picture
from lpn.datasets.integrity import check_whole
from lpn.models.export import quiet
from lpn.models.onnx_engine import COMPUTE, TRUNK, Engine, graph_files
from lpn.models.shipped import model_file

# Calibration pictures for each group of views that share weights.
PICTURES = 128
# Least mean cosine with the float32 descriptors; below it, no model is written.
LEAST_COSINE = 0.98
# Calibration pictures of each group for the comparison of both models.
_COMPARED = 64
# In a trunk with LayerNorms, such as a vision transformer or a ConvNeXt, Softmax, LayerNorm, GELU, and products of attention stay
# in float32. So does the residual stream: its few large channels would take the range of the others.
_QUANTISED, _QUANTISED_CONVOLUTIONAL = (
    frozenset({"Conv", "MatMul", "Gemm"}),
    frozenset({"Relu", "Clip", "Add", "MaxPool"}),
)
_FLOAT_OUTPUTS = ["MatMul", "Gemm"]


class Agreement(NamedTuple):
    """The agreement of an 8-bit model with its float32 model on calibration pictures.

    Attributes:
        cosines: for each view, the mean cosine (-1 .. 1) between both models' descriptors of a picture.
        same_first: share (0 .. 1) of the queries for which both models rank the same gallery picture first; None if the pictures
            have only one view.
        queries, gallery: numbers of pictures behind `same_first`; 0 without it.
    """

    cosines: dict[View, float]
    same_first: float | None
    queries: int = 0
    gallery: int = 0


def quantize(
    model: str | Path, dataset: Dataset, out: str | Path, pictures: int = PICTURES, least_cosine: float = LEAST_COSINE
) -> tuple[list[Path], Agreement]:
    """Quantize an exported model so that its convolutions and linear layers compute in 8 bits.

    Args:
        model: the `.onnx` file, stored as float32; files of further view groups lie beside it.
        dataset: the source of calibration pictures, see `calibration_pictures`.
        out: the file to write; further view groups get files beside it.
        pictures: the number of calibration pictures for each group of views.
        least_cosine: from -1 to 1; nothing is written if a view's mean cosine is below it.

    Returns:
        The written files, and their agreement with the model on calibration pictures.

    Raises:
        InputError: if `out` does not end in .onnx or is `model`, `model` is not stored as float32, there are no pictures, or
            `least_cosine` is out of range or not reached.
        ModelFileError: if the model cannot be loaded.
        PictureError: if calibration pictures are broken.
        OutputError: if `out` cannot be written.
    """
    model, out = model_file(model), Path(out)
    if out.suffix != ".onnx":
        raise InputError(f"The output is named {out.name}; expected a name ending in .onnx.")
    if out.resolve() == model.resolve():
        raise InputError(f"{out.name} is the model itself; give another name for the quantised one.")
    if pictures < 1:
        raise InputError(f"{pictures} calibration pictures were asked for; give at least one, such as {PICTURES}.")
    if not -1 <= least_cosine <= 1:
        raise InputError(f"The least cosine is {least_cosine}; expected a number from -1 to 1, such as {LEAST_COSINE}.")
    check_writable(out)
    engine = Engine(model)
    groups = list(engine.contract.groups)
    # With one branch for queries and one for the gallery, each describes all views.
    calibrated = [engine.views if engine.contract.roles == "role" else group for group in groups]
    chosen = [calibration_pictures(dataset, views, pictures) for views in calibrated]
    check_whole([picture.path for some in chosen for _, picture in some], f"pictures of {dataset.root.name}")
    sources = graph_files(model, groups)
    graphs = [_quantised(file, engine, some) for file, some in zip(sources, chosen, strict=True)]
    with tempfile.TemporaryDirectory(prefix="lpn-") as folder:
        tried = graph_files(Path(folder) / out.name, groups)
        for path, graph in zip(tried, graphs, strict=True):
            path.write_bytes(graph)
        compared = [pair for some in chosen for pair in some[:: max(1, len(some) // _COMPARED)]]
        agreement = _agreement(engine, Engine(tried[0]), list(dict.fromkeys(compared)))
    lowest = min(agreement.cosines, key=lambda view: agreement.cosines[view])
    if not agreement.cosines[lowest] >= least_cosine:
        raise InputError(
            f"In 8 bits {model.name} changes its {lowest} descriptors: their mean cosine with the float32 descriptors is "
            f"{agreement.cosines[lowest]:.4f}, below {least_cosine:g}, so nothing was written; keep the float32 model, made "
            "smaller by lpn export --storage int8, or lower --least-cosine."
        )
    targets = graph_files(out, groups)
    # The first file names the others, so it is replaced last.
    write_together(dict(reversed([*zip(targets, graphs, strict=True)])))
    return targets, agreement


def calibration_pictures(dataset: Dataset, views: Sequence[View], count: int) -> list[tuple[View, Picture]]:
    """Choose calibration pictures: each view's share of `count`, spread evenly over its list.

    They come from the training split if it has the view, else from the test split.

    Raises:
        InputError: if the data set has pictures of none of the views.
    """
    lists: dict[View, list[Picture]] = {}
    for view in views:
        for read in (dataset.train, dataset.gallery, dataset.queries):
            with suppress(DataError):  # the split lacks the view
                lists[view] = lists.get(view) or read(view)
    lists = {view: pictures for view, pictures in lists.items() if pictures}
    if not lists:
        raise InputError(
            f"{printable(dataset.root.name)} has no {' or '.join(views)} pictures to calibrate by; give a data set that has some."
        )
    share = -(-count // len(lists))
    chosen: list[tuple[View, Picture]] = []
    for view, pictures in lists.items():
        steps = np.linspace(0, len(pictures) - 1, min(share, len(pictures))).round().astype(int)
        chosen += [(view, pictures[step]) for step in steps]
    return chosen


def _inputs(engine: Engine, view: View, picture: Picture) -> Float32Array:
    """Return the network input of a picture: (1, 3, H, W), or with its mirror (2, 3, H, W)."""
    return engine.with_mirror(engine.prepare(picture.load_cropped(), view))


class _CalibrationReader(CalibrationDataReader):  # type: ignore[misc]
    """Feeds the quantiser one picture at a time."""

    def __init__(self, engine: Engine, pictures: Sequence[tuple[View, Picture]]) -> None:
        self._inputs = ({"images": _inputs(engine, *pair)} for pair in pictures)

    def get_next(self) -> dict[str, Float32Array] | None:
        return next(self._inputs, None)


def _quantised(file: Path, engine: Engine, pictures: Sequence[tuple[View, Picture]]) -> bytes:
    proto = onnx.load_model(file)
    metadata = {entry.key: entry.value for entry in proto.metadata_props}
    if metadata.get(COMPUTE) == "int8":
        raise InputError(f"{file.name} computes in 8 bits already; give the float32 model it was made from.")
    if any(weight.name.endswith(".stored") for weight in proto.graph.initializer):
        raise InputError(
            f"{file.name} is stored in fewer bits than float32; export the model with --storage float32 first."
        )
    for number, node in enumerate(proto.graph.node):
        node.name = f"{TRUNK if node.name.startswith(TRUNK) else ''}{number}"
    names = _quantisable(proto.graph)
    if not names:
        raise InputError(
            f"{file.name} has no convolution and no linear layer in a trunk that lpn export marked; "
            "export the model with lpn export first."
        )
    with tempfile.TemporaryDirectory(prefix="lpn-") as folder, quiet():
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
            extra_options={"OpTypesToExcludeOutputQuantization": _FLOAT_OUTPUTS},
        )
        result = onnx.load_model(made)
    del result.metadata_props[:]
    onnx.helper.set_model_props(result, {**metadata, COMPUTE: "int8", SEAL: UNSEALED})
    return with_seal(cast(bytes, result.SerializeToString()))


def _quantisable(graph: onnx.GraphProto) -> list[str]:
    """Return the names of the trunk's nodes to quantise."""
    trunk = [node for node in graph.node if node.name.startswith(TRUNK)]
    weights = {weight.name: weight.dims for weight in graph.initializer}
    convolved = {name for node in trunk if node.op_type == "Conv" for name in node.output}
    types = _QUANTISED
    if not any(node.op_type == "LayerNormalization" for node in trunk):
        types |= _QUANTISED_CONVOLUTIONAL

    def fits(node: onnx.NodeProto) -> bool:
        # A head has a matrix for each part, and a product of attention has no weights.
        linear = node.op_type not in ("MatMul", "Gemm") or len(weights.get(node.input[1], ())) == 2
        # ReLU6 is a Clip; another Clip, as in a pooling layer, is no activation.
        activation = node.op_type != "Clip" or node.input[0] in convolved
        return node.op_type in types and linear and activation

    return [node.name for node in trunk if fits(node)]


def _agreement(before: Engine, after: Engine, pictures: Sequence[tuple[View, Picture]]) -> Agreement:
    described: dict[View, list[tuple[Float32Array, Float32Array]]] = {}
    for view, picture in pictures:
        prepared = _inputs(before, view, picture)[:1]
        described.setdefault(view, []).append((before.descriptors(prepared, view), after.descriptors(prepared, view)))
    pairs = {view: [np.concatenate(side) for side in zip(*sides, strict=True)] for view, sides in described.items()}
    cosines = {view: float((one * other).sum((1, 2)).mean()) for view, (one, other) in pairs.items()}
    tiles, *others = pairs.values()
    if not others:
        return Agreement(cosines, None)
    queries = [np.concatenate(side) for side in zip(*others, strict=True)]
    firsts = [
        np.tensordot(rows, gallery, ((1, 2), (1, 2))).argmax(1) for rows, gallery in zip(queries, tiles, strict=True)
    ]
    return Agreement(cosines, float((firsts[0] == firsts[1]).mean()), len(queries[0]), len(tiles[0]))
