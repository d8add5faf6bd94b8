"""Export of a model in PyTorch to `.onnx`: one graph per group of views that share weights, each with its heads."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt
import onnx
import torch
from torch import Tensor, nn

from lpn.core.arrays import Int8Array
from lpn.core.checksums import SEAL, UNSEALED, with_seal
from lpn.core.errors import InputError
from lpn.core.files import check_writable, write_together
from lpn.core.views import View
from lpn.models import safa
from lpn.models.adapters import Kind
from lpn.models.adapters.load import load_file
from lpn.models.adapters.network import by_heads
from lpn.models.adapters.published import PublishedModel
from lpn.models.base import Model
from lpn.models.checkpoints import TorchModel, WeightType, to_eight_bits
from lpn.models.contract_metadata import to_metadata
from lpn.models.onnx_engine import TRUNK, Engine, graph_files
from lpn.models.registered import timm_file
from lpn.models.shipped import model_file
from lpn.models.spec import SLOPES
from lpn.models.token_pooling import TokenPooling

# The submodules that compute a model's map or tokens, or a vector by the network's own pooling.
_TRUNK_MODULES = ("branch", "network.trunk", "network.vector.trunk")


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
    """An LPN at test time for one view, with its heads as affine maps, or SAFA, whose parts are sums over their own maps."""

    weight: Tensor | None
    bias: Tensor | None
    partition: Tensor | None

    def __init__(self, model: TorchModel, view: View) -> None:
        super().__init__()
        self.branch, self.cells = model.network.branch(view), model.spec.partition(view)
        heads, self.slope = model.heads(view), SLOPES[model.spec.activation]
        for name, array in (("weight", heads.weight), ("bias", heads.bias), ("partition", heads.cells)):
            self.register_buffer(name, None if array is None else torch.from_numpy(array))
        self.outputs = ["parts", "features", "cells"]
        if self.weight is not None:
            slopes = ["slopes"] if self.slope != 1 else []
            self.outputs = ["parts", "features", "head_weight", "head_bias", "cells", *slopes]

    def forward(self, images: Tensor) -> tuple[Tensor, ...]:
        features = cast(Tensor, self.branch(images))
        if self.weight is None or self.bias is None or self.partition is None:
            attention = safa.attention(features, self.cells, self.branch.aware)
            return (safa.weigh(features, attention), *safa.by_part(features, attention))
        weight, bias, cells = self.weight, self.bias, self.partition
        parts = by_heads(torch.matmul(cells.flatten(1), features.flatten(2).transpose(1, 2)), weight, bias)
        if self.slope == 1:
            return parts, features, weight, bias, cells
        slopes = torch.where(parts > 0, 1.0, self.slope)
        return parts * slopes, features, weight, bias, cells, slopes


def export(
    model: str | Path,
    out: str | Path,
    storage: WeightType = "float32",
    kind: Kind | None = None,
    pooling: str | None = None,
) -> list[Path]:
    """Export a `.pth` or `.safetensors` model for ONNX Runtime.

    The first group of views is written to `out`. Further groups, such as the street view, get files beside it: `out` with the
    views' names before the suffix. A graph returns the parts and the data for their account; its metadata state the contract
    (docs/contract.md).

    Args:
        storage: of the weights in the file. float16 halves the file; int8 quarters convolutions, with a scale for each
            output channel, and halves the rest. Either is converted to float32 on opening, so neither is faster.
        kind, pooling: see `lpn.load`.

    Returns:
        The files written.

    Raises:
        InputError: if `out` does not end in .onnx, or `model` does and no pooling is given.
        ModelFileError: if the model cannot be loaded.
        OutputError: if `out` cannot be written.
    """
    out = Path(out)
    if out.suffix != ".onnx":
        raise InputError(f"The output is named {out.name}; expected a name ending in .onnx.")
    check_writable(out)
    loaded = _trained(model, kind, pooling)
    groups = list(loaded.contract.groups)
    metadata = {**to_metadata(loaded.contract), "source": loaded.fingerprint}
    graphs = {
        path: _graph(loaded, group[0], metadata | {"group": "+".join(group)}, storage)
        for path, group in zip(graph_files(out, groups), groups, strict=True)
    }
    # The first file names the others, so it is replaced last.
    write_together(dict(reversed(graphs.items())))
    return list(graphs)


def difference(model: str | Path, exported: Path, kind: Kind | None = None, pooling: str | None = None) -> float:
    """Return the largest difference between the descriptors of a model and of its export, for one picture of noise.

    Args:
        model, kind, pooling: as for `export`.

    Raises:
        InputError, ModelFileError: if either cannot be opened.
    """
    own, other = _trained(model, kind, pooling), Engine(exported)
    noise = np.random.default_rng(0).standard_normal((1, 3, *own.input_size)).astype(np.float32)
    return max(float(np.abs(own.descriptors(noise, v) - other.descriptors(noise, v)).max()) for v in own.views)


def _trained(model: str | Path, kind: Kind | None, pooling: str | None) -> Model:
    """Open the model to export in PyTorch."""
    network, file = timm_file(model) or (None, model_file(model, trained=True))
    if file.suffix == ".onnx":
        raise InputError(f"{file.name} is exported already; give the .safetensors or .pth it was made from.")
    return load_file(file, kind=kind, pooling=None if pooling is None else TokenPooling.parse(pooling), network=network)


@contextmanager
def quiet() -> Iterator[None]:
    """Silence the exporter's messages about its own internals."""
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        logging.disable(logging.NOTSET)


