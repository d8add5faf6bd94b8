"""A model on ONNX Runtime: an exported LPN, or any graph with a contract in its metadata.

A model is one graph for each group of views that share weights. Each graph also yields its heads as constant outputs, so
evidence can be computed with ONNX Runtime alone.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import Any, cast

import numpy as np
import onnxruntime as ort

from lpn.core.arrays import Float32Array
from lpn.core.checksums import SEAL, check_seal
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import fingerprint, printable
from lpn.core.formats import is_newer, newer_version
from lpn.core.resources import COMPUTE_ON_CPU, ProviderName, resolve_provider, usable_cores
from lpn.core.views import View
from lpn.models import contract_metadata, providers
from lpn.models.base import Model
from lpn.models.contract import MAX_SIDE, ForwardPass, Heads
from lpn.models.contract_metadata import from_metadata
from lpn.models.file_contents import check_contents
from lpn.models.onnx_check import check_self_contained
from lpn.models.spec import ModelSpec

log = logging.getLogger(__name__)

FORMAT = "lpn-explorer-onnx/1"
# The metadata entry of a quantised file, see `lpn.models.quantize`.
COMPUTE = "compute"
# The prefix of the names of the nodes before a published model's maps and tokens, from which parts and account both come.
TRUNK = "trunk/"
OUTPUTS = ("parts", "features")
HEAD_OUTPUTS = ("head_weight", "head_bias", "cells")
SAFA_OUTPUTS = ("attention",)
# Outputs of a graph with a contract beside `parts`: those of each picture, and those that are the same for all.
PASS_OUTPUTS = ("features", "cells", "constants", "slopes")
CONSTANT_OUTPUTS = ("head_weight", "head_bias", "cells")
# Pixels of a batch of a fixed size, far beyond any sensible network; see `MAX_SIDE`.
_MAX_PIXELS = 1 << 26
_AGAIN = "copy it again from where it came, or export the model again"


def extra_outputs(spec: ModelSpec) -> tuple[str, ...]:
    """Return the outputs beside `OUTPUTS`: the heads, or SAFA's weight maps of the picture."""
    return SAFA_OUTPUTS if spec.pooling == "safa" else HEAD_OUTPUTS


