"""ONNX files that return tokens, with a pooling by name behind them: the result is a graph with a contract.

The nodes that are added give `parts`, `features`, `cells`, and `constants` of docs/contract.md, see `lpn.models.token_pooling`.
"""

from __future__ import annotations

import hashlib
import logging
import os
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, cast

import numpy as np

from lpn.core.checksums import SEAL, UNSEALED, with_seal
from lpn.core.errors import InputError, MissingPackageError, ModelFileError
from lpn.core.files import cache_folder, fingerprint, first_few, printable, write_atomic
from lpn.core.images import MEAN, STD
from lpn.core.views import VIEWS
from lpn.models.contract import MAX_SIDE, Contract
from lpn.models.contract_metadata import to_metadata
from lpn.models.onnx_engine import open_session
from lpn.models.token_pooling import EPSILON, TokenPooling
from lpn.models.transformers_files import PICTURES, read_configuration, stated_normalisation, stated_size

log = logging.getLogger(__name__)

# The names under which exporters return tokens, the more common first.
_NAMES = ("last_hidden_state", "tokens", "x_norm_patchtokens", "patch_tokens", "features")
# The size of pictures of a graph that takes any.
_SIZE = (224, 224)
# Tokens in front of the cells, beyond which a number of tokens fits no map.
_MOST_IN_FRONT = 16
_PATCHES = range(4, 65)
# Copies with a pooling in the user's cache; those that were used last stay.
_COPIES = 8
# The prefix of the names of a file's own graph beneath its pooling.
TOKENS = "network/"
# The first opset whose operators take the inputs that are written here.
_OPSET = 13


class _Tokens(NamedTuple):
    """Where a graph returns its tokens.

    Attributes:
        name: of the output, (B, T, C), or a map (B, C, h, w).
        grid: (h, w).
        prefix: the number of tokens in front of the cells.
        channels: C.
        is_map: whether it is a map.
    """

    name: str
    grid: tuple[int, int]
    prefix: int
    channels: int
    is_map: bool


def pooled_file(path: Path, pooling: TokenPooling) -> Path:
    """Return the file of `pooled_graph` in the user's cache, which is written if it is not there.

    The cache keeps the eight files that were used last.

    Raises:
        ModelFileError, InputError, MissingPackageError: as for `pooled_graph`.
        OutputError: if the file is missing, and the cache cannot be written.
    """
    graph = pooled_graph(path, pooling)
    digest = hashlib.sha256(graph).hexdigest()[:24]
    file = cache_folder() / "pooled" / f"{digest}.onnx"
    try:
        os.utime(file)
    except OSError:  # the file is missing, or the cache cannot be written
        if not file.is_file():
            write_atomic(file, graph)
    for old in sorted(file.parent.glob("*.onnx"), key=_last_used)[:-_COPIES]:
        with suppress(OSError):
            old.unlink()
    return file


def _last_used(file: Path) -> float:
    try:
        return file.stat().st_mtime
    except OSError:  # another process removed it
        return 0.0


def pooled_graph(path: Path, pooling: TokenPooling) -> bytes:
    """Return an ONNX file that returns tokens with their pooling behind it, and a contract as its metadata.

    The size of pictures is the graph's, else `h` and `w` of an opts.yaml beside the file, else that of a
    preprocessor_config.json, else 224 x 224. Mean and standard deviation are those of the latter file, else ImageNet's.

    Raises:
        ModelFileError: if the file is damaged, or returns no tokens that fit a map.
        InputError: if it has parts of its own, or no class token for the pooling.
        MissingPackageError: if the package onnx is missing.
    """
    try:
        import onnx
    except ModuleNotFoundError as error:
        raise MissingPackageError(
            f"Pooling the tokens of {path.name} needs the package onnx; pip install 'lpn-explorer[train]'."
        ) from error
    session = open_session(path)
    metadata = session.get_modelmeta().custom_metadata_map
    if "spec" in metadata or str(metadata.get("format", "")).startswith("lpn-explorer-onnx"):
        raise InputError(f"{path.name} says which parts it has; leave --pooling out.")
    proto = onnx.load_model(path)
    opset = next((one.version for one in proto.opset_import if one.domain in ("", "ai.onnx")), 0)
    if opset < _OPSET:
        raise ModelFileError(
            f"{path.name} is of ONNX's opset {opset}; export it again with opset {_OPSET} or a newer one."
        )
    pictures = read_configuration(path.parent, PICTURES)
    batch, size = _input(session, path, pictures)
    tokens = _tokens(session, proto, path.name, size, batch)
    if pooling.needs_class_token and not tokens.prefix:
        raise InputError(f"{path.name} has no class token for the pooling {pooling}; take mean, gem, or rings:N.")
    mean, std = stated_normalisation(pictures, (MEAN, STD))
    if not pictures:
        log.warning(
            "%s does not say how pictures are normalised; ImageNet's mean and standard deviation are taken. A "
            "preprocessor_config.json beside it says others.",
            printable(path.name),
        )
    names = tuple(pooling.part_names)
    title = printable(path.stem)[:60]
    contract = Contract(
        f"{title}, {pooling}",
        f"{title}, {pooling}, {size[0]} x {size[1]}",
        VIEWS,
        size,
        len(names),
        pooling.embedding(tokens.channels),
        pooling.level,
        pooling.held,
        mean=mean,
        std=std,
        mirror="none",
        part_names=dict.fromkeys(VIEWS, names),
    )
    _append(proto, session.get_inputs()[0].name, tokens, pooling, size, batch)
    del proto.metadata_props[:]
    entries = {**to_metadata(contract), "source": fingerprint(path), SEAL: UNSEALED}
    onnx.helper.set_model_props(proto, entries)
    return with_seal(cast(bytes, proto.SerializeToString()))


