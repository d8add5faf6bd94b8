"""From a PyTorch LPN to `.onnx`: one graph per group of views that share weights, each carrying its heads."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import numpy as np
import onnx
import torch
from torch import Tensor, nn

from lpn.checkpoints import TorchModel, load_torch
from lpn.engine import FORMAT, HEAD_OUTPUTS, OUTPUTS, graph_files
from lpn.errors import InputError
from lpn.files import check_writable, write_whole
from lpn.spec import View


class _Graph(nn.Module):
    """An LPN at test time for one view, heads folded to affine maps."""

    def __init__(self, model: TorchModel, view: View) -> None:
        super().__init__()
        self.branch = model.network.branch(view)
        heads = model.heads(view)
        self.leaky = model.spec.activation == "leaky_relu"
        self.weight = nn.Buffer(torch.from_numpy(heads.weight))
        self.bias = nn.Buffer(torch.from_numpy(heads.bias))
        self.partition = nn.Buffer(torch.from_numpy(heads.cells))

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        features = cast(Tensor, self.branch(images))
        pooled = torch.matmul(self.partition.flatten(1), features.flatten(2).transpose(1, 2))
        parts = torch.matmul(self.weight, pooled.unsqueeze(3)).squeeze(3) + self.bias
        if self.leaky:
            parts = nn.functional.leaky_relu(parts, 0.1)
        return parts, features, self.weight, self.bias, self.partition


def export(model: str | Path, out: str | Path, half: bool = False) -> list[Path]:
    """Export a `.pth` or `.safetensors` model for ONNX Runtime.

    The first group of views is written to `out`; a group that shares no weights with it, such as the street view,
    to a file beside it (`out` with the views' names before the suffix). Outputs: `parts` (B, n, D), `features`
    (B, C, h, w), and, independent of the input, `head_weight` (n, D, C), `head_bias` (n, D), `cells` (n, h, w).

    Args:
        half: keep weights as 16-bit floats, which halves the file; they are widened when it is opened, and computed with
            in 32 bits.

    Returns:
        The files written.

    Raises:
        InputError: when `out` does not end in .onnx, or `model` does.
        ModelFileError: when the model cannot be loaded.
        OutputError: when `out` cannot be written.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise InputError(f"The output is named {out.name}; expected a name ending in .onnx.")
    if Path(model).suffix == ".onnx":
        raise InputError(f"{Path(model).name} is exported already; give the .safetensors or .pth it was made from.")
    check_writable(out)
    loaded = load_torch(model)
    groups = loaded.spec.groups()
    metadata = {"format": FORMAT, "spec": loaded.spec.to_json(), "source": loaded.fingerprint}
    graphs = {
        path: _graph(loaded, group[0], metadata | {"group": "+".join(group)}, half)
        for path, group in zip(graph_files(out, groups), groups, strict=True)
    }
    for path, graph in reversed(graphs.items()):
        write_whole(path, graph)
    return list(graphs)


@contextmanager
def _quiet() -> Iterator[None]:
    """The exporter logs and warns about its own insides, which say nothing to a user."""
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


def _graph(model: TorchModel, view: View, metadata: dict[str, str], half: bool) -> bytes:
    """Trace one view with a dynamic batch and return the serialised graph."""
    height, width = model.input_size
    example = torch.zeros(2, 3, height, width)
    with _quiet():
        program = torch.onnx.export(
            _Graph(model, view).eval(),
            (example,),
            input_names=["images"],
            output_names=[*OUTPUTS, *HEAD_OUTPUTS],
            dynamic_shapes={"images": {0: torch.export.Dim("batch", min=1)}},
            dynamo=True,
            optimize=True,
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    if half:
        _halve(proto)
    onnx.helper.set_model_props(proto, metadata)
    buffer = io.BytesIO()
    onnx.save_model(proto, buffer)
    return buffer.getvalue()


def _halve(proto: onnx.ModelProto) -> None:
    """Store weights in 16 bits, each behind a Cast to the 32 bits that the graph computes with."""
    graph = proto.graph
    casts: list[onnx.NodeProto] = []
    for weight in graph.initializer:
        if weight.data_type != onnx.TensorProto.FLOAT:
            continue
        name, values = weight.name, onnx.numpy_helper.to_array(weight)
        stored = f"{name}.half"
        weight.CopyFrom(onnx.numpy_helper.from_array(values.astype(np.float16), stored))
        casts.append(onnx.helper.make_node("Cast", [stored], [name], to=onnx.TensorProto.FLOAT))
    nodes = [*casts, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
