"""Export of a model in PyTorch to `.onnx`: one graph per group of views that share weights, each with its heads."""

from __future__ import annotations

import io
import logging
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import cast

import numpy as np
import numpy.typing as npt
import onnx
import torch
from torch import Tensor, nn

from lpn.core.arrays import Int8Array
from lpn.core.checksums import SEAL, UNSEALED, with_seal
from lpn.core.errors import InputError
from lpn.core.files import check_writable, write_atomic
from lpn.core.views import View
from lpn.models.adapters import Kind
from lpn.models.adapters.load import load_file
from lpn.models.adapters.model import PublishedModel
from lpn.models.base import Model
from lpn.models.checkpoints import TorchModel
from lpn.models.contract_metadata import to_metadata
from lpn.models.network import weigh
from lpn.models.onnx_engine import FORMAT, OUTPUTS, TRUNK, extra_outputs, graph_files
from lpn.models.onnx_tokens import TOKENS, pooled_graph
from lpn.models.shipped import model_file
from lpn.models.spec import SLOPES
from lpn.models.timm_files import timm_file
from lpn.models.token_pooling import TokenPooling
from lpn.models.weight_storage import WeightType, to_eight_bits

# The module of `_AccountGraph` up to the map or tokens of a published model.
_TRUNK_MODULE = "network.trunk"


class _SafaGraph(nn.Module):
    """SAFA at test time for one view."""

    def __init__(self, model: TorchModel, view: View) -> None:
        super().__init__()
        self.network, self.view = model.network, view

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        features = self.network.features(images, self.view)
        attention = self.network.attention(features, self.view)
        return weigh(features, attention), features, attention


class _AccountGraph(nn.Module):
    """A published model of another method for one view: the parts, their account, and the static heads."""

    def __init__(self, model: PublishedModel, view: View) -> None:
        super().__init__()
        self.network = model.network(view)
        account = self.network.account(torch.zeros(1, 3, *model.input_size))
        self.fields = [name for name, tensor in account._asdict().items() if tensor is not None]
        self.outputs = [*self.fields, *([] if model.heads(view).weight is None else ["head_weight"])]

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        account = self.network.account(images)
        fields = [getattr(account, name) for name in self.fields]
        return (*fields, cast(Tensor, self.network.weight)) if "head_weight" in self.outputs else tuple(fields)


class _Graph(nn.Module):
    """An LPN at test time for one view, with its heads as affine maps."""

    def __init__(self, model: TorchModel, view: View) -> None:
        super().__init__()
        self.branch = model.network.branch(view)
        heads = model.heads(view)
        self.activation = model.spec.activation
        self.weight = nn.Buffer(torch.from_numpy(heads.weight))
        self.bias = nn.Buffer(torch.from_numpy(heads.bias))
        self.partition = nn.Buffer(torch.from_numpy(heads.cells))

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        features = cast(Tensor, self.branch(images))
        pooled = torch.matmul(self.partition.flatten(1), features.flatten(2).transpose(1, 2))
        parts = torch.matmul(self.weight, pooled.unsqueeze(3)).squeeze(3) + self.bias
        if self.activation == "relu":
            parts = nn.functional.relu(parts)
        elif self.activation == "leaky_relu":
            parts = nn.functional.leaky_relu(parts, SLOPES["leaky_relu"])
        return parts, features, self.weight, self.bias, self.partition


def export(
    model: str | Path,
    out: str | Path,
    storage: WeightType = "float32",
    kind: Kind | None = None,
    pooling: str | None = None,
) -> list[Path]:
    """Export a `.pth` or `.safetensors` model for ONNX Runtime, or an `.onnx` that returns tokens with a pooling behind them.

    The first group of views is written to `out`; further groups, such as the street view, to files beside it (`out` with the
    views' names before the suffix). Outputs: `parts` (B, n, D), `features` (B, C, h, w), and the constants `head_weight`
    (n, D, C), `head_bias` (n, D), `cells` (n, h, w); SAFA has `attention` (B, n, M, h, w) instead of the constants. A published
    model of another method has `parts` and what its account needs, with its contract as metadata (docs/contract.md).

    Args:
        storage: of the weights in the file. float16 halves the file; int8 stores convolutions in a quarter, with one scale
            per output channel, and the rest in half. Either is converted to float32 on opening, so neither is faster.
        kind, pooling: see `lpn.load`.

    Returns:
        The files written.

    Raises:
        InputError: if `out` does not end in .onnx, or `model` does and no pooling is given.
        ModelFileError: if the model cannot be loaded.
        OutputError: if `out` cannot be written.
    """
    network, model = timm_file(model) or (None, Path(model))
    model, out = model_file(model, trained=True), Path(out)
    pooled = None if pooling is None else TokenPooling.parse(pooling)
    if out.suffix != ".onnx":
        raise InputError(f"The output is named {out.name}; expected a name ending in .onnx.")
    if model.suffix == ".onnx":
        if pooled is None or network is not None:
            raise InputError(
                f"{model.name} is exported already; give the .safetensors or .pth it was made from, or, if it returns tokens, "
                "their --pooling."
            )
        if out.resolve() == model.resolve():
            raise InputError(f"{out.name} is the model itself; give another name for the exported one.")
        check_writable(out)
        graph = pooled_graph(model, pooled)
        if storage != "float32":
            proto = onnx.load_model_from_string(graph)
            _shrink(proto, storage, TOKENS)
            graph = _sealed(proto, {entry.key: entry.value for entry in proto.metadata_props})
        write_atomic(out, graph)
        return [out]
    check_writable(out)
    loaded = load_file(model, kind=kind, pooling=pooled, network=network)
    groups = list(loaded.contract.groups)
    if loaded.spec is None:
        metadata = {**to_metadata(loaded.contract), "source": loaded.fingerprint}
    else:
        metadata = {"format": FORMAT, "spec": loaded.spec.to_json(), "source": loaded.fingerprint}
    graphs = {
        path: _graph(loaded, group[0], metadata | {"group": "+".join(group)}, storage)
        for path, group in zip(graph_files(out, groups), groups, strict=True)
    }
    for path, graph in reversed(graphs.items()):
        write_atomic(path, graph)
    return list(graphs)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence the exporter's messages about its own internals."""
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


