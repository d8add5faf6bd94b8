"""Model files: published `.pth` state dicts (with or without `opts.yaml`) and our own `.safetensors`."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any, Literal, cast

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor

from lpn.core.arrays import Float32Array, Int8Array
from lpn.core.checksums import SEAL, UNSEALED, check_claimed_size, check_seal, with_seal
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import fingerprint, printable, write_atomic
from lpn.core.formats import is_newer, newer_version
from lpn.core.resources import COMPUTE_ON_CPU, ProviderName, resolve_provider
from lpn.core.views import BRANCH, View
from lpn.models import safa
from lpn.models.backbones import map_size
from lpn.models.base import Model
from lpn.models.contract import ForwardPass, Heads
from lpn.models.entries import Entries
from lpn.models.file_contents import check_contents, contents_of
from lpn.models.lpn import LPN
from lpn.models.options import read_options
from lpn.models.pickled_states import find_state, unpickle
from lpn.models.published_checkpoints import (
    UNUSED,
    StateDict,
    infer_backbone,
    infer_spec,
    name_unknown,
    with_named_branch,
)
from lpn.models.spec import SLOPES, ModelSpec, is_timm
from lpn.models.timm_networks import TimmMap, renamed

FORMAT = "lpn-explorer/1"
WeightType = Literal["float32", "float16", "int8"]
# The scales of 8-bit kernels have the kernels' name with this suffix.
_SCALE = ".scale"
_AGAIN = "copy it again from its source, or make it again"


class TorchModel(Model):
    """An LPN that runs in PyTorch, on the device of its network."""

    spec: ModelSpec

    def __init__(self, network: LPN, fingerprint: str = "") -> None:
        self.network = network.eval()
        self.spec = network.spec
        self.contract = network.spec.contract()
        self.fingerprint = fingerprint
        self._device = next(network.parameters()).device
        self.device = self._device.type
        self.batch = 64 if self.device == "cuda" else 8
        self._map_sizes: dict[View, tuple[int, int]] = {}

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Run one forward pass of images (B, 3, H, W)."""
        parts, features, attention = self._forward(images, view)
        outputs: dict[str, Tensor] = {"parts": parts, "features": features}
        if attention is not None:
            outputs["features"], outputs["cells"] = safa.by_part(features, attention)
        elif self.spec.activation != "none":
            outputs["slopes"] = torch.where(parts > 0, 1.0, SLOPES[self.spec.activation])
        return ForwardPass(**{name: tensor.cpu().numpy() for name, tensor in outputs.items()})

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        return cast(Float32Array, self._forward(images, view)[0].cpu().numpy())

    def _forward(self, images: Float32Array, view: View) -> tuple[Tensor, Tensor, Tensor | None]:
        with exact_inference():
            return self.network.embed(torch.tensor(images, device=self._device), view)

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the feature map of an image of the model's input size."""
        if view not in self._map_sizes:
            self._map_sizes[view] = map_size(self.network.branch(view).model, self.input_size)
        return self._map_sizes[view]

    def heads(self, view: View) -> Heads:
        """Return the affine heads and cell weights; SAFA has none."""
        self.check_view(view)
        if not self.network.heads:
            return Heads()
        with torch.inference_mode():
            pairs = [head.affine() for head in self.network.heads]
            weight, bias = (torch.stack([pair[i] for pair in pairs]).cpu().numpy() for i in (0, 1))
        return Heads(weight, bias, self.spec.partition(view).weights(*self.map_size(view)))


@contextmanager
def exact_inference() -> Iterator[None]:
    """Compute without gradients, on a GPU by cuDNN in full float32.

    By default cuDNN convolves in TF32, whose ten-bit mantissa changes descriptors by more than 1e-4. cuDNN's settings belong
    to the whole process, so they also apply to other threads meanwhile. Its algorithms are not timed: torch caches the fastest
    for each thread alone, and batches come from many threads.
    """
    with torch.inference_mode(), torch.backends.cudnn.flags(enabled=True, benchmark=False, allow_tf32=False):
        yield


def load_torch(path: str | Path, device: torch.device | str = "cpu") -> TorchModel:
    """Load a published `.pth` or our `.safetensors` into PyTorch, on a device.

    Only tensors are unpickled. An `opts.yaml` beside a `.pth` supplies options that the keys do not determine.

    Raises:
        ModelFileError: if the file is missing, is not a model, is truncated, or lacks keys.
    """
    path = Path(path)
    if not holds_safetensors(path):
        return from_state(read_state(path), read_options(path.with_name("opts.yaml")), path, device)
    return _model(*_read_safetensors(path), path, device)[0]


