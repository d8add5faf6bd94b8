"""Model files: published `.pth` state dicts (with or without `opts.yaml`) and our own `.safetensors`."""

from __future__ import annotations

import logging
import pickle
import re
import warnings
from contextlib import nullcontext
from pathlib import Path
from typing import Any, cast

import torch
import yaml
from safetensors import SafetensorError, safe_open
from safetensors.torch import save as save_tensors
from torch import Tensor

from lpn.errors import ModelFileError
from lpn.files import fingerprint, printable, write_whole
from lpn.model import FloatArray, Heads, Model, Pass
from lpn.network import LPN, map_size
from lpn.spec import BRANCH, ModelSpec, View

log = logging.getLogger(__name__)

FORMAT = "lpn-explorer/1"
State = dict[str, Tensor]

_UNUSED = re.compile(r"model_\d\.model\.(fc|classifier|avgpool2?|maxpool2)\.")


class TorchModel(Model):
    """A model that runs in PyTorch, on the CPU or the GPU the network was put on."""

    def __init__(self, network: LPN, fingerprint: str = "") -> None:
        self.network = network.eval()
        self.spec = network.spec
        self.fingerprint = fingerprint

    def run(self, images: FloatArray, view: View) -> Pass:
        """One forward pass of pictures (B, 3, H, W)."""
        device = next(self.network.parameters()).device
        # Left to itself, cuDNN convolves in TF32, whose ten-bit mantissa moves descriptors by more than 1e-4.
        precise = torch.backends.cudnn.flags(allow_tf32=False) if device.type == "cuda" else nullcontext()
        with torch.inference_mode(), precise:
            found = self.network.embed(torch.tensor(images, device=device), view)
        parts, features, attention = (None if tensor is None else tensor.cpu().numpy() for tensor in found)
        return Pass(cast(FloatArray, parts), cast(FloatArray, features), attention)

    def map_size(self, view: View) -> tuple[int, int]:
        """(h, w) of the feature map of a picture of the model's input size."""
        return map_size(self.network.branch(view).model, self.input_size)

    def heads(self, view: View) -> Heads:
        """The affine heads and cell weights for exact explanation; InputError with SAFA, which has none."""
        self.check_view(view)
        self.check_heads()
        with torch.inference_mode():
            pairs = [head.affine() for head in self.network.heads]
            weight, bias = (torch.stack([pair[i] for pair in pairs]).cpu().numpy() for i in (0, 1))
        return Heads(weight, bias, self.spec.partition(view).weights(*self.map_size(view)))


def load_torch(path: str | Path, device: torch.device | str = "cpu") -> TorchModel:
    """Load a published `.pth` or our `.safetensors` into PyTorch, on a device.

    Only tensors are ever unpickled. An `opts.yaml` beside a `.pth` is read for what the keys do not tell.

    Raises:
        ModelFileError: when the file is missing, is not a model, is truncated, or lacks keys.
    """
    path = Path(path)
    if not path.is_file():
        raise ModelFileError(f"There is no model file at {path}; check the path.")
    if path.suffix == ".safetensors":
        spec, state = _read_safetensors(path)
    else:
        state = _read_pth(path)
        spec = infer_spec(state, _read_options(path.with_name("opts.yaml")), path.name)
    network = LPN(spec)
    _fill(network, state, path.name)
    return TorchModel(network.to(device), fingerprint(path, also=spec.to_json()))


def best_device() -> torch.device:
    """The GPU where there is one."""
    return torch.device("cuda" if torch.cuda.is_available() else "cpu")


def save(network: LPN, path: str | Path, extra: dict[str, str] | None = None) -> None:
    """Write a network as `.safetensors` with its description, beside the target first and then renamed.

    `extra` is stored as further metadata (recipe, figures). Weights shared between branches are stored once.
    """
    own = _own_keys(network)
    tensors = {k: v.detach().cpu().contiguous() for k, v in network.state_dict().items() if k in own}
    metadata = {**(extra or {}), "format": FORMAT, "spec": network.spec.to_json()}
    write_whole(Path(path), save_tensors(tensors, metadata))