def _input(session: Any, path: Path, pictures: dict[str, Any]) -> tuple[int | None, tuple[int, int]]:
    """Return the fixed number of pictures in a batch, None if it is free, and the size (height, width) of pictures."""
    inputs = session.get_inputs()
    shape = inputs[0].shape if inputs else []
    if (
        len(inputs) != 1
        or len(shape) != 4
        or inputs[0].type != "tensor(float)"
        or (isinstance(shape[1], int) and shape[1] != 3)
    ):
        named = first_few([f"{printable(one.name)} {one.type} {one.shape}" for one in inputs], 3)
        raise ModelFileError(
            f"{path.name} takes {named}; expected one input of pictures, float (batch, 3, height, width)."
        )
    batch, _, *sides = (side if isinstance(side, int) and side > 0 else None for side in shape)
    options = path.with_name("opts.yaml")
    stated = stated_size(pictures)
    if stated is None and None in sides and not options.is_file():
        log.warning(
            "%s does not tell the whole size of its pictures, so %d x %d pixels are assumed; if it was trained at another size, "
            "write h: and w: into an opts.yaml beside it.",
            printable(path.name),
            *_SIZE,
        )
    stated = stated or _SIZE
    if options.is_file() and None in sides:
        from lpn.models.published_checkpoints import read_options

        read = read_options(options)
        stated = (int(read.get("h", stated[0])), int(read.get("w", stated[1])))
    height, width = (side or other for side, other in zip(sides, stated, strict=True))
    if max(height, width) > MAX_SIDE:
        raise ModelFileError(f"{path.name} takes pictures of {height} x {width} pixels; expected at most {MAX_SIDE}.")
    return batch, (height, width)


def _tokens(session: Any, proto: Any, name: str, size: tuple[int, int], batch: int | None) -> _Tokens:
    """Find a graph's tokens by what it returns for a blank picture."""
    blank = np.zeros((batch or 1, 3, *size), np.float32)
    try:
        values = session.run(None, {session.get_inputs()[0].name: blank})
    except Exception as error:  # ONNX Runtime's errors have no common base
        reason = printable(str(error).strip().partition("\n")[0])[:200]
        raise ModelFileError(
            f"{name} cannot be computed for pictures of {size[0]} x {size[1]} pixels ({reason})."
        ) from error
    shapes = {
        output.name: value.shape
        for output, value in zip(session.get_outputs(), values, strict=True)
        if output.type == "tensor(float)" and (value.ndim == 3 or (value.ndim == 4 and max(value.shape[2:]) > 1))
    }
    ordered = sorted(shapes, key=lambda one: _NAMES.index(one) if one in _NAMES else len(_NAMES))
    patch = _patch(proto)
    fitting = [tokens for one in ordered for tokens in _as_tokens(one, shapes[one], size, patch)]
    if not fitting or (len(fitting) > 1 and fitting[0].name not in _NAMES):
        every = first_few([f"{printable(one.name)} {one.shape}" for one in session.get_outputs()], 4)
        raise ModelFileError(
            f"{name} returns {every}; expected one output of tokens (batch, tokens, channels) whose number fits a map of the "
            f"picture's {size[0]} x {size[1]} pixels, named last_hidden_state or tokens where there are several."
        )
    return fitting[0]