def from_state(state: StateDict, options: dict[str, Any], path: Path, device: torch.device | str = "cpu") -> TorchModel:
    """Return the LPN of a published state dict and its options, see `load_torch`."""
    state = with_named_branch(state, options, path.name)
    spec = infer_spec(state, options, path.name)
    model, entries = _model(spec, state, path, device)
    name_unknown(path.name, "LPN", entries.left_over(UNUSED))
    return model


def _model(spec: ModelSpec, state: StateDict, path: Path, device: torch.device | str) -> tuple[TorchModel, Entries]:
    """Return the model of a spec and a state dict, and the entries that it read."""
    if spec.n_parts == 1:
        state = {re.sub(r"^classifier0\.", "classifier.", key): value for key, value in state.items()}
    # Branches that share weights may be stored once.
    for view in spec.views:
        own, stored = BRANCH[view] + ".", BRANCH[spec.owner(view)] + "."
        if own != stored:
            state = state | {own + key.removeprefix(stored): of for key, of in state.items() if key.startswith(stored)}
    # On the meta device a file that claims a huge network takes no memory before its entries are checked.
    with torch.device("meta"):
        network = LPN(spec)
    entries = Entries(path.name, state)
    entries.fill(network, r"num_batches_tracked$|\.classifier\.")
    if is_timm(spec.backbone):  # its networks have buffers that no file holds
        filled, network = network.state_dict(), LPN(spec)
        network.load_state_dict(filled)
    return TorchModel(network.to(device), fingerprint(path, also=spec.to_json())), entries


def holds_safetensors(path: Path) -> bool:
    """Return whether a file has the contents of a `.safetensors`, not of a PyTorch file, whatever its ending.

    Raises:
        ModelFileError: if it is missing, or is another kind of file, which the message names.
    """
    held = contents_of(path)
    if held not in ("pytorch", "safetensors"):
        if held is None:
            check_seal(path, _AGAIN)
        check_contents(path, "safetensors" if path.suffix == ".safetensors" else "pytorch")
    return held == "safetensors"


