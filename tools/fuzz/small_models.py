"""Models so small that ten thousand of them can be opened: their files are whole, their networks are not an LPN's."""

from __future__ import annotations

import io
from dataclasses import replace

import numpy as np
import onnx
import torch
from onnx import TensorProto, helper, numpy_helper

from lpn.core.checksums import SEAL, UNSEALED
from lpn.models.network import LPN
from lpn.models.onnx_engine import FORMAT
from lpn.models.spec import ModelSpec
from tools.fixtures.small_worlds import make_network

SPEC = ModelSpec("resnet18", "layer3", views=("satellite", "drone"), n_parts=2, embedding=4, input_size=(32, 32))
_CHANNELS, _CELLS = 6, (2, 2)


def onnx_file(seal: bool) -> bytes:
    """A graph that pools and mixes colours, with the outputs and metadata of an exported LPN."""
    rng = np.random.default_rng(0)
    n, size, (h, w) = SPEC.n_parts, SPEC.embedding, _CELLS
    weights = {
        "mix": rng.standard_normal((_CHANNELS, 3, 1, 1)),
        "head_weight": rng.standard_normal((n, size, _CHANNELS)),
        "head_bias": rng.standard_normal((n, size)),
        "cells": np.full((n, h, w), 1 / (h * w)),
        "flat": np.full((n, h * w), 1 / (h * w)),
    }
    shapes = {
        "parts": ["batch", n, size],
        "features": ["batch", _CHANNELS, h, w],
        "head_weight": [n, size, _CHANNELS],
        "head_bias": [n, size],
        "cells": [n, h, w],
    }
    nodes = [
        helper.make_node("AveragePool", ["images"], ["pooled"], kernel_shape=[16, 16], strides=[16, 16]),
        helper.make_node("Conv", ["pooled", "mix"], ["features"]),
        helper.make_node("Reshape", ["features", "shape"], ["map"]),
        helper.make_node("MatMul", ["flat", "map"], ["means"]),
        helper.make_node("Unsqueeze", ["means", "axes"], ["column"]),
        helper.make_node("MatMul", ["head_weight", "column"], ["embedded"]),
        helper.make_node("Squeeze", ["embedded", "axes"], ["raw"]),
        helper.make_node("Add", ["raw", "head_bias"], ["parts"]),
    ]
    # The map is (cells, channels) for each picture, so that its means over cells are of channels.
    nodes[2:3] = [
        helper.make_node("Reshape", ["features", "shape"], ["flat_map"]),
        helper.make_node("Transpose", ["flat_map"], ["map"], perm=[0, 2, 1]),
    ]
    initializers = [numpy_helper.from_array(array.astype(np.float32), name) for name, array in weights.items()]
    initializers.append(numpy_helper.from_array(np.array([0, _CHANNELS, -1]), "shape"))
    initializers.append(numpy_helper.from_array(np.array([3]), "axes"))
    graph = helper.make_graph(
        nodes,
        "small",
        [helper.make_tensor_value_info("images", TensorProto.FLOAT, ["batch", 3, *SPEC.input_size])],
        [helper.make_tensor_value_info(name, TensorProto.FLOAT, shape) for name, shape in shapes.items()],
        initializers,
    )
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 20)], ir_version=10)
    metadata = {"format": FORMAT, "spec": SPEC.to_json(), "source": "0" * 16, "group": "satellite+drone"}
    helper.set_model_props(model, metadata | ({SEAL: UNSEALED} if seal else {}))
    data = bytes(onnx.ModelProto.SerializeToString(model))
    return seal(data) if seal else data


def state_dict() -> dict[str, torch.Tensor]:
    """The entries of a whole network, each of one number, but for the head's weights, which say how large it is."""
    with torch.device("meta"):
        names = LPN(replace(make_network().spec, n_parts=2)).state_dict()
    return {name: torch.ones(2, 3) if ".add_block.0.weight" in name else torch.ones(1) for name in names}


def pth_file(entries: dict[str, torch.Tensor]) -> bytes:
    """As torch saves it."""
    whole = io.BytesIO()
    torch.save(entries, whole)
    return whole.getvalue()
