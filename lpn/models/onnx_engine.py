"""A model on ONNX Runtime: an exported LPN, or any graph with a contract in its metadata.

A model is one graph for each group of views that share weights. Each graph also yields its heads as constant outputs, so
ONNX Runtime alone suffices for evidence.
"""

from __future__ import annotations

import copy
import logging
import re
from collections.abc import Mapping, Sequence
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
from lpn.models import providers
from lpn.models.base import Model
from lpn.models.contract import MAX_SIDE, ForwardPass, Heads, shown
from lpn.models.contract_metadata import FORMAT, SHIPPED, from_metadata, of_shipped
from lpn.models.file_contents import check_contents
from lpn.models.onnx_check import external_files

log = logging.getLogger(__name__)

# The metadata entry of a quantised file, see `lpn.models.quantize`.
COMPUTE = "compute"
# Prefix of the names of the nodes up to a model's map or tokens, the common source of parts and account.
TRUNK = "trunk/"
# Outputs of a graph beside `parts`: those of each picture, and those common to all.
_PASS_OUTPUTS = ("features", "cells", "constants", "slopes")
_CONSTANT_OUTPUTS = ("head_weight", "head_bias", "cells")
# Maximum of pixels of a batch of fixed size, far beyond any sensible network; see `MAX_SIDE`.
_MAX_PIXELS = 1 << 26
_AGAIN = "copy it again from its source, or export the model again"
# ONNX Runtime's messages about a file for a later version.
_NEWER = re.compile(r"Unsupported model IR version: \d+, max supported IR version: \d+|Opset \d+ is under development")