def best_device() -> torch.device:
    """Return the GPU if there is one, else the CPU."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def device_of(provider: ProviderName, name: str) -> torch.device:
    """Return the device that computes a model of PyTorch.

    Args:
        name: of the model's file, for the message.

    Raises:
        InputError: if the provider is not PyTorch's, or torch finds no GPU.
    """
    provider = resolve_provider(provider)
    if provider not in ("auto", "cpu", "cuda"):
        raise InputError(
            f"PyTorch computes {name} on cpu or cuda only, not on {printable(provider)[:60]!r}; give one of the two with "
            "--provider or LPN_PROVIDER, or lpn export the model for another provider of ONNX Runtime."
        )
    if provider == "cuda" and not torch.cuda.is_available():
        raise InputError(
            f"torch {torch.__version__} finds no GPU; install its driver and a torch for CUDA, or {COMPUTE_ON_CPU}."
        )
    return best_device() if provider == "auto" else torch.device(provider)


def save(network: LPN, path: str | Path, extra: dict[str, str] | None = None, storage: WeightType = "float32") -> None:
    """Write a network and its description atomically as `.safetensors`.

    Weights that branches share are stored once.

    Args:
        extra: further metadata (recipe, figures).
        storage: of the weights in the file. float16 halves matrices and kernels; int8 quarters kernels, with a scale for each
            output channel, and halves matrices. Neither stores the class layers, which retrieval does not use.

    Raises:
        InputError: if a weight exceeds the range of float16.
    """
    spec = network.spec
    shared = tuple(f"{BRANCH[view]}." for view in spec.views if spec.owner(view) != view)
    tensors = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items() if not k.startswith(shared)}
    if storage != "float32":
        tensors = {
            k: v for key, value in tensors.items() if ".classifier." not in key for k, v in _narrow(key, value, storage)
        }
    metadata = {**(extra or {}), "format": FORMAT, "spec": spec.to_json(), SEAL: UNSEALED}
    write_atomic(Path(path), with_seal(_with_sorted_header(save_tensors(tensors, metadata))))


def _narrow(key: str, tensor: Tensor, storage: WeightType) -> list[tuple[str, Tensor]]:
    """Return the tensors, by name, that store a tensor of a network in fewer bits."""
    if tensor.ndim < 2:  # the statistics of BatchNorm are few and span more than the range of float16
        return [(key, tensor)]
    if storage == "int8" and tensor.ndim == 4 and bool(tensor.isfinite().all()):
        kernels, scale = (torch.from_numpy(array) for array in to_eight_bits(tensor.numpy()))
        return [(key, kernels), (key + _SCALE, scale)]
    if not bool((half := tensor.half()).isfinite().all()):
        raise InputError(f"The weights {key} are too large for {storage}; store them as float32.")
    return [(key, half)]


def to_eight_bits(kernels: Float32Array) -> tuple[Int8Array, Float32Array]:
    """Round kernels to 8 bits, each output channel by its own largest value.

    Args:
        kernels: (O, I, h, w).

    Returns:
        Integers from -127 to 127 (O, I, h, w), and scales (O, 1, 1, 1); their product is the kernels to within half a scale.
    """
    scale = np.maximum(np.abs(kernels).max(axis=(1, 2, 3), keepdims=True), 1e-30) / np.float32(127)
    return np.round(kernels / scale).astype(np.int8), scale.astype(np.float32)


def _with_sorted_header(data: bytes) -> bytes:
    """Return a `.safetensors` file with the keys of its header sorted, so that equal networks give equal files."""
    start = 8 + int.from_bytes(data[:8], "little")
    header = json.dumps(json.loads(data[8:start]), sort_keys=True, separators=(",", ":")).encode()
    header += b" " * (-len(header) % 8)  # tensors begin at a multiple of eight bytes
    return len(header).to_bytes(8, "little") + header + data[start:]


def backbone_in(path: Path) -> str:
    """Return the backbone in a file of backbone weights or of a whole model, one of `BACKBONES`.

    Raises:
        ModelFileError: if the file cannot be read or holds none of them.
    """
    return _backbone_of(_read_weights(path), path)


def _backbone_of(state: StateDict, path: Path) -> str:
    prefix = "model_1.model." if any(key.startswith("model_1.model.") for key in state) else ""
    return infer_backbone({key.removeprefix(prefix): value for key, value in state.items()}, path.name)[0]


def _read_weights(path: Path) -> StateDict:
    if path.suffix == ".onnx" and path.is_file():
        raise ModelFileError(
            f"{path.name} is an exported graph; give --init the .safetensors or .pth it was made from."
        )
    return read_state(path)


def load_backbone(network: LPN, path: str | Path) -> tuple[int, int, list[str]]:
    """Fill the branches' backbones from backbone weights or a whole model, as far as tensors fit.

    Returns:
        The number of filled tensors, the number of all tensors, and the stages (`conv1`, `layer1`, ...) that keep initial
        weights, at least in part.

    Raises:
        ModelFileError: if the file cannot be read, holds another backbone, or nothing in it fits.
    """
    path, own = Path(path), network.spec.backbone
    state, held = _read_weights(path), own
    if not is_timm(own):
        with suppress(ModelFileError):
            held = _backbone_of(state, path)
    elif not any(key.startswith("model_1.model.") for key in state):
        built = cast(TimmMap, network.branch(network.spec.views[0]).model).network
        state = {f"network.{key}": value for key, value in renamed(built, state).items()}
    # Some layers of another backbone would fit.
    if held != own:
        raise ModelFileError(
            f"{path.name} holds {held}; the network has {own}. Give weights of {own}, or train with --backbone {held}."
        )
    filled = total = 0
    missing: dict[str, None] = {}
    for view in network.spec.views:
        if network.spec.owner(view) != view:
            continue
        for name, tensor in network.branch(view).model.state_dict().items():
            candidates = (f"{BRANCH[view]}.model.{name}", f"model_1.model.{name}", name)
            source = next((state[c] for c in candidates if c in state), None)
            total += 1
            if source is not None and source.shape == tensor.shape:
                tensor.copy_(source)
                filled += 1
            elif not name.endswith("num_batches_tracked"):
                stage = name.removeprefix("network.")
                missing[".".join(stage.split(".")[: 2 if stage.startswith("features") else 1])] = None
    if not filled:
        raise ModelFileError(
            f"Nothing in {path.name} fits a {own} backbone; its first entries are {', '.join(list(state)[:3])}. Give weights of "
            f"the same backbone, with the names of {'timm' if is_timm(own) else 'torchvision'}."
        )
    return filled, total, list(missing)


def load_heads(network: LPN, path: str | Path) -> str:
    """Fill the heads, without class layers, from a whole model of equal parts.

    Returns:
        A sentence on whether they were filled, with the reason if not.

    Raises:
        ModelFileError: if the file cannot be read.
    """
    path, spec = Path(path), network.spec
    if not holds_safetensors(path) or "spec" not in _read_tensors(path)[1]:
        return f"{path.name} is no .safetensors of a whole LPN, so the heads of the parts start anew."
    held, state = _read_safetensors(path)
    names = ("n_parts", "layout", "weighting", "activation", "pooling", "embedding", "last_layer")
    differs = [name for name in names if getattr(held, name) != getattr(spec, name)]
    if differs:
        described = ", ".join(f"{name} {getattr(held, name)} instead of {getattr(spec, name)}" for name in differs)
        return f"{path.name} has other parts ({described}), so the heads of the parts start anew."
    for name, head in zip(network.head_names, network.heads, strict=True):
        for key, tensor in head.add_block.state_dict().items():
            tensor.copy_(state[f"{name}.add_block.{key}"])
    return f"{path.name} fills the heads of all {spec.n_parts} parts."


def check_opens(path: Path) -> None:
    """Check that a `.safetensors`, `.pth`, or `state.pt` is readable, and has its seal.

    Raises:
        ModelFileError: if the check fails.
    """
    if holds_safetensors(path):
        _read_tensors(path)
    else:
        unpickle(path)


def is_own(path: Path) -> bool:
    """Return whether a `.safetensors` file claims to be ours, without reading its tensors.

    A missing or broken file counts as ours; `load_torch` reports its fault.
    """
    try:
        with safe_open(str(path), framework="pt") as file:
            return str((file.metadata() or {}).get("format")).startswith(FORMAT.partition("/")[0])
    except (SafetensorError, OSError, ValueError):
        return True


def read_state(path: Path) -> StateDict:
    """Read the state dict of a PyTorch or `.safetensors` file without the prefix `module.`; only tensors are unpickled.

    In a checkpoint with other objects, the state dict may have a usual name, such as `state_dict` or `model`, or any name if
    it is the only dictionary of tensors. Numbers and texts among the tensors are dropped.

    Raises:
        ModelFileError: if the file is missing, truncated, or holds no named tensors.
    """
    items = _read_tensors(path)[0] if holds_safetensors(path) else find_state(unpickle(path), path)
    if not items:
        raise ModelFileError(f"{path.name} holds no tensors; expected a state_dict of named tensors.")
    for key, tensor in items.items():
        of_bytes = tensor.dtype in (torch.int8, torch.uint8) and tensor.ndim > 1 and key.endswith("weight")
        plain = tensor.device.type == "cpu" and tensor.layout == torch.strided and not tensor.is_quantized
        if not plain or of_bytes or tensor.is_complex():
            raise ModelFileError(
                f"In {path.name}, {printable(key)} is no plain tensor but quantised, sparse, complex, or without values; give "
                "the weights as they were trained."
            )
    # A tensor of stride 0 can claim any size.
    check_claimed_size(path, sum(tensor.numel() * tensor.element_size() for tensor in items.values()), _AGAIN)
    return {key.removeprefix("module."): value for key, value in items.items()}


def _read_tensors(path: Path) -> tuple[StateDict, dict[str, str]]:
    sealed_file = check_seal(path, _AGAIN)
    try:
        with safe_open(str(path), framework="pt") as file:
            state, metadata = {key: file.get_tensor(key) for key in file.keys()}, file.metadata() or {}  # noqa: SIM118
            state = _widened(state, path.name)
    except (SafetensorError, OSError, ValueError) as error:
        raise ModelFileError(f"{path.name} is damaged, truncated, or no .safetensors file; {_AGAIN}.") from error
    if SEAL in metadata and not sealed_file:
        raise ModelFileError(f"{path.name} is damaged: its checksum is malformed; {_AGAIN}.")
    if key := next((key for key, tensor in state.items() if tensor.is_complex()), ""):
        raise ModelFileError(f"In {path.name}, {printable(key)} is complex; give the weights as they were trained.")
    return state, metadata


def _widened(state: StateDict, name: str) -> StateDict:
    """Return a file's tensors with kernels of 8 bits as float32, see `save`."""
    # A network may have its own parameters named scale.
    widened = {key: tensor for key, tensor in state.items() if not key.endswith(f".weight{_SCALE}")}
    for key in state.keys() - widened.keys():
        kernels, scale = state.get(key.removesuffix(_SCALE)), state[key]
        if kernels is None or kernels.dtype != torch.int8 or scale.shape != (len(kernels), 1, 1, 1):
            raise ModelFileError(f"In {name}, {key} scales no kernels of 8 bits; {_AGAIN}.")
        widened[key.removesuffix(_SCALE)] = kernels * scale
    return widened


def _read_safetensors(path: Path) -> tuple[ModelSpec, StateDict]:
    state, metadata = _read_tensors(path)
    if is_newer(stated := metadata.get("format"), FORMAT):
        raise ModelFileError(newer_version(path.name, str(stated), FORMAT))
    if stated != FORMAT:
        raise ModelFileError(
            f"{path.name} holds tensors but is not an LPN of ours (format {stated!r}, expected {FORMAT!r}); "
            "weights of a backbone alone go to lpn train --init."
        )
    return ModelSpec.from_json(metadata.get("spec", "")), state