def _graph(model: Model, view: View, metadata: dict[str, str], storage: WeightType) -> bytes:
    """Trace one view with a dynamic batch and return the serialised graph."""
    height, width = model.input_size
    if isinstance(model, PublishedModel):
        network: Any = _AccountGraph(model, view)
    else:
        assert isinstance(model, TorchModel)
        network = _Graph(model, view)
    with quiet():
        program = torch.onnx.export(
            network.eval(),
            (torch.zeros(2, 3, height, width),),
            input_names=["images"],
            output_names=list(network.outputs),
            dynamic_shapes={"images": {0: torch.export.Dim("batch", min=1)}},
            dynamo=True,
            optimize=True,
            verbose=False,
        )
    assert program is not None
    proto = program.model_proto
    _name_trunk(proto.graph)
    _remove_origin(proto)
    if storage != "float32":
        _shrink(proto, storage, kept=_behind_trunk(proto.graph) if isinstance(model, PublishedModel) else ())
    onnx.helper.set_model_props(proto, metadata | {SEAL: UNSEALED})
    return with_seal(proto.SerializeToString())


def _remove_origin(proto: onnx.ModelProto) -> None:
    """Remove the exporter's notes on the source of each node, which contain paths of this machine."""
    graph = proto.graph
    for part in (proto, graph, *graph.node, *graph.initializer, *graph.value_info, *graph.input, *graph.output):
        del part.metadata_props[:]
        part.doc_string = ""


def _name_trunk(graph: onnx.GraphProto) -> None:
    """Mark the nodes of a model's trunk by their names."""
    for number, node in enumerate(graph.node):
        scopes = next((entry.value for entry in node.metadata_props if entry.key == "pkg.torch.onnx.name_scopes"), "")
        of_trunk = any(repr(module) in scopes for module in _TRUNK_MODULES)
        node.name = f"{TRUNK if of_trunk else ''}{number}"


def _behind_trunk(graph: onnx.GraphProto) -> set[str]:
    """Return the tensors that nodes after the trunk read, except the graph's outputs.

    The exporter derives constants of one weight, such as its transpose for the parts and its sums for the account. Separate
    rounding would make them contradict each other.
    """
    read = {name for node in graph.node if not node.name.startswith(TRUNK) for name in node.input}
    return read - {output.name for output in graph.output}


def _shrink(proto: onnx.ModelProto, storage: WeightType, kept: Collection[str] = ()) -> None:
    """Store weights in fewer bits, with nodes that convert them to the graph's float32, except for the names in `kept`."""
    graph = proto.graph
    widening: list[onnx.NodeProto] = []
    for weight in list(graph.initializer):
        values = onnx.numpy_helper.to_array(weight)
        if values.dtype != np.float32 or weight.name in kept:
            continue
        name, stored = weight.name, f"{weight.name}.stored"
        narrow: npt.NDArray[np.float16] | Int8Array
        # Heads and cells get no scale: the graph must compute with the constants that it returns.
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