def backbone_in(path: Path) -> str:
    """Which backbone a file of backbone weights or of a whole model holds: "resnet18", "resnet50", or "vgg16_bn".

    Raises:
        ModelFileError: when the file cannot be read or holds none of them.
    """
    state = _read_weights(path)
    prefix = "model_1.model." if any(key.startswith("model_1.model.") for key in state) else ""
    return _infer_backbone({key.removeprefix(prefix) for key in state}, path.name)[0]


def _read_weights(path: Path) -> State:
    if not path.is_file():
        raise ModelFileError(f"There is no file of weights at {path}; check the path given to --init.")
    if path.suffix == ".onnx":
        raise ModelFileError(
            f"{path.name} is an exported graph; give --init the .safetensors or .pth it was made from."
        )
    return _read_tensors(path)[0] if path.suffix == ".safetensors" else _read_pth(path)


def load_backbone(network: LPN, path: str | Path) -> tuple[int, int, list[str]]:
    """Fill the branches' backbones from a file of backbone weights or of a whole model, as far as it goes.

    Returns:
        How many of the backbone's tensors were filled, how many it has, and which stages (`conv1`, `layer1`, ...)
        stay as initialised, in part or in whole.

    Raises:
        ModelFileError: when the file cannot be read or nothing in it fits.
    """
    path = Path(path)
    state = _read_weights(path)
    filled = total = 0
    missing: dict[str, None] = {}
    for view in network.spec.views:
        if network.spec.owner(view) != view:
            continue
        target = network.branch(view).model.state_dict()
        for name, tensor in target.items():
            total += 1
            candidates = (f"{BRANCH[view]}.model.{name}", f"model_1.model.{name}", name)
            source = next((state[c] for c in candidates if c in state), None)
            if source is not None and source.shape == tensor.shape:
                tensor.copy_(source)
                filled += 1
            elif not name.endswith("num_batches_tracked"):
                missing[".".join(name.split(".")[: 2 if name.startswith("features") else 1])] = None
    if not filled:
        raise ModelFileError(
            f"Nothing in {path.name} fits a {network.spec.backbone} backbone; its first entries are "
            f"{', '.join(list(state)[:3])}. Give weights of the same backbone, with torchvision's names."
        )
    return filled, total, list(missing)


def infer_spec(state: State, options: dict[str, Any], name: str = "the file") -> ModelSpec:
    """Tell the architecture of a published state dict from its keys and, where given, its `opts.yaml`.

    Three branches are University-1652's. Two, model_1 and model_2, are satellite and street, cut as the released models
    for CVUSA and CVACT are ("cvusa"): the released code trains no other LPN of two views. The keys cannot tell whether
    somebody showed the second branch other pictures, so the log says how the file was read, unless `data_dir` or `name`
    in the options speak of these data sets. A file with model_1 and model_3 alone is read as satellite and drone, with
    University-1652's rings.

    Raises:
        ModelFileError: when it is not an LPN or baseline, or contradicts its options.
    """
    views = tuple(view for view, branch in BRANCH.items() if any(k.startswith(branch + ".model.") for k in state))
    heads = {m[1] for key in state if (m := re.match(r"classifier(\d*)\.", key))}
    if not views or not heads:
        found = ", ".join(list(state)[:3]) or "nothing"
        raise ModelFileError(
            f"{name} is not an LPN checkpoint: expected entries named model_1.model.* and classifier*.add_block.*, "
            f"found {found}."
        )
    n_parts = 1 if heads == {""} else 1 + max((int(head) for head in heads if head), default=0)
    expected = [""] if heads == {""} else [str(i) for i in range(n_parts)]
    lacking = [f"classifier{head}" for head in expected if head not in heads]
    if lacking or len(heads) != len(expected):
        found = ", ".join(f"classifier{head}" for head in sorted(heads))
        raise ModelFileError(
            f"{name} has the heads {found}; expected classifier0 to classifier{n_parts - 1} without a gap, or one named "
            "classifier, so the file is incomplete."
        )
    if options.get("pool") not in (None, "avg"):
        raise ModelFileError(
            f"{name} was trained with pool: {options['pool']} (opts.yaml); only average pooling (avg) is supported."
        )
    prefix = f"{BRANCH[views[0]]}.model."
    backbone, last_layer = _infer_backbone({k[len(prefix) :] for k in state if k.startswith(prefix)}, name)
    _check_options(options, name, views, n_parts, backbone)
    head = f"classifier{expected[0]}"
    linear = state.get(f"{head}.add_block.0.weight")
    if linear is None or linear.ndim != 2:
        shape = "is missing" if linear is None else f"has shape {tuple(linear.shape)}"
        raise ModelFileError(f"In {name}, {head}.add_block.0.weight {shape}; expected the (D, C) weights of a head.")
    size = (int(options.get("h", 256)), int(options.get("w", 256)))
    classes = state.get(f"{head}.classifier.0.weight")
    return ModelSpec(
        backbone=backbone,
        last_layer=last_layer,
        last_stride=int(options.get("stride", 1)),
        views=views,
        shared=_branches_equal(state, views),
        n_parts=n_parts,
        layout="cvusa" if views == ("satellite", "street") else "university",
        embedding=linear.shape[0],
        classes=1 if classes is None or classes.ndim != 2 else classes.shape[0],
        dropout=float(options.get("droprate", 0.5)),
        input_size=size,
    )


