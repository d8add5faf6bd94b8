"""ONNX files that return tokens or a map: the unchanged graph, and a named pooling in NumPy."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import first_few, printable
from lpn.core.images import MEAN, STD
from lpn.core.resources import ProviderName
from lpn.core.views import View
from lpn.models.contract import ForwardPass, Heads
from lpn.models.onnx_engine import Engine
from lpn.models.options import (
    PICTURES,
    picture_size,
    read_configuration,
    read_options,
    stated_normalisation,
    stated_size,
)
from lpn.models.token_pooling import TokenPooling, pooled

log = logging.getLogger(__name__)

# Usual names of token outputs, the more common first.
_NAMES = ("last_hidden_state", "tokens", "x_norm_patchtokens", "patch_tokens", "features")
# The input size of a graph with open sides, and the tried patch sizes.
_SIZE, _PATCHES = (224, 224), range(4, 65)
# Maximum of prefix tokens; more do not fit a map.
_MOST_IN_FRONT = 16


class PooledEngine(Engine):
    """A network on ONNX Runtime that returns tokens (B, T, C) or a map (B, C, h, w), with a named pooling.

    The size of pictures is the graph's, else `h` and `w` of an opts.yaml beside the file, else that of a
    preprocessor_config.json, else 224 x 224. Mean and standard deviation come from the latter file, else from ImageNet.

    Args:
        pooling: of the tokens.
        path, threads, provider: see `Engine`.

    Raises:
        ModelFileError: if the file is damaged, or returns no tokens that fit a map.
        InputError: if it has parts of its own, or lacks a class token for the pooling.
    """

    def __init__(
        self, path: str | Path, pooling: TokenPooling, threads: int | None = None, provider: ProviderName = "cpu"
    ) -> None:
        self._pooling = pooling
        super().__init__(path, threads, provider)

    def _read(self, session: ort.InferenceSession, _: int) -> None:
        path, pooling = self._path, self._pooling
        metadata = session.get_modelmeta().custom_metadata_map
        if str(metadata.get("format", "")).startswith("lpn-explorer-onnx"):
            raise InputError(f"{path.name} says which parts it has; leave --pooling out.")
        pictures = read_configuration(path.parent, PICTURES)
        size = _size(session, path, pictures)
        self._output, shape = _tokens(session, path.name, size, self._fixed_batch or 1)
        self._grid, self._prefix = _grid(shape, size)
        channels = shape[1] if len(shape) == 4 else shape[2]
        if pooling.needs_class_token and not self._prefix:
            raise InputError(f"{path.name} has no class token for the pooling {pooling}; take mean, gem, or rings:N.")
        if not pictures:
            log.warning(
                "%s does not say how pictures are normalised; ImageNet's mean and standard deviation are taken. For "
                "others, put a preprocessor_config.json beside it.",
                printable(path.name),
            )
        normalisation = stated_normalisation(pictures, (MEAN, STD))
        self.contract = pooling.contract(printable(path.stem)[:60], size, channels, normalisation)
        self._shares = None if pooling.partition is None else pooling.partition.weights(*self._grid)
        self._constants, self._pass_outputs = [], [self._output]
        self._pooled = repr(self.contract)
        self._use([session])

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Run one forward pass of images (B, 3, H, W) of the model's input size."""
        (values,) = self._outputs([self._output], images, view)
        if self._shares is None:
            return ForwardPass(values[:, :1])
        cells = values
        if values.ndim == 3:
            cells = values[:, self._prefix :].swapaxes(1, 2).reshape(len(values), -1, *self._grid)
        parts, features, constants = pooled(self._pooling, self._shares, cells, values[:, 0], np.concatenate)
        return ForwardPass(parts, features, constants=constants)

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        return self.run(images, view).parts

    def heads(self, view: View) -> Heads:
        """Return the cells of the parts."""
        self.check_view(view)
        return Heads(cells=self._shares)

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the map of tokens; 1 x 1 without cells."""
        self.check_view(view)
        return self._grid if self.contract.has_cells else (1, 1)


def _size(session: ort.InferenceSession, path: Path, pictures: dict[str, Any]) -> tuple[int, int]:
    inputs = session.get_inputs()
    shape = inputs[0].shape if inputs else []
    colours = shape[1] if len(shape) == 4 and isinstance(shape[1], int) else 3
    if len(inputs) != 1 or len(shape) != 4 or inputs[0].type != "tensor(float)" or colours != 3:
        named = first_few([f"{printable(one.name)} {one.type} {one.shape}" for one in inputs], 3)
        raise ModelFileError(
            f"{path.name} takes {named}; expected one input of pictures, float (batch, 3, height, width)."
        )
    sides = [side if isinstance(side, int) and side > 0 else None for side in shape[2:]]
    stated = stated_size(pictures)
    read = picture_size(
        read_options(path.with_name("opts.yaml")), path.name, stated or _SIZE, stated is None and None in sides
    )
    height, width = (side or other for side, other in zip(sides, read, strict=True))
    return height, width


def _tokens(session: ort.InferenceSession, name: str, size: tuple[int, int], batch: int) -> tuple[str, tuple[int, ...]]:
    """Return the output of tokens or of a map, and its shape, from the graph's results for a blank picture."""
    try:
        values = session.run(None, {session.get_inputs()[0].name: np.zeros((batch, 3, *size), np.float32)})
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
    fitting = [one for one in (*_NAMES, *shapes) if one in shapes and _grid(shapes[one], size)[0] != (0, 0)]
    if not fitting or (fitting[0] not in _NAMES and len(set(fitting)) > 1):
        every = first_few([f"{printable(one.name)} {one.shape}" for one in session.get_outputs()], 4)
        raise ModelFileError(
            f"{name} returns {every}; expected one output of tokens (batch, tokens, channels) whose number fits a map of the "
            f"picture's {size[0]} x {size[1]} pixels, named last_hidden_state or tokens where there are several."
        )
    return fitting[0], shapes[fitting[0]]


def _grid(shape: tuple[int, ...], size: tuple[int, int]) -> tuple[tuple[int, int], int]:
    """Return the (h, w) of an output's cells, and the number of prefix tokens, the fewest that fit a patch size."""
    if len(shape) == 4:
        return (shape[2], shape[3]), 0
    grids = [(size[0] // side, size[1] // side) for side in _PATCHES if size[0] % side == size[1] % side == 0]
    fronts = {(h, w): shape[1] - h * w for h, w in grids if 0 <= shape[1] - h * w <= min(_MOST_IN_FRONT, h * w - 1)}
    return min(fronts.items(), key=lambda pair: pair[1], default=((0, 0), 0))
