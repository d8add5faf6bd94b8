"""The contract of a loaded model, in PyTorch or on ONNX Runtime."""

from __future__ import annotations

import copy
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, NamedTuple, Self, cast

import numpy as np

from lpn.core import images as pictures
from lpn.core.arrays import AnyArray, Float32Array, UInt8Array
from lpn.core.errors import InputError, ModelFileError
from lpn.core.views import View
from lpn.models.spec import ModelSpec

_CHUNK = 16


@dataclass(frozen=True)
class Heads:
    """The affine test-time heads: the embedding of part i is `A[i] @ sum_cells(cells[i] * map) + c[i]`.

    Attributes:
        weight: A, (n, D, C) float32.
        bias: c, (n, D) float32.
        cells: the partition's cell weights, (n, h, w) float32.
    """

    weight: Float32Array
    bias: Float32Array
    cells: Float32Array


class ForwardPass(NamedTuple):
    """The result of one forward pass.

    Attributes:
        parts: raw head outputs, (B, n, D).
        features: the last feature map, (B, C, h, w).
        attention: SAFA's cell weights of each picture, (B, n, M, h, w); None with fixed cell weights.
    """

    parts: Float32Array
    features: Float32Array
    attention: Float32Array | None


class Model(ABC):
    """A trained LPN, ready to describe pictures.

    Images are (B, 3, H, W) float32, RGB, ImageNet-normalised (see `lpn.core.images`), as NumPy array or torch tensor.

    Attributes:
        spec: the architecture.
        fingerprint: hexadecimal digest of the model file; only descriptors with the same fingerprint are comparable.
        precision: the precision of its convolutions, "float32" or "int8".
        device: what it computes on, "cpu", "cuda", or "tensorrt".
        parallel: whether several threads can call it in parallel, each on one core.
        batch: the best batch size for `descriptors`.
        means: the mean descriptor of a view, (n, D), that is subtracted from each of its descriptors; see `centred`.
    """

    spec: ModelSpec
    fingerprint: str
    precision: str = "float32"
    device: str = "cpu"
    parallel: bool = False
    batch: int = 4
    means: Mapping[View, Float32Array] = MappingProxyType({})

    def describe(self) -> str:
        """Return one line for a header or a log: the architecture, a precision other than float32, and the GPU."""
        precision = "" if self.precision == "float32" else f", {self.precision}"
        return self.spec.describe() + precision + ("" if self.device == "cpu" else f", on {self.device}")

    @property
    def n_parts(self) -> int:
        """The number of parts n of a descriptor."""
        return self.spec.n_parts

    @property
    def input_size(self) -> tuple[int, int]:
        """(height, width) of the network input in pixels."""
        return self.spec.input_size

    @property
    def views(self) -> tuple[View, ...]:
        """The views that have a branch, in the order satellite, street, drone."""
        return self.spec.views

    @abstractmethod
    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Run one forward pass of images (B, 3, H, W)."""

    @abstractmethod
    def heads(self, view: View) -> Heads:
        """Return the affine heads and cell weights, for exact explanation.

        Raises:
            InputError: if the model lacks the view, or has no heads (SAFA).
        """

    @abstractmethod
    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the feature map of an image of the model's input size."""

    def to_input_size(self, picture: UInt8Array, view: View) -> UInt8Array:
        """Resize a picture to the input size, (height, width, 3) uint8; a polar model's tiles are unrolled into panoramas."""
        if self.spec.unrolled(view):
            return pictures.polar(picture, *self.input_size)
        return pictures.resize(picture, *self.input_size)

    def as_partitioned(self, picture: UInt8Array, view: View) -> UInt8Array:
        """Return the picture on which parts are drawn: the unrolled tile of a polar model, else the picture itself."""
        return self.to_input_size(picture, view) if self.spec.unrolled(view) else picture

    def prepare(self, picture: UInt8Array, view: View) -> Float32Array:
        """Convert a picture to the model's input: (3, height, width) float32."""
        return pictures.normalise(self.to_input_size(picture, view))

    def part_embeddings(self, images: Any, view: View) -> Float32Array:
        """Return the raw head outputs, (B, n, D) float32; the parts are in the order of the checkpoint's classifiers.

        Raises:
            InputError: if images are not (B, 3, H, W) float32, or the model lacks the view.
        """
        batch = self._batch(images, view)
        size = max(_CHUNK, self.batch)
        chunks = [self._parts(batch[i : i + size], view) for i in range(0, len(batch), size)]
        return np.concatenate(chunks) if chunks else np.zeros((0, self.n_parts, self.spec.embedding), np.float32)

    def descriptors(self, images: Any, view: View, mirror: bool = True) -> Float32Array:
        """Return descriptors for retrieval, (B, n, D) float32, each part of norm 1/sqrt(n).

        With `mirror`, the head outputs of the picture and of its horizontal mirror are added first, as published for LPN;
        SAFA, which distinguishes left from right, ignores it.

        Raises:
            InputError: as for `part_embeddings`.
            ModelFileError: if the network's output is not finite.
        """
        raw = self.part_embeddings(images, view)
        if mirror and self.spec.mirrored:
            raw = raw + self.part_embeddings(np.ascontiguousarray(self._batch(images, view)[..., ::-1]), view)
        return normalise(raw + self.centring(raw, view))

    def centred(self, means: Mapping[View, Float32Array]) -> Self:
        """Return this model with descriptors from which the mean of their view is subtracted, part by part.

        The parts are scaled to norm 1/sqrt(n) again. The fingerprint changes with the means.

        Args:
            means: mean descriptors (n, D) by view; a view without one is not centred.
        """
        moved = copy.copy(self)
        moved.means = dict(means)
        digest = hashlib.sha256(self.fingerprint.encode())
        for view in sorted(means):
            digest.update(view.encode() + np.ascontiguousarray(means[view], np.float32).tobytes())
        moved.fingerprint = digest.hexdigest()
        return moved

    def centring(self, raw: Float32Array, view: View) -> Float32Array:
        """Return what is added to raw part embeddings (..., n, D), mirror included, before they are scaled: (..., n, D).

        It is -sqrt(n) |e_i| m_i for an embedding e_i and the view's mean m_i, as q_i = e_i / (sqrt(n) |e_i|); 0 without a mean.
        """
        mean = self.means.get(view)
        if mean is None:
            return np.zeros((), np.float32)
        norms = np.linalg.norm(raw, axis=-1, keepdims=True) * np.float32(np.sqrt(raw.shape[-2]))
        return cast(Float32Array, (-norms * mean).astype(np.float32))

    def for_parallel_inference(self) -> Model:
        """Return this model configured for several threads, see `lpn.descriptors.parallel_inference`."""
        return self

    def check_view(self, view: str) -> None:
        """Raise InputError unless the model has the view."""
        if view not in self.views:
            raise InputError(f"This model has no {view!r} view; it has {', '.join(self.views)}.")

    def check_heads(self) -> None:
        """Raise InputError unless the model has affine heads."""
        if self.spec.pooling == "safa":
            raise InputError(
                "This is a SAFA model, which has no affine heads: its cell weights differ from picture to picture."
            )

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        """Return the part embeddings of one chunk; overridden by models that can skip the feature map."""
        return self.run(images, view).parts

    def _batch(self, images: Any, view: View) -> Float32Array:
        self.check_view(view)
        batch = as_array(images)
        if batch.ndim != 4 or batch.shape[1] != 3 or not np.issubdtype(batch.dtype, np.floating):
            raise InputError(
                f"The images are {batch.dtype} of shape {batch.shape}; expected float32 (B, 3, H, W), ImageNet-normalised."
            )
        return cast(Float32Array, np.ascontiguousarray(batch, dtype=np.float32))


def as_array(values: Any) -> AnyArray:
    """Convert an array, nested lists, or a torch tensor on any device to a NumPy array.

    Raises:
        InputError: if nested lists have unequal lengths.
    """
    if hasattr(values, "detach"):
        values = values.detach().cpu()
        values = (values.float() if str(values.dtype) == "torch.bfloat16" else values).numpy()
    try:
        return np.asarray(values)
    except ValueError as error:
        raise InputError("The rows have unequal lengths; expected rows of one length.") from error


def normalise(raw: Float32Array) -> Float32Array:
    """Scale each part of (..., n, D) head outputs to norm 1/sqrt(n), so that the descriptor has norm 1.

    Raises:
        ModelFileError: if a value is not finite.
    """
    if not np.isfinite(raw).all():
        raise ModelFileError(
            "The model's output is not finite, so its weights are damaged or its training diverged; use another model."
        )
    norms = np.linalg.norm(raw, axis=-1, keepdims=True) * np.sqrt(raw.shape[-2])
    return cast(Float32Array, (raw / np.maximum(norms, 1e-12)).astype(np.float32))
