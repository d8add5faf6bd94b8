"""The trace of a described picture: each part's embedding as a sum over cells and one constant, see `lpn.explain`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, FloatingArray
from lpn.core.errors import InputError, ModelFileError
from lpn.core.views import View
from lpn.models.base import Model, whitened
from lpn.models.contract import ForwardPass, check_pass, check_shapes


@dataclass(frozen=True, eq=False)
class Trace:
    """The intermediate results from which exact evidence is computed, in the terms of `lpn.models.contract`.

    Attributes:
        embedding: part embeddings, summed over the passes, with `Model.centring` added, whitened, (n, D).
        features: the map of each of P passes, (P, C, h, w), or of each part of each pass, (P, n, C, h, w); the map of the
            mirror is flipped back.
        cells: the weight of each cell in each part of each pass, (P, n, h, w).
        weight: the heads, (n, D, C); None for the identity.
        slopes: the activation's slope for each number of each pass's embedding, (P, n, D); None without an activation.
        constants: the embedding less the sum over cells, (n, D) float64; includes all passes, the view's mean, and whitening.
        whitening: the matrix of each part after the heads, (n, D, D); None for the identity.
    """

    embedding: Float32Array
    features: Float32Array
    cells: Float32Array
    weight: Float32Array | None
    slopes: Float32Array | None
    constants: Float64Array
    whitening: Float32Array | None = None

    @classmethod
    def from_pass(cls, model: Model, outputs: ForwardPass, view: View) -> Trace:
        """Return the trace of a forward pass of a picture, or of a picture and its mirror as a batch of two.

        Raises:
            InputError: if the model's contract has no cells.
            ModelFileError: if the shapes contradict the contract.
        """
        contract, heads, passes = model.contract, model.heads(view), len(outputs.parts)
        if not contract.has_cells:
            raise InputError(f"{contract.method} has no cells ({contract.claim}), so there is no evidence to compute.")
        check_pass(contract, outputs, heads)
        features = cast(Float32Array, outputs.features)
        cells = outputs.cells
        if cells is None:
            fixed, partition, size = heads.cells, contract.partition(view), features.shape[-2:]
            if (fixed is None or fixed.shape[1:] != size) and partition is not None:
                # A model in PyTorch accepts images of other sizes, whose cells differ.
                fixed = partition.weights(*size)
            if fixed is None:
                raise ModelFileError(
                    f"{contract.method} returns a map of {size[0]} x {size[1]} cells without the part of each cell; "
                    "return cells with each picture, or in the heads."
                )
            check_shapes(contract, {"features": (1, 1, *size), "the heads' cells": fixed.shape}, channels=False)
            cells = np.broadcast_to(fixed, (passes, *fixed.shape))
        embedding = cast(Float32Array, outputs.parts.sum(axis=0))
        constants = np.broadcast_to(model.centring(embedding, view), embedding.shape)
        added = heads.bias if outputs.constants is None else outputs.constants
        each = np.zeros(outputs.parts.shape) if added is None else np.broadcast_to(added, outputs.parts.shape)
        each = each if outputs.slopes is None else outputs.slopes * each
        return cls(
            whitened((embedding + constants).astype(np.float32), model.whitening),
            _upright(features),
            _upright(cells),
            heads.weight,
            outputs.slopes,
            whitened(constants + each.sum(axis=0, dtype=np.float64), model.whitening),
            model.whitening,
        )

    @property
    def size(self) -> tuple[int, int]:
        """(h, w) of the feature map."""
        return self.features.shape[-2], self.features.shape[-1]

    @property
    def nbytes(self) -> int:
        """The bytes of maps and cells, without the heads, which traces share."""
        return self.features.nbytes + self.cells.nbytes

    @property
    def activation(self) -> Float32Array:
        """The channel sum of the picture's map, (h, w); with a map for each part, a cell sums over its parts."""
        total = self.part_totals
        return total[0] if len(total) == 1 else cast(Float32Array, (total * (self.cells[0] != 0)).sum(axis=0))

    @property
    def part_totals(self) -> Float32Array:
        """The channel sum of the picture's map, (1, h, w), or of each part's map, (n, h, w)."""
        total = cast(Float32Array, self.features[0].sum(axis=-3))
        return total[None] if total.ndim == 2 else total

    def along(self, direction: FloatingArray) -> tuple[Float64Array, Float64Array]:
        """Split the inner product of the embedding with a direction (n, D) into cells (n, h, w) and constants (n,)."""
        direction = direction.astype(np.float32)
        constants = np.einsum("nd,nd->n", direction, self.constants, dtype=np.float64)
        if self.whitening is not None:
            direction = whitened(direction, self.whitening.swapaxes(-1, -2))
        turned = np.broadcast_to(direction, (len(self.cells), *direction.shape))
        turned = turned if self.slopes is None else turned * self.slopes
        pulled = turned
        if self.weight is not None:
            pulled = np.matmul(turned.transpose(1, 0, 2), self.weight).transpose(1, 0, 2)
        flat = self.features.reshape(*self.features.shape[:-2], -1)
        responses = np.matmul(pulled, flat) if flat.ndim == 3 else np.matmul(pulled[:, :, None], flat)
        shares = responses.reshape(self.cells.shape) * self.cells
        return shares.sum(axis=0, dtype=np.float64), constants

    def vectors(self, part: int, only: BoolArray | None = None) -> Float32Array:
        """Return each cell's term of a part's embedding, (h * w, D); their sum plus the constant is the embedding.

        Args:
            only: cells (h, w) to sum over; the result is then (D,).
        """
        total: Float32Array | None = None
        for number, cells in enumerate(self.cells[:, part]):
            features = self.features[number] if self.features.ndim == 4 else self.features[number, part]
            flat, weights = features.reshape(len(features), -1), cells.reshape(-1)
            added = flat * weights if only is None else (flat @ (weights * only.reshape(-1)))[:, None]
            added = added if self.weight is None else self.weight[part] @ added
            added = added if self.slopes is None else added * self.slopes[number, part][:, None]
            total = added if total is None else total + added
        assert total is not None
        total = total if self.whitening is None else self.whitening[part] @ total
        return total.T if only is None else total[:, 0]

    def errors(self) -> Float64Array:
        """Return the largest error of cells plus constants in each part, as a share of the part's largest value, (n,).

        The share is infinite if a sum is not finite.
        """
        everywhere = np.ones(self.size, bool)
        with np.errstate(over="ignore", invalid="ignore"):
            sums = np.stack([self.vectors(part, everywhere) for part in range(len(self.embedding))])
            missed = np.abs(sums + self.constants - self.embedding).max(axis=1)
            share = missed / np.maximum(np.abs(self.embedding).max(axis=1).astype(np.float64), 1e-30)
        return np.where(np.isfinite(share), share, np.inf)

    def region(self, cells: BoolArray, weights: Float32Array) -> Float32Array:
        """Return the query of a region, (n, D), which ranks a gallery by the region's share of the scores.

        Parts without a cell in the region are zero, and the constants are left out. The query is scaled to
        sum_i w_i n |q_i|^2 = 1, so that 2 - 2 score is a squared distance, as for whole queries.

        Args:
            cells: the region, (h, w).
            weights: part weights with sum one, (n,).

        Raises:
            InputError: if the region's shape is not that of the feature map, or no cell belongs to a part that counts.
        """
        if cells.shape != self.size:
            raise InputError(f"The region has {cells.shape} cells; the feature map has {self.size}.")
        parts = np.stack([self.vectors(part, cells) for part in range(len(self.embedding))])
        parts /= np.maximum(np.linalg.norm(self.embedding, axis=1, keepdims=True), 1e-12)
        norm = float(np.sqrt(len(parts) * (weights * (parts**2).sum(axis=1)).sum()))
        if norm < 1e-12:
            raise InputError("No cell of a part that counts is painted; paint some of the query, and search again.")
        return cast(Float32Array, parts / np.float32(norm))


def _upright(values: Float32Array) -> Float32Array:
    """Flip the columns of the second pass, which is of the mirrored picture."""
    return values if len(values) == 1 else np.concatenate([values[:1], values[1:, ..., ::-1]])