class Engine(Model):
    """A model that runs from `.onnx` files, without torch.

    Args:
        path: the file written by `lpn export`; files of further view groups lie beside it.
        threads: threads per forward pass on the CPU; default: all usable cores.
        provider: "auto" is LPN_PROVIDER if that is set, else CUDA for float32 models if it works, else the CPU.
            Another execution provider of ONNX Runtime is selected by its name.

    Raises:
        ModelFileError: if a file is missing or damaged, or states no contract or a wrong one.
        InputError: if the named provider is missing or does not work.
    """

    # Facts about the model that its file lacks, for its fingerprint.
    _pooled = ""

    def __init__(self, path: str | Path, threads: int | None = None, provider: ProviderName = "cpu") -> None:
        self._path = Path(path)
        threads = threads or usable_cores()
        self.parallel = threads == 1
        self._heads: dict[ort.InferenceSession, Heads] = {}
        session = open_session(self._path, threads)
        self._fixed_batch = _check_batch(_declared(session), self._path.name)
        self.batch = self._fixed_batch or self.batch
        self._files = [self._path]
        self._read(session, threads)
        files = [one for file in self._files for one in (file, *external_files(file, _AGAIN))]
        self.fingerprint = fingerprint(*files, also=self._pooled)
        if (provider := resolve_provider(provider)) != "cpu":
            self._move_to_provider(provider)

    def _read(self, session: ort.InferenceSession, threads: int) -> None:
        """Set contract, precision, outputs, and the graphs of all views from the first graph."""
        path, metadata = self._path, _metadata(session, self._path)
        shapes = _known_shapes(session, path.name)
        self.contract = from_metadata(metadata, path.name, shapes)
        fixed = {name for name in _CONSTANT_OUTPUTS if name in shapes and (name != "cells" or len(shapes[name]) == 3)}
        self._constants = [name for name in _CONSTANT_OUTPUTS if name in fixed]
        self._pass_outputs = ["parts", *(name for name in _PASS_OUTPUTS if name in shapes and name not in fixed)]
        self.precision = metadata.get(COMPUTE, "float32")
        if self.precision not in ("float32", "int8"):
            raise ModelFileError(
                f"The metadata of {path.name} say compute: {printable(self.precision[:60])}; expected int8, or no such entry for "
                "float32."
            )
        groups = list(self.contract.groups)
        self._files = graph_files(path, groups)
        opened = [session]
        for group, file in zip(groups, self._files, strict=True):
            if file != path:
                opened.append(open_session(file, threads))
            if lacking := [
                name for name in (*self._constants, *self._pass_outputs) if name not in _declared(opened[-1])
            ]:
                raise ModelFileError(
                    f"{file.name} lacks the output {lacking[0]} of the file beside it; export the model again."
                )
            _check_group(_metadata(opened[-1], file), metadata, group, file)
        self._use(opened)

    def _use(self, sessions: Sequence[ort.InferenceSession]) -> None:
        """Compute with one session for each group of views."""
        of_groups = zip(self.contract.groups, sessions, strict=True)
        self._sessions = {view: session for group, session in of_groups for view in group}

    def _move_to_provider(self, provider: ProviderName) -> None:
        """Replace the sessions by those of another provider; with "auto", the CPU stays if CUDA does not work."""
        wanted: ProviderName = "cuda" if provider == "auto" else provider
        # 8-bit models are for the CPU: a GPU may round differently.
        if provider == "auto" and (self.precision != "float32" or wanted not in providers.available()):
            return
        try:
            opened = [providers.open_on_provider(file, wanted, self.input_size) for file in self._files]
        except InputError as error:
            if provider != "auto":
                raise
            log.warning("%s computes on the CPU: %s", self._path.name, error)
            return
        self._use(opened)
        self.device, self.parallel, self.batch = wanted, False, providers.GPU_BATCH

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Run one forward pass of images (B, 3, H, W) of the model's input size."""
        parts, *further = self._outputs(self._pass_outputs, images, view)
        named = dict(zip(self._pass_outputs[1:], further, strict=True))
        return ForwardPass(parts.reshape(len(parts), self.n_parts, -1), **named)

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        (parts,) = self._outputs(["parts"], images, view)
        return parts.reshape(len(parts), self.n_parts, -1)

    def for_parallel_inference(self) -> Model:
        """Return this model with one thread per forward pass; on a GPU, return it unchanged."""
        if self.parallel or self.device != "cpu":
            return self
        twin = copy.copy(self)
        twin._use([open_session(file) for file in self._files])
        twin.parallel, twin._heads = True, {}
        return twin

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the feature map, from the graph's declaration if possible."""
        self.check_view(view)
        height, width = (_fixed(side) for side in _declared(self._session(view)).get("features", [1, 1])[-2:])
        return super().map_size(view) if height is None or width is None else (height, width)

    def heads(self, view: View) -> Heads:
        """Return the affine heads and cell weights that the graph has."""
        self.check_view(view)
        session = self._session(view)
        if session not in self._heads:
            blank = np.zeros((self._fixed_batch or 1, 3, *self.input_size), np.float32)
            constants = dict(zip(self._constants, self._compute(self._constants, blank, session), strict=True))
            self._heads[session] = Heads(*(constants.get(name) for name in _CONSTANT_OUTPUTS))
        return self._heads[session]

    def _session(self, view: View) -> ort.InferenceSession:
        """Return the graph of a view; if branches have roles, the graph of its role in the task."""
        if self.contract.roles == "view":
            return self._sessions[view]
        # Outside of a task, each of the two views has the role of its own graph.
        return next(self._sessions[own] for own in self.views if self.contract.default_role(own) == self.role(view))

    def _outputs(self, names: list[str], images: Float32Array, view: View) -> list[Float32Array]:
        """Run the graph of a view, in batches of its fixed size if it has one; see `_compute`."""
        self.check_view(view)
        self.check_size(images)
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
            outputs = cast("list[Float32Array]", session.run(names, {session.get_inputs()[0].name: images}))
        except Exception as error:  # see `open_session`
            if self.device != "cpu":
                reason = str(error).strip().partition("\n")[0][:300]
                raise InputError(
                    f"{self._path.name} cannot be computed on {self.device} ({reason}); {COMPUTE_ON_CPU}."
                ) from error
            raise ModelFileError(f"{self._path.name} cannot be computed, so it is damaged; {_AGAIN}.") from error
        declared = _declared(session)
        if not all(_agrees(array.shape, declared[name]) for name, array in zip(names, outputs, strict=True)):
            raise ModelFileError(f"{self._path.name} yields other shapes than it declares, so it is damaged; {_AGAIN}.")
        return outputs


def open_session(path: Path, threads: int = 1) -> ort.InferenceSession:
    """Open any ONNX file on the CPU for some threads.

    Raises:
        ModelFileError: if it is missing, damaged, no ONNX file, or too new for the installed ONNX Runtime.
    """
    options = ort.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4
    check_contents(path, "onnx")
    try:
        external_files(path, _AGAIN)
        sealed = check_seal(path, _AGAIN)
    except OSError as error:
        raise ModelFileError(f"{path} cannot be read ({error.strerror}); check that it is readable.") from error
    try:
        session = ort.InferenceSession(str(path), options, providers=["CPUExecutionProvider"], enable_fallback=0)
        # Malformed texts raise errors only when they are read.
        _ = session.get_modelmeta().custom_metadata_map, _declared(session)
    except Exception as error:  # ONNX Runtime's errors have no common base
        if newer := _NEWER.search(str(error)):
            raise ModelFileError(
                f"{path.name} was written for a newer ONNX Runtime than the installed {ort.__version__} ({newer[0]}); upgrade "
                "onnxruntime, or export the model for an older one."
            ) from error
        raise ModelFileError(f"{path.name} is not an ONNX model or is truncated; export the model again.") from error
    if SEAL in session.get_modelmeta().custom_metadata_map and not sealed:
        raise ModelFileError(f"{path.name} is damaged: its checksum is malformed; {_AGAIN}.")
    return session


