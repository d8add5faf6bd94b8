"""The trace of a described picture: each part's embedding as a sum over cells and one constant, see `lpn.explain`."""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np

from lpn.core.arrays import BoolArray, Float32Array, Float64Array, FloatingArray
from lpn.core.errors import InputError
from lpn.core.views import View
from lpn.models.base import ForwardPass, Heads, Model
from lpn.models.spec import SLOPES


@dataclass(frozen=True, eq=False)
class Trace:
    """The intermediate results from which exact evidence is computed.

    Attributes:
        embedding: part embeddings, the mirror's and `centring` added, (n, D).
        features: the feature map of each of P passes, the mirror's flipped back, (P, C, h, w).
        cells: the weight of each cell in each part of each pass, (P, n, M, h, w); M is 1, or SAFA's number of maps.
        heads: the affine heads; None with SAFA, whose parts are the weighted sums.
        slopes: the activation's slope for each number of each pass's embedding, (P, n, D); None without an activation.
        centring: the term that subtracts the view's mean descriptor, (n, D), see `Model.centring`; part of the constants.
    """

    embedding: Float32Array
    features: Float32Array
    cells: Float32Array
    heads: Heads | None
    slopes: Float32Array | None
    centring: Float32Array

    @classmethod
    def from_pass(cls, model: Model, outputs: ForwardPass, view: View) -> Trace:
        """Return the trace of a forward pass of a picture, or of a picture and its mirror as a batch of two."""
        attention = outputs.attention
        heads = None if attention is not None else model.heads(view)
        if heads is None:
            cells = cast(Float32Array, attention)
        else:
            # A model in PyTorch accepts images of other sizes, whose cells differ.
            size = outputs.features.shape[2:]
            weights = heads.cells if heads.cells.shape[1:] == size else model.spec.partition(view).weights(*size)
            cells = np.broadcast_to(weights[None, :, None], (len(outputs.parts), len(weights), 1, *size))
        bent = heads is not None and model.spec.activation != "none"
        below = np.float32(SLOPES[model.spec.activation])
        slopes = np.where(outputs.parts > 0, np.float32(1), below) if bent else None
        embedding = cast(Float32Array, outputs.parts.sum(axis=0))
        centring = np.broadcast_to(model.centring(embedding, view), embedding.shape)
        return cls(embedding + centring, _upright(outputs.features), _upright(cells), heads, slopes, centring)

    @property
    def size(self) -> tuple[int, int]:
        """(h, w) of the feature map."""
        return self.features.shape[2], self.features.shape[3]

    def along(self, direction: FloatingArray) -> tuple[Float64Array, Float64Array]:
        """Split the inner product of the embedding with a direction (n, D) into cells (n, h, w) and constants (n,)."""
        passes, channels = self.features.shape[:2]
        parts, maps = self.cells.shape[1:3]
        direction = direction.astype(np.float32)
        constants = np.einsum("nd,nd->n", direction, self.centring, dtype=np.float64)
        if self.heads is None:
            pulled = np.broadcast_to(direction.reshape(1, parts * maps, channels), (passes, parts * maps, channels))
        else:
            turned = np.broadcast_to(direction, (passes, *direction.shape))
            turned = turned if self.slopes is None else turned * self.slopes
            pulled = np.matmul(turned.transpose(1, 0, 2), self.heads.weight).transpose(1, 0, 2)
            constants = constants + np.einsum("pnd,nd->n", turned, self.heads.bias, dtype=np.float64)
        responses = np.matmul(pulled, self.features.reshape(passes, channels, -1))
        shares = responses.reshape(self.cells.shape) * self.cells
        return shares.sum(axis=(0, 2), dtype=np.float64), constants

    def vectors(self, part: int, only: BoolArray | None = None) -> Float32Array:
        """Return each cell's term of a part's embedding, (h * w, D); their sum plus the constant is the embedding.

        Args:
            only: cells (h, w) to sum over; the result is then (D,).
        """
        flat = self.features.reshape(*self.features.shape[:2], -1)
        total: Float32Array | None = None
        for number, (features, cells) in enumerate(zip(flat, self.cells[:, part], strict=True)):
            weights = cells.reshape(len(cells), -1)
            if only is None:
                pooled = features * weights[:, None]
            else:
                pooled = np.matmul(features, (weights * only.reshape(-1)).T).T[..., None]
            if self.heads is None:
                added = pooled.reshape(-1, pooled.shape[-1])
            else:
                added = self.heads.weight[part] @ pooled[0]
                added = added if self.slopes is None else added * self.slopes[number, part][:, None]
            total = added if total is None else total + added
        assert total is not None
        return total.T if only is None else total[:, 0]

    def region(self, cells: BoolArray, weights: Float32Array) -> Float32Array:
        """Return the query of a region, (n, D), which ranks a gallery by the region's contribution to the scores.

        Parts without a cell in the region are zero, and the constants are left out. The query is scaled to
        sum_i w_i n |q_i|^2 = 1, so that 2 - 2 score is a squared distance as for whole queries.

        Args:
            cells: the region, (h, w).
            weights: part weights that sum to one, (n,).

        Raises:
            InputError: if its shape is not the feature map's, or no cell belongs to a part that counts.
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