def _infer_backbone(keys: set[str], name: str) -> tuple[str, str]:
    if {
        "features.0.weight",
        "features.1.running_mean",
        "features.40.weight",
    } <= keys and "features.43.weight" not in keys:
        return "vgg16_bn", "layer4"
    last = "layer4" if any(k.startswith("layer4.") for k in keys) else "layer3"
    if "layer1.0.conv3.weight" in keys and "layer3.5.conv1.weight" in keys and "layer3.6.conv1.weight" not in keys:
        return "resnet50", last
    if "layer1.1.conv2.weight" in keys and not {"layer1.0.conv3.weight", "layer1.2.conv1.weight"} & keys:
        return "resnet18", last
    raise ModelFileError(
        f"The backbone in {name} is not one of resnet18, resnet50, vgg16_bn, or entries of it are missing."
    )


def _check_options(options: dict[str, Any], name: str, views: tuple[View, ...], n_parts: int, backbone: str) -> None:
    """Refuse options that belong to another model, and say how two branches are read when nothing confirms it."""
    told = [
        ("block", n_parts, f"{n_parts} heads"),
        ("views", len(views), f"the branches {', '.join(BRANCH[view] for view in views)}"),
        ("use_vgg16", backbone == "vgg16_bn", f"the backbone {backbone}"),
    ]
    for option, found, said in told:
        counts = option != "block" or options.get("LPN")
        if counts and option in options and options[option] != found:
            raise ModelFileError(
                f"{name} has {said}, but the opts.yaml beside it says {option}: {options[option]}; correct or remove it."
            )
    trained_on = f"{options.get('data_dir')} {options.get('name')}".lower()
    if views == ("satellite", "street") and not any(data in trained_on for data in ("cvusa", "cvact")):
        log.warning(
            "%s has the branches model_1 and model_2; they are read as satellite and street, as in the models released for "
            "CVUSA and CVACT. If model_2 saw drone pictures, rename its entries to model_3.",
            printable(name),
        )


def _branches_equal(state: State, views: tuple[View, ...]) -> bool:
    second = "drone" if "drone" in views else views[-1]
    if second == "satellite" or "satellite" not in views:
        return False
    first, other = BRANCH["satellite"] + ".", BRANCH[second] + "."
    keys = [k[len(first) :] for k in state if k.startswith(first) and not _UNUSED.match(k)]
    return all(other + k in state and torch.equal(state[first + k], state[other + k]) for k in keys)


def _own_keys(network: LPN) -> set[str]:
    """Keys of the state dict without the second name of shared branches."""
    spec = network.spec
    aliases = tuple(BRANCH[view] + "." for view in spec.views if spec.owner(view) != view)
    return {key for key in network.state_dict() if not key.startswith(aliases or ("\0",))}