class Engine(Model):
    """A model that runs from `.onnx` files, without torch.

    Args:
        path: the file written by `lpn export`; files of further view groups lie beside it.
        threads: threads per forward pass on the CPU; default: all usable cores.
        provider: "auto" is LPN_PROVIDER if that is set, else CUDA if it works, else the CPU, which also computes models in
            8 bits. Another execution provider of ONNX Runtime is taken by its name.

    Raises:
        ModelFileError: if a file is missing or damaged, or states neither an LPN nor a contract, or contradicts what it states.
        InputError: if the provider that is named is missing or does not work.
    """

    def __init__(self, path: str | Path, threads: int | None = None, provider: ProviderName = "cpu") -> None:
        path = self._path = Path(path)
        options = ort.SessionOptions()
        options.log_severity_level = 4
        options.intra_op_num_threads = threads or usable_cores()
        options.inter_op_num_threads = 1
        self.parallel = options.intra_op_num_threads == 1
        self._sessions: dict[View, ort.InferenceSession] = {}
        self._heads: dict[ort.InferenceSession, Heads] = {}
        session = _open(path, options)
        metadata = _metadata(session, path)
        self._read_contract(session, metadata)
        self.precision = metadata.get(COMPUTE, "float32")
        if self.precision not in ("float32", "int8"):
            raise ModelFileError(
                f"The metadata of {path.name} say compute: {printable(self.precision[:60])}; expected int8, or no such entry for "
                "float32."
            )
        groups = list(self.contract.groups)
        files = graph_files(path, groups)
        for group, file in zip(groups, files, strict=True):
            if file != path:
                session = _open(file, options)
            _check_group(_metadata(session, file), metadata, group, file)
            if self.spec is not None:
                _check_shapes(session, self.spec, file)
            self._sessions.update(dict.fromkeys(group, session))
        self.fingerprint = fingerprint(*files)
        provider = resolve_provider(provider)
        if provider != "cpu":
            self._move_to_provider(provider, files, groups)

    def _read_contract(self, session: ort.InferenceSession, metadata: dict[str, str]) -> None:
        """Set contract and architecture, the outputs that a forward pass takes, and the graph's fixed batch."""
        declared = {value.name: value.shape for value in (*session.get_inputs(), *session.get_outputs())}
        self._fixed_batch = _check_batch(declared.get("images", ()), self._path.name)
        if "spec" in metadata:
            self.spec = ModelSpec.from_json(metadata["spec"])
            self.contract = self.spec.contract()
            self._pass_outputs = [*OUTPUTS, *(SAFA_OUTPUTS if self.spec.pooling == "safa" else ())]
            self._constants = [] if self.spec.pooling == "safa" else list(HEAD_OUTPUTS)
            return
        shapes = _known_shapes(session, declared, self._path.name)
        self.contract = from_metadata(metadata, self._path.name, shapes)
        fixed = {name for name in CONSTANT_OUTPUTS if name in shapes and (name != "cells" or len(shapes[name]) == 3)}
        self._constants = [name for name in CONSTANT_OUTPUTS if name in fixed]
        self._pass_outputs = ["parts", *(name for name in PASS_OUTPUTS if name in shapes and name not in fixed)]
        self.batch = self._fixed_batch or self.batch

    def _move_to_provider(self, provider: ProviderName, files: list[Path], groups: list[tuple[View, ...]]) -> None:
        """Replace the sessions by those of another provider; with "auto" the CPU stays where CUDA does not work."""
        wanted: ProviderName = "cuda" if provider == "auto" else provider
        # 8 bits are for the CPU: a GPU may round them otherwise.
        if provider == "auto" and (self.precision != "float32" or wanted not in providers.available()):
            return
        try:
            opened = [providers.open_on_provider(file, wanted, self.input_size) for file in files]
        except InputError as error:
            if provider != "auto":
                raise
            log.warning("%s computes on the CPU: %s", self._path.name, error)
            return
        for group, session in zip(groups, opened, strict=True):
            self._sessions.update(dict.fromkeys(group, session))
        self.device, self.parallel, self.batch = wanted, False, providers.GPU_BATCH

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Run one forward pass of images (B, 3, H, W) of the model's input size."""
        self._check_size(images, view)
        outputs = self._outputs(self._pass_outputs, images, view)
        if self.spec is not None:
            return self.spec.forward_pass(*outputs)
        parts = outputs[0].reshape(len(outputs[0]), self.n_parts, -1)
        return ForwardPass(parts, **dict(zip(self._pass_outputs[1:], outputs[1:], strict=True)))

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        self._check_size(images, view)
        parts = self._outputs(["parts"], images, view)[0]
        return parts.reshape(len(parts), self.n_parts, -1)

    def for_parallel_inference(self) -> Model:
        """Return the same model with one thread per forward pass; on a GPU, itself."""
        if self.parallel or self.device != "cpu":
            return self
        twin = Engine(self._path, threads=1)
        twin.means, twin.whitening = self.means, self.whitening
        twin.branches, twin.fingerprint = self.branches, self.fingerprint
        return twin

    def calibration_providers(self) -> list[tuple[str, dict[str, str]]]:
        """Return ONNX Runtime's providers with their options for other graphs of this model, as in a quantisation."""
        return providers.settings(self.device)

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the feature map, as the graph declares it if it does."""
        self.check_view(view)
        shapes = {output.name: output.shape for output in self._session(view).get_outputs()}
        height, width = (_fixed(side) for side in shapes.get("features", [1, 1])[-2:])
        return super().map_size(view) if height is None or width is None else (height, width)

    def heads(self, view: View) -> Heads:
        """Return the affine heads and cell weights, as far as the graph has them."""
        self.check_view(view)
        session = self._session(view)
        if session not in self._heads:
            blank = np.zeros((self._fixed_batch or 1, 3, *self.input_size), np.float32)
            constants = dict(zip(self._constants, self._compute(self._constants, blank, session), strict=True))
            self._heads[session] = Heads(*(constants.get(name) for name in CONSTANT_OUTPUTS))
        return self._heads[session]

    def _session(self, view: View) -> ort.InferenceSession:
        """Return the graph that describes a view; where branches have roles, that of its role in the task."""
        if self.contract.roles == "view":
            return self._sessions[view]
        # Outside of a task, each of the two views has the role of its own graph.
        return next(self._sessions[own] for own in self.views if self.contract.default_role(own) == self.role(view))

    def _outputs(self, names: list[str], images: Float32Array, view: View) -> list[Float32Array]:
        """Run the graph of a view, in batches of its fixed size if it has one; see `_compute`."""
        session, size, count = self._session(view), self._fixed_batch, len(images)
        if size is None or size == count:
            return self._compute(names, images, session)
        padded = np.concatenate([images, np.zeros((-count % size, *images.shape[1:]), np.float32)])
        chunks = [self._compute(names, padded[i : i + size], session) for i in range(0, len(padded), size)]
        return [np.concatenate(column)[:count] for column in zip(*chunks, strict=True)]

    def _compute(self, names: list[str], images: Float32Array, session: ort.InferenceSession) -> list[Float32Array]:
        """Run a graph; ModelFileError if it fails or its outputs contradict their declared shapes."""
        if not names:
            return []
        try:
            outputs = cast("list[Float32Array]", session.run(names, {"images": images}))
        except Exception as error:  # see `_open`
            if self.device != "cpu":
                reason = str(error).strip().partition("\n")[0][:300]
                raise InputError(
                    f"{self._path.name} cannot be computed on {self.device} ({reason}); {COMPUTE_ON_CPU}."
                ) from error
            raise ModelFileError(f"{self._path.name} cannot be computed, so it is damaged; {_AGAIN}.") from error
        declared = {output.name: output.shape for output in session.get_outputs()}
        if not all(_agrees(array.shape, declared[name]) for name, array in zip(names, outputs, strict=True)):
            raise ModelFileError(f"{self._path.name} yields other shapes than it says, so it is damaged; {_AGAIN}.")
        return outputs

    def _check_size(self, images: Float32Array, view: View) -> None:
        self.check_view(view)
        if images.shape[2:] != self.input_size:
            raise InputError(
                f"The images are {images.shape[2]} x {images.shape[3]}; this exported model takes "
                f"{self.input_size[0]} x {self.input_size[1]}, so resize them or export the model for that size."
            )


def check_opens(path: Path) -> None:
    """Check that ONNX Runtime can open a file, and that it has not lost its seal.

    Raises:
        ModelFileError: if the check fails.
    """
    open_session(path)


def open_session(path: Path) -> ort.InferenceSession:
    """Open any ONNX file for one thread on the CPU.

    Raises:
        ModelFileError: as for `check_opens`.
    """
    options = ort.SessionOptions()
    options.log_severity_level = 4
    options.intra_op_num_threads = 1
    return _open(path, options)


def _open(path: Path, options: ort.SessionOptions) -> ort.InferenceSession:
    if not path.is_file():
        raise ModelFileError(f"There is no model file at {path}; check the path.")
    check_contents(path, "onnx")
    try:
        check_self_contained(path, _AGAIN)
        sealed = check_seal(path, _AGAIN)
    except OSError as error:
        raise ModelFileError(f"{path} cannot be read ({error.strerror}); check that it is readable.") from error
    try:
        session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0)
        # Malformed texts raise only when they are read.
        _ = session.get_modelmeta().custom_metadata_map
        _ = [(value.name, value.shape) for value in (*session.get_inputs(), *session.get_outputs())]
    except Exception as error:  # ONNX Runtime's errors have no common base
        raise ModelFileError(f"{path.name} is not an ONNX model or is truncated; export the model again.") from error
    if SEAL in session.get_modelmeta().custom_metadata_map and not sealed:
        raise ModelFileError(f"{path.name} is damaged: its checksum is malformed; {_AGAIN}.")
    return session


def _metadata(session: ort.InferenceSession, path: Path) -> dict[str, str]:
    metadata = cast("dict[str, str]", session.get_modelmeta().custom_metadata_map)
    names = {output.name for output in session.get_outputs()}
    if is_newer(stated := metadata.get("format"), contract_metadata.FORMAT):
        raise ModelFileError(newer_version(path.name, str(stated), contract_metadata.FORMAT))
    if stated == contract_metadata.FORMAT:
        if [value.name for value in session.get_inputs()] != ["images"] or "parts" not in names:
            inputs = ", ".join(printable(value.name) for value in session.get_inputs())
            raise ModelFileError(
                f"{path.name} takes {inputs} and returns {', '.join(map(printable, sorted(names)))}; by its contract it takes "
                "images and returns parts."
            )
        return {name: value for name, value in metadata.items() if name != "spec"}
    ours = stated == FORMAT and {"spec", "source", "group"} <= set(metadata)
    if not ours or not {*OUTPUTS, *extra_outputs(ModelSpec.from_json(metadata["spec"]))} <= names:
        raise ModelFileError(
            f"{path.name} is an ONNX model, but not one written by `lpn export`, and has no contract in its metadata; export "
            "your LPN, name the pooling of the tokens that it returns with --pooling (lpn export writes it into a file), or see "
            "docs/contract.md."
        )
    return metadata


def _known_shapes(
    session: ort.InferenceSession, declared: dict[str, Sequence[Any]], name: str
) -> dict[str, Sequence[int]]:
    """Return the shapes of the input and of the outputs; those that the graph leaves open are measured on a blank picture."""
    height, width = (_fixed(side) for side in [*declared["images"], None, None][2:4])
    if len(declared["images"]) != 4 or height is None or width is None:
        raise ModelFileError(
            f"{name} takes images of {declared['images']}; expected (batch, 3, height, width) with a fixed height and width."
        )
    wrong = [value for value in (*session.get_inputs(), *session.get_outputs()) if value.type != "tensor(float)"]
    if wrong:
        raise ModelFileError(f"{name} has {printable(wrong[0].name)} of {wrong[0].type}; expected tensor(float).")
    blank = np.zeros((_fixed(declared["images"][0]) or 1, 3, height, width), np.float32)
    names = [name for name in declared if name != "images"]
    if all(_fixed(side) is not None for output in names for side in declared[output][1:]):
        shapes: dict[str, Sequence[int]] = {output: declared[output] for output in names}
    else:
        try:
            arrays = session.run(names, {"images": blank})
        except Exception as error:  # see `_open`
            raise ModelFileError(f"{name} cannot be computed, so it is damaged; {_AGAIN}.") from error
        shapes = {output: array.shape for output, array in zip(names, arrays, strict=True)}
    if len(shapes["parts"]) not in (2, 3):
        raise ModelFileError(
            f"{name} returns parts of shape {shapes['parts']}; expected (B, n, D), or (B, D) for one part."
        )
    return {**shapes, "images": blank.shape}


def _check_batch(shape: Sequence[Any], name: str) -> int | None:
    """Return the number of pictures in a batch, None if it is free; refuse a batch that would take all memory."""
    batch, _, height, width = (_fixed(side) or 1 for side in [*shape, None, None, None, None][:4])
    if max(height, width) > MAX_SIDE or batch * height * width > _MAX_PIXELS:
        raise ModelFileError(
            f"{name} takes images of {printable(' x '.join(map(str, shape)))}; expected at most {MAX_SIDE} pixels on a side, and "
            f"{_MAX_PIXELS} in a batch."
        )
    return _fixed(shape[0]) if shape else None


def _fixed(side: Any) -> int | None:
    """Return a side of a declared shape; None if the graph leaves it open."""
    return side if isinstance(side, int) and side > 0 else None


def _check_shapes(session: ort.InferenceSession, spec: ModelSpec, path: Path) -> None:
    """Refuse a graph whose inputs and outputs contradict the architecture in its metadata."""
    features = next(output.shape for output in session.get_outputs() if output.name == "features")
    feature_shape = [None, *features[1:]]
    if len(feature_shape) != 4 or not all(isinstance(side, int) and side > 0 for side in feature_shape[1:]):
        raise ModelFileError(f"{path.name} has a feature map of the invalid shape {features}; {_AGAIN}.")
    channels, *cells = feature_shape[1:]
    n, size = spec.n_parts, spec.embedding
    expected: dict[str, list[Any]] = {
        "images": [None, 3, *spec.input_size],
        "parts": [None, n, size],
        "features": feature_shape,
        "head_weight": [n, size, channels],
        "head_bias": [n, size],
        "cells": [n, *cells],
        "attention": [None, n, spec.maps, *cells],
    }
    for value in (*session.get_inputs(), *session.get_outputs()):
        wanted = expected.get(value.name)
        if wanted is None or value.type != "tensor(float)" or not _agrees(value.shape, wanted):
            raise ModelFileError(
                f"{path.name} has {value.name} of {value.type} {value.shape}, which is not {spec.describe()} as its metadata "
                f"say; {_AGAIN}."
            )


def _agrees(actual: Sequence[Any], expected: Sequence[Any]) -> bool:
    """Return whether two shapes agree; unknown sides are names or None."""
    known = [(a, b) for a, b in zip(actual, expected, strict=False) if isinstance(a, int) and isinstance(b, int)]
    return len(actual) == len(expected) and all(a == b for a, b in known)


def _check_group(metadata: dict[str, str], main: dict[str, str], group: tuple[View, ...], file: Path) -> None:
    if metadata.get("group", "+".join(group)) != "+".join(group):
        raise ModelFileError(
            f"{file.name} holds the part of a model for {metadata['group'].replace('+', ' and ')}; "
            f"open the file for {' and '.join(group)}, which was exported with it."
        )
    if any(metadata.get(key) != main.get(key) for key in {*metadata, *main} - {"group", SEAL}):
        raise ModelFileError(
            f"{file.name} was exported from another model than the file beside it; export the model again."
        )


def graph_files(path: Path, groups: list[tuple[View, ...]]) -> list[Path]:
    """Return the file of each group of views: `path`, then files beside it with the views before the suffix."""
    return [path, *(path.with_name(f"{path.stem}.{'+'.join(group)}{path.suffix}") for group in groups[1:])]