def _metadata(session: ort.InferenceSession, path: Path) -> dict[str, str]:
    metadata = cast("dict[str, str]", session.get_modelmeta().custom_metadata_map)
    if is_newer(stated := metadata.get("format"), FORMAT):
        raise ModelFileError(newer_version(path.name, str(stated), FORMAT))
    if stated == SHIPPED and "spec" in metadata:
        metadata = of_shipped(metadata)
    elif stated != FORMAT:
        raise ModelFileError(
            f"{path.name} is an ONNX model, but not one written by `lpn export`, and has no contract in its metadata; export "
            "your LPN, name the pooling of the tokens that it returns with --pooling, or see docs/contract.md."
        )
    inputs = [value.name for value in session.get_inputs()]
    outputs = sorted(value.name for value in session.get_outputs())
    if inputs != ["images"] or "parts" not in outputs:
        raise ModelFileError(
            f"{path.name} takes {', '.join(map(printable, inputs))} and returns {', '.join(map(printable, outputs))}; by its "
            "contract it takes images and returns parts."
        )
    return metadata


def _declared(session: ort.InferenceSession) -> dict[str, Sequence[Any]]:
    """Return the shapes of the input and of the outputs by name; open sides are names or None."""
    return {value.name: value.shape for value in (*session.get_inputs(), *session.get_outputs())}


def _known_shapes(session: ort.InferenceSession, name: str) -> dict[str, Sequence[int]]:
    """Return the shapes of the input and of the outputs; open sides are measured on a blank picture."""
    declared = _declared(session)
    height, width = (_fixed(side) for side in [*declared["images"], None, None][2:4])
    if len(declared["images"]) != 4 or height is None or width is None:
        raise ModelFileError(
            f"{name} takes images of {declared['images']}; expected (batch, 3, height, width) with a fixed height and width."
        )
    wrong = [value for value in (*session.get_inputs(), *session.get_outputs()) if value.type != "tensor(float)"]
    if wrong:
        raise ModelFileError(f"{name} has {printable(wrong[0].name)} of {wrong[0].type}; expected tensor(float).")
    count = _fixed(declared["images"][0]) or 1
    names = [name for name in declared if name != "images"]
    shapes: dict[str, Sequence[int]]
    if all(_fixed(side) is not None for output in names for side in declared[output][1:]):
        shapes = {output: [_fixed(declared[output][0]) or count, *declared[output][1:]] for output in names}
    else:
        try:
            arrays = session.run(names, {"images": np.zeros((count, 3, height, width), np.float32)})
        except Exception as error:  # see `open_session`
            raise ModelFileError(f"{name} cannot be computed, so it is damaged; {_AGAIN}.") from error
        shapes = {output: array.shape for output, array in zip(names, arrays, strict=True)}
    if len(shapes["parts"]) not in (2, 3):
        raise ModelFileError(
            f"{name} returns parts of shape {shapes['parts']}; expected (B, n, D), or (B, D) for one part."
        )
    if len(shapes["parts"]) == 2:
        shapes["parts"] = (shapes["parts"][0], 1, shapes["parts"][1])
    return {**shapes, "images": (count, 3, height, width)}


def _check_batch(declared: Mapping[str, Sequence[Any]], name: str) -> int | None:
    """Return the number of pictures in a batch, None if it is open; refuse a batch that would take all memory."""
    shape = next(iter(declared.values()), ())
    batch, _, height, width = (_fixed(side) or 1 for side in [*shape, None, None, None, None][:4])
    if max(height, width) > MAX_SIDE or batch * height * width > _MAX_PIXELS:
        raise ModelFileError(
            f"{name} takes images of {printable(shown(shape))}; expected at most {MAX_SIDE} pixels on a side, and "
            f"{_MAX_PIXELS} in a batch."
        )
    return _fixed(shape[0]) if shape else None


def _fixed(side: Any) -> int | None:
    return side if isinstance(side, int) and side > 0 else None


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