def _fill(network: LPN, state: State, name: str) -> None:
    own = _own_keys(network)
    target = {k: v for k, v in network.state_dict().items() if k in own}
    if network.spec.n_parts == 1:
        state = {re.sub(r"^classifier0\.", "classifier.", k): v for k, v in state.items()}
    needed = [k for k in target if not k.endswith("num_batches_tracked") and ".classifier." not in k]
    missing = [k for k in needed if k not in state]
    if missing:
        raise ModelFileError(
            f"{name} lacks {len(missing)} of {len(needed)} entries, the first being {missing[0]}; "
            "the file is incomplete or of another architecture."
        )
    wrong = [k for k in target if k in state and state[k].shape != target[k].shape]
    if wrong:
        key = wrong[0]
        raise ModelFileError(
            f"In {name}, {key} has shape {tuple(state[key].shape)}; expected {tuple(target[key].shape)} for "
            f"{network.spec.describe()}."
        )
    for key, tensor in target.items():
        if key in state:
            tensor.copy_(state[key])
            # A sum is cheap, and finite unless an entry is not.
            if not bool(tensor.sum().isfinite()) and not bool(tensor.isfinite().all()):
                raise ModelFileError(f"In {name}, {key} holds values that are not finite; take an earlier checkpoint.")


def _read_pth(path: Path) -> State:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            loaded: Any = torch.load(path, map_location="cpu", weights_only=True)
    except pickle.UnpicklingError as error:
        raise ModelFileError(
            f"{path.name} is not a PyTorch file of tensors alone, so it was not opened further (it may run code); "
            "expected a saved state_dict()."
        ) from error
    except (RuntimeError, EOFError, OSError, ValueError, KeyError, IndexError, AttributeError, TypeError) as error:
        raise ModelFileError(
            f"{path.name} is not a PyTorch file or is truncated; expected a saved state_dict."
        ) from error
    if isinstance(loaded, dict) and isinstance(loaded.get("state_dict"), dict):
        loaded = loaded["state_dict"]
    if not isinstance(loaded, dict) or not loaded:
        raise ModelFileError(f"{path.name} holds a {type(loaded).__name__}; expected a state_dict of named tensors.")
    items: dict[Any, Any] = loaded
    if not all(isinstance(k, str) and isinstance(v, Tensor) for k, v in items.items()):
        raise ModelFileError(f"{path.name} holds other things than named tensors; expected a state_dict.")
    return {key.removeprefix("module."): value for key, value in cast(State, items).items()}


def _read_tensors(path: Path) -> tuple[State, dict[str, str]]:
    try:
        with safe_open(str(path), framework="pt") as file:
            return {key: file.get_tensor(key) for key in file.keys()}, file.metadata() or {}  # noqa: SIM118
    except (SafetensorError, OSError, ValueError) as error:
        raise ModelFileError(f"{path.name} is not a .safetensors file or is truncated ({error}).") from error


def _read_safetensors(path: Path) -> tuple[ModelSpec, State]:
    state, metadata = _read_tensors(path)
    if metadata.get("format") != FORMAT:
        raise ModelFileError(
            f"{path.name} holds tensors but is not an LPN of ours (format {metadata.get('format')!r}, expected {FORMAT!r}); "
            "weights of a backbone alone go to lpn train --init."
        )
    return ModelSpec.from_json(metadata.get("spec", "")), state


def _read_options(path: Path) -> dict[str, Any]:
    if not path.is_file():
        return {}
    try:
        options: Any = yaml.safe_load(path.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError, OSError) as error:
        raise ModelFileError("The opts.yaml beside the model cannot be read; correct or remove it.") from error
    if options is None:
        return {}
    if not isinstance(options, dict):
        raise ModelFileError("The opts.yaml beside the model is not a list of options; correct or remove it.")
    for key in ("h", "w", "stride", "block", "views"):
        value = options.get(key, 1)
        if not isinstance(value, int) or isinstance(value, bool) or value < 1:
            raise ModelFileError(
                f"The opts.yaml beside the model says {key}: {value}; expected a whole number, so correct it."
            )
    rate = options.get("droprate", 0.5)
    if not isinstance(rate, int | float) or isinstance(rate, bool) or not 0 <= rate < 1:
        raise ModelFileError(
            f"The opts.yaml beside the model says droprate: {rate}; expected a number from 0 up to 1, so correct it."
        )
    return cast("dict[str, Any]", options)