def _network(model: Model, view: View) -> tuple[nn.Module, list[str]]:
    """Return what is traced for a view, and the names of its outputs."""
    if isinstance(model, PublishedModel):
        traced = _AccountGraph(model, view)
        return traced, traced.outputs
    assert isinstance(model, TorchModel)
    names = [*OUTPUTS, *extra_outputs(model.spec)]
    return (_SafaGraph if model.spec.pooling == "safa" else _Graph)(model, view), names


def _graph(model: Model, view: View, metadata: dict[str, str], storage: WeightType) -> bytes:
    """Trace one view with a dynamic batch and return the serialised graph."""
    height, width = model.input_size
    network, names = _network(model, view)
    example = torch.zeros(2, 3, height, width)
    with _quiet():
        program = torch.onnx.export(
            network.eval(),
            (example,),
            input_names=["images"],
            output_names=names,
            dynamic_shapes={"images": {0: torch.export.Dim("batch", min=1)}},
            dynamo=True,
            optimize=True,
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    if isinstance(model, PublishedModel):
        _name_trunk(proto.graph)
    _remove_origin(proto)
    if storage != "float32":
        _shrink(proto, storage, kept=_behind_trunk(proto.graph) if isinstance(model, PublishedModel) else ())
    return _sealed(proto, metadata)


def _sealed(proto: onnx.ModelProto, metadata: dict[str, str]) -> bytes:
    onnx.helper.set_model_props(proto, metadata | {SEAL: UNSEALED})
    buffer = io.BytesIO()
    onnx.save_model(proto, buffer)
    return with_seal(buffer.getvalue())


def _remove_origin(proto: onnx.ModelProto) -> None:
    """Remove the exporter's notes on the source of each node, which contain paths of this machine."""
    graph = proto.graph
    for part in (proto, graph, *graph.node, *graph.initializer, *graph.value_info, *graph.input, *graph.output):
        del part.metadata_props[:]
        part.doc_string = ""


def _name_trunk(graph: onnx.GraphProto) -> None:
    """Mark by their names the nodes that the exporter made of a published model's trunk."""
    for number, node in enumerate(graph.node):
        scopes = next((entry.value for entry in node.metadata_props if entry.key == "pkg.torch.onnx.name_scopes"), "")
        node.name = f"{TRUNK if repr(_TRUNK_MODULE) in scopes else ''}{number}"


def _behind_trunk(graph: onnx.GraphProto) -> set[str]:
    """Return the names of what nodes behind the trunk read, but for the outputs.

    The exporter derives constants of one weight, such as its transpose for the parts and its sums for the account. Rounded one
    by one, they would contradict each other.
    """
    read = {name for node in graph.node if not node.name.startswith(TRUNK) for name in node.input}
    return read - {output.name for output in graph.output}


def _shrink(proto: onnx.ModelProto, storage: WeightType, prefix: str = "", kept: Collection[str] = ()) -> None:
    """Store weights in fewer bits, behind nodes that convert them to the float32 of the graph.

    Args:
        prefix: of the names of the weights; others stay as they are.
        kept: further names of weights that stay as they are.
    """
    graph = proto.graph
    widening: list[onnx.NodeProto] = []
    for weight in list(graph.initializer):
        values = onnx.numpy_helper.to_array(weight)
        if values.dtype != np.float32 or not weight.name.startswith(prefix) or weight.name in kept:
            continue
        name, stored = weight.name, f"{weight.name}.stored"
        narrow: npt.NDArray[np.float16] | Int8Array
        # Heads and cells are small, and the graph's constants must be the values that it computes with.
        if storage == "float16" or values.ndim != 4:
            widened, narrow = name, values.astype(np.float16)
        else:
            widened = f"{name}.wide"
            narrow, scale = to_eight_bits(values)
            graph.initializer.append(onnx.numpy_helper.from_array(scale, f"{name}.scale"))
            widening.append(onnx.helper.make_node("Mul", [widened, f"{name}.scale"], [name]))
        if not np.isfinite(narrow).all():
            raise InputError(f"The weights {name} are too large for {storage}; export them as float32.")
        weight.CopyFrom(onnx.numpy_helper.from_array(narrow, stored))
        widening.insert(0, onnx.helper.make_node("Cast", [stored], [widened], to=onnx.TensorProto.FLOAT))
    nodes = [*widening, *graph.node]
    del graph.node[:]
    graph.node.extend(nodes)
