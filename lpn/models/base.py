"""A loaded model that describes pictures, in PyTorch, on ONNX Runtime, or in any other program; see `lpn.models.contract`."""

from __future__ import annotations

import copy
import hashlib
from abc import ABC, abstractmethod
from collections.abc import Mapping
from functools import cached_property
from types import MappingProxyType
from typing import Any, Self, TypeVar, cast

import numpy as np

from lpn.core import images as pictures
from lpn.core.arrays import AnyArray, Float32Array, Float64Array, UInt8Array
from lpn.core.errors import InputError, ModelFileError
from lpn.core.views import View
from lpn.models.contract import Contract, ForwardPass, Heads, Role, check_shapes
from lpn.models.spec import ModelSpec

_CHUNK = 16
Floats = TypeVar("Floats", Float32Array, Float64Array)


class Model(ABC):
    """A trained part-based model, ready to describe pictures.

    A user's own model sets `contract` and defines `run`, and `heads` if it has static ones. Images are (B, 3, H, W)
    float32, RGB, normalised by the contract, as NumPy array or torch tensor.

    Attributes:
        contract: the model's description of itself.
        spec: the architecture of an LPN, for training and export; None for other models.
        precision: the precision of its convolutions, "float32" or "int8".
        device: the device of the computation, "cpu", "cuda", or another provider of ONNX Runtime.
        parallel: whether several threads can call it in parallel, each on one core.
        batch: the best batch size for `descriptors`.
        means: the mean descriptor of a view, (n, D), subtracted from each of its descriptors; see `centred`.
        whitening: the matrix that multiplies each centred part, (n, D, D); None without whitening.
        branches: the role of each view in the task of `for_task`; empty before.
    """

    contract: Contract
    spec: ModelSpec | None = None
    precision: str = "float32"
    device: str = "cpu"
    parallel: bool = False
    batch: int = 4
    means: Mapping[View, Float32Array] = MappingProxyType({})
    whitening: Float32Array | None = None
    branches: Mapping[View, Role] = MappingProxyType({})

    @cached_property
    def fingerprint(self) -> str:
        """A hexadecimal digest; only descriptors of equal fingerprints are comparable.

        A model from a file sets the file's digest. Otherwise it is the digest of the contract and of the model's output for one
        picture of noise in each view.
        """
        digest = hashlib.sha256(repr(self.contract).encode())
        noise = np.random.default_rng(0).standard_normal((1, 3, *self.input_size)).astype(np.float32)
        for view in self.views:
            digest.update(np.ascontiguousarray(self.run(noise, view).parts, np.float32).tobytes())
        return digest.hexdigest()

    def describe(self) -> str:
        """Return one line for a header or a log: the model, a precision other than float32, and the GPU."""
        precision = "" if self.precision == "float32" else f", {self.precision}"
        return self.contract.title + precision + ("" if self.device == "cpu" else f", on {self.device}")

    def __repr__(self) -> str:
        return f"<{self.describe()}>"

    @property
    def n_parts(self) -> int:
        """The number of parts n of a descriptor."""
        return self.contract.n_parts

    @property
    def embedding(self) -> int:
        """The length D of a part."""
        return self.contract.embedding

    @property
    def input_size(self) -> tuple[int, int]:
        """(height, width) of the network input in pixels."""
        return self.contract.input_size

    @property
    def views(self) -> tuple[View, ...]:
        """The views that it describes, in the order satellite, street, drone."""
        return self.contract.views

    @abstractmethod
    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Run one forward pass of images (B, 3, H, W)."""

    def heads(self, view: View) -> Heads:
        """Return the terms that are equal for all pictures of a view; empty by default.

        Raises:
            InputError: if the model lacks the view.
        """
        self.check_view(view)
        return Heads()

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the feature map of an image of the model's input size; 1 x 1 without cells."""
        self.check_view(view)
        features = self.run(np.zeros((1, 3, *self.input_size), np.float32), view).features
        return (1, 1) if features is None else (features.shape[-2], features.shape[-1])

    def for_task(self, query: View, gallery: View) -> Self:
        """Return this model for the queries and the gallery of one task.

        It is another model only if branches have roles: `role` is then the view's role in the task.

        Raises:
            InputError: if branches have roles, and queries and gallery are of one view.
        """
        if self.contract.roles == "view":
            return self
        if query == gallery:
            raise InputError(
                f"{self.contract.method} has one branch for queries and one for the gallery, and this task has both of one "
                f"view, {query}; choose a task of two views."
            )
        if self.branches == {query: "query", gallery: "gallery"}:
            return self
        bound = copy.copy(self)
        bound.branches = {query: "query", gallery: "gallery"}
        if any(bound.role(view) != self.role(view) for view in (query, gallery)):
            bound.fingerprint = hashlib.sha256(f"{self.fingerprint} {query} {gallery}".encode()).hexdigest()
        return bound

    def in_role(self, view: View, role: Role | None) -> Self:
        """Return this model for pictures of one view, as queries or gallery of a task with another view.

        Its fingerprint equals that of `for_task`.

        Args:
            role: None for the role of the view outside of a task.

        Raises:
            InputError: if the model lacks the view, or a role is given and its branches have none.
        """
        self.check_view(view)
        if role is None:
            return self
        if self.contract.roles == "view":
            raise InputError(
                f"{self.contract.method} has no branches for queries and for the gallery; leave the role out."
            )
        other = next(other for other in self.views if other != view)
        return self.for_task(view, other) if role == "query" else self.for_task(other, view)

    def role(self, view: View) -> Role:
        """Return the role of a view if branches have roles; outside of a task, see `Contract.default_role`."""
        return self.branches.get(view, self.contract.default_role(view))

    def to_input_size(self, picture: UInt8Array, view: View) -> UInt8Array:
        """Resize a picture to the input size, (height, width, 3) uint8; a polar model's tiles are unrolled into panoramas."""
        if self.contract.unrolled(view):
            return pictures.polar(picture, *self.input_size)
        return pictures.resize(picture, *self.input_size, self.contract.resize)

    def as_partitioned(self, picture: UInt8Array, view: View) -> UInt8Array:
        """Return the picture on which parts are drawn: the unrolled tile of a polar model, else the picture itself."""
        return self.to_input_size(picture, view) if self.contract.unrolled(view) else picture

    def normalise(self, picture: UInt8Array) -> Float32Array:
        """Normalise a picture of the input size by the contract: (H, W, 3) uint8 to (3, H, W) float32."""
        return pictures.normalise(picture, self.contract.mean, self.contract.std)

    def prepare(self, picture: UInt8Array, view: View) -> Float32Array:
        """Convert a picture to the model's input: (3, height, width) float32."""
        return self.normalise(self.to_input_size(picture, view))

    def with_mirror(self, prepared: Float32Array) -> Float32Array:
        """Return the batch that describes one prepared picture: itself, and its mirror if the contract sums both."""
        both = [prepared, prepared[..., ::-1]] if self.contract.mirror == "sum" else [prepared]
        return np.stack(both)

    def part_embeddings(self, images: Any, view: View) -> Float32Array:
        """Return the raw head outputs, (B, n, D) float32; the parts are in the order of the checkpoint's classifiers.

        Raises:
            InputError: if images are not (B, 3, H, W) float32, or the model lacks the view.
        """
        batch = self._batch(images, view)
        size = max(_CHUNK, self.batch)
        chunks = [self._parts(batch[i : i + size], view) for i in range(0, len(batch), size)]
        return np.concatenate(chunks) if chunks else np.zeros((0, self.n_parts, self.embedding), np.float32)

    def descriptors(self, images: Any, view: View, mirror: bool = True) -> Float32Array:
        """Return descriptors for retrieval, (B, n, D) float32, each part of norm 1/sqrt(n).

        With `mirror`, the raw parts of the picture and of its horizontal mirror are added first, if the contract sums both.

        Raises:
            InputError: as for `part_embeddings`.
            ModelFileError: if the network's output is not finite.
        """
        raw = self.part_embeddings(images, view)
        if mirror and self.contract.mirror == "sum":
            raw = raw + self.part_embeddings(np.ascontiguousarray(self._batch(images, view)[..., ::-1]), view)
        return normalise(whitened(raw + self.centring(raw, view), self.whitening))

    def centred(self, means: Mapping[View, Float32Array], whitening: Float32Array | None = None) -> Self:
        """Return this model with descriptors from which the mean of their view is subtracted, part by part.

        The parts are then whitened, and scaled to norm 1/sqrt(n) again. The fingerprint changes with means and whitening. The
        contract adds the length of the mean's term to the held quantities, see `centring`.

        Args:
            means: mean descriptors (n, D) by view; a view without one is not centred.
            whitening: a matrix for each part of all views, (n, D, D); None without whitening.
        """
        moved = copy.copy(self)
        moved.means, moved.whitening = dict(means), whitening
        if means:
            moved.contract = self.contract.with_held("the length of the mean's term")
        digest = hashlib.sha256(self.fingerprint.encode())
        for view in sorted(means):
            digest.update(view.encode() + np.ascontiguousarray(means[view], np.float32).tobytes())
        if whitening is not None:
            digest.update(np.ascontiguousarray(whitening, np.float32).tobytes())
        moved.fingerprint = digest.hexdigest()
        return moved

    def centring(self, raw: Float32Array, view: View) -> Float32Array:
        """Return the term that centring adds to raw part embeddings (..., n, D), mirror included: (..., n, D).

        It is -sqrt(n) |e_i| m_i for an embedding e_i and the mean m_i, as e_i is then divided by sqrt(n) |e_i|; 0 without mean.
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

    def check_size(self, images: Float32Array) -> None:
        """Raise InputError unless images (B, 3, H, W) are of the model's input size."""
        if images.shape[2:] != self.input_size:
            raise InputError(
                f"The images are {images.shape[2]} x {images.shape[3]}; this model takes {self.input_size[0]} x "
                f"{self.input_size[1]}, so resize them, or open or export it for that size."
            )

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        """Return the part embeddings of one chunk; a model may override it to skip the feature map."""
        outputs = self.run(images, view)
        check_shapes(self.contract, {"pictures": (len(images),), "parts": outputs.parts.shape})
        return outputs.parts

    def _batch(self, images: Any, view: View) -> Float32Array:
        self.check_view(view)
        batch = as_array(images)
        if batch.ndim != 4 or batch.shape[1] != 3 or not np.issubdtype(batch.dtype, np.floating):
            raise InputError(
                f"The images are {batch.dtype} of shape {batch.shape}; expected float32 (B, 3, H, W), normalised."
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


def whitened(raw: Floats, whitening: Float32Array | None) -> Floats:
    """Multiply each part of (..., n, D) by its matrix of (n, D, D); None changes nothing."""
    if whitening is None:
        return raw
    return cast(Floats, np.matmul(raw[..., None, :], whitening.swapaxes(-1, -2))[..., 0, :].astype(raw.dtype))


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