def _as_tokens(name: str, shape: tuple[int, ...], size: tuple[int, int], patch: int | None) -> list[_Tokens]:
    """Return the ways in which an output of this shape may hold a map, the one with the fewest tokens in front first."""
    if len(shape) == 4:
        return [_Tokens(name, (shape[2], shape[3]), 0, shape[1], True)]
    found = []
    for side in _PATCHES if patch is None else [patch]:
        grid = (size[0] // side, size[1] // side)
        prefix = shape[1] - grid[0] * grid[1]
        if grid[0] and grid[1] and 0 <= prefix <= _MOST_IN_FRONT and not (size[0] % side or size[1] % side):
            found.append(_Tokens(name, grid, prefix, shape[2], False))
    return sorted(found, key=lambda tokens: tokens.prefix)[:1]


def _patch(proto: Any) -> int | None:
    """Return the side of a patch in pixels: that of the first convolution whose kernel is as large as its step."""
    for node in proto.graph.node:
        sizes = {attribute.name: list(attribute.ints) for attribute in node.attribute}
        kernel = sizes.get("kernel_shape", [])
        if (
            node.op_type == "Conv"
            and len(set(kernel)) == 1
            and kernel == sizes.get("strides")
            and kernel[0] in _PATCHES
        ):
            return int(kernel[0])
    return None


def _append(
    proto: Any, picture: str, tokens: _Tokens, pooling: TokenPooling, size: tuple[int, int], batch: int | None
) -> None:
    """Put a pooling behind a graph's tokens; its input becomes `images` and its outputs those of a contract."""
    import onnx
    from onnx import TensorProto, compose, helper, numpy_helper

    graph = compose.add_prefix_graph(proto.graph, TOKENS)
    nodes: list[Any] = []

    def add(kind: str, *inputs: str, output: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, list(inputs), [output], **attributes))
        return output

    def constant(name: str, values: Any, kind: Any = np.float32) -> str:
        graph.initializer.append(numpy_helper.from_array(np.asarray(values, kind), name))
        return name

    def part_of(source: str, begin: int, end: int, output: str) -> str:
        bounds = (constant(f"{output}/{key}", [value], np.int64) for key, value in (("b", begin), ("e", end), ("a", 1)))
        return add("Slice", source, *bounds, output=output)

    def as_map(source: str, channels: int) -> str:
        shape = constant("map/shape", [0, channels, *tokens.grid], np.int64)
        turned = add("Transpose", source, output="map/turned", perm=[0, 2, 1])
        return add("Reshape", turned, shape, output="features")

    height, width = tokens.grid
    count, own = height * width, f"{TOKENS}{tokens.name}"
    if tokens.is_map:
        flat = add("Reshape", own, constant("flat/shape", [0, tokens.channels, count], np.int64), output="flat")
        own = add("Transpose", flat, output="cell_tokens", perm=[0, 2, 1])
    cells = part_of(own, tokens.prefix, tokens.prefix + count, "cell_tokens") if tokens.prefix else own
    first = part_of(own, 0, 1, "class_token") if pooling.needs_class_token else ""
    outputs = ["parts"]
    partition = pooling.partition
    if partition is None:
        add("Identity", first, output="parts")
    else:
        weights = partition.weights(*tokens.grid)
        shares = constant("shares", weights.reshape(len(weights), count))
        outputs += ["features", "cells"]
        add("Identity", constant("shares/map", weights), output="cells")
        if pooling.name == "gem":
            positive = add("Max", cells, constant("epsilon", EPSILON), output="positive")
            powers = add("Pow", positive, constant("power", pooling.power), output="powers")
            means = add("MatMul", shares, powers, output="power_means")
            add("Pow", means, constant("root", 1 / pooling.power), output="parts")
            scale = add("Pow", means, constant("split", 1 / pooling.power - 1), output="scale")
            as_map(add("Mul", powers, scale, output="split_powers"), tokens.channels)
        elif first:
            nothing = constant("nothing", np.zeros(tokens.channels))
            means = add("MatMul", shares, cells, output="means")
            add("Concat", first, means, output="parts", axis=2)
            add("Concat", first, add("Mul", first, nothing, output="no_class"), output="constants", axis=2)
            empty = add("Mul", cells, nothing, output="no_cells")
            as_map(add("Concat", empty, cells, output="both", axis=2), 2 * tokens.channels)
            outputs.append("constants")
        else:
            add("MatMul", shares, cells, output="parts")
            as_map(cells, tokens.channels)
    front = helper.make_node("Identity", ["images"], [f"{TOKENS}{picture}"])
    given = list(graph.node)
    del graph.node[:], graph.input[:], graph.output[:]
    graph.node.extend([front, *given, *nodes])
    graph.input.append(helper.make_tensor_value_info("images", TensorProto.FLOAT, [batch or "batch", 3, *size]))
    n, embedding = len(pooling.part_names), pooling.embedding(tokens.channels)
    shapes: dict[str, list[Any]] = {
        "parts": [batch or "batch", n, embedding],
        "features": [batch or "batch", embedding, *tokens.grid],
        "cells": [n, *tokens.grid],
        "constants": [batch or "batch", n, embedding],
    }
    graph.output.extend(helper.make_tensor_value_info(name, TensorProto.FLOAT, shapes[name]) for name in outputs)
    # Shapes of a free batch or size would contradict those of the new input.
    del graph.value_info[:]
    proto.graph.CopyFrom(graph)
    onnx.checker.check_model(proto)
