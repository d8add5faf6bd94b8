"""The architecture of a published state dict, inferred from the names of its entries and its `opts.yaml`."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import torch
from torch import Tensor

from lpn.core.errors import ModelFileError
from lpn.core.files import first_few, printable
from lpn.core.views import BRANCH, VIEWS, View
from lpn.models.options import invalid, picture_size
from lpn.models.spec import BACKBONES, ModelSpec, is_timm

log = logging.getLogger(__name__)

StateDict = dict[str, Tensor]

# Words in the options of models trained on panoramas.
_PANORAMAS = ("cvusa", "cvact")

# Entries of layers that the published code contains but does not use, and entries for training alone.
UNUSED = (
    r"^model_\d\.model\.(fc|classifier|avgpool2?|maxpool2)\.|^classifier\d*\.classifier\."
    r"|^model_\d\.model\.(network\.)?(head|_fc|_bn1|_conv_head)\.|^logit_scale$"
)


def infer_spec(state: StateDict, options: dict[str, Any], name: str = "the file") -> ModelSpec:
    """Infer the architecture of a published state dict from its keys and the options of its `opts.yaml`.

    Three branches are University-1652's. The two branches model_1 and model_3 are satellite and drone, with University-1652's
    rings; see also `with_named_branch`. The two branches model_1 and model_2 are
    - one network for all three views, with University-1652's rings, if they are equal;
    - else satellite and street with the layout "cvusa" of the released CVUSA and CVACT models, since the released code trains
      no other LPN of two views. Equal branches are read as satellite and street only if the options `data_dir` or `name`
      mention these data sets, `model_2` says street, or `share` is false.

    An interpretation of branches that no option confirms is logged, as is a default input size.

    The option `backbone` names a backbone of timm, such as "timm:convnext_tiny".

    Raises:
        ModelFileError: if it is not an LPN or baseline, or contradicts its options.
    """
    views = _held(state)
    heads = {m[1] for key in state if (m := re.match(r"classifier(\d*)\.", key))}
    if not views or not heads:
        listed = ", ".join(list(state)[:3]) or "nothing"
        raise ModelFileError(
            f"{name} is not an LPN checkpoint: expected entries named model_1.model.* and classifier*.add_block.*, "
            f"found {listed}."
        )
    n_parts = 1 if heads == {""} else 1 + max((int(head) for head in heads if head), default=0)
    expected = [""] if heads == {""} else [str(i) for i in range(n_parts)]
    lacking = [f"classifier{head}" for head in expected if head not in heads]
    if lacking or len(heads) != len(expected):
        listed = ", ".join(f"classifier{head}" for head in sorted(heads))
        raise ModelFileError(
            f"{name} has the heads {listed}; expected classifier0 to classifier{n_parts - 1} without a gap, or one named "
            "classifier, so the file is incomplete."
        )
    if options.get("pool") not in (None, "avg"):
        raise ModelFileError(
            f"{name} was trained with pool: {options['pool']} (opts.yaml); only average pooling (avg) is supported."
        )
    prefix = f"{BRANCH[views[0]]}.model."
    backbone = str(options.get("backbone"))
    last_layer: Literal["layer3", "layer4"] = "layer4"
    if not is_timm(backbone):
        backbone, last_layer = infer_backbone(
            {k[len(prefix) :]: value for k, value in state.items() if k.startswith(prefix)}, name
        )
    _check_options(options, name, views, n_parts, backbone)
    shared, panoramas = _branches_equal(state, views), False
    if views == ("satellite", "street"):
        stated = "model_2" in options or any(data in _trained_on(options) for data in _PANORAMAS)
        panoramas = not shared or stated or options.get("share") is False
        _tell_views(options, name, panoramas)
        views = views if panoramas else VIEWS
    head = f"classifier{expected[0]}"
    linear = state.get(f"{head}.add_block.0.weight")
    if linear is None or linear.ndim != 2:
        shape = "is missing" if linear is None else f"has shape {tuple(linear.shape)}"
        raise ModelFileError(f"In {name}, {head}.add_block.0.weight {shape}; expected the (D, C) weights of a head.")
    classes = state.get(f"{head}.classifier.0.weight")
    return ModelSpec(
        backbone=backbone,
        last_layer=last_layer,
        last_stride=int(options.get("stride", 1)),
        views=views,
        shared=shared,
        n_parts=n_parts,
        layout="cvusa" if panoramas else "university",
        embedding=linear.shape[0],
        classes=1 if classes is None or classes.ndim != 2 else classes.shape[0],
        dropout=float(options.get("droprate", 0.5)),
        input_size=picture_size(options, name, (256, 256), tell=True),
    )


def with_named_branch(state: StateDict, options: Mapping[str, Any], name: str) -> StateDict:
    """Return a state dict whose second branch is the drone's if the option `model_2` says so.

    Raises:
        ModelFileError: if the option is neither street nor drone, or the file also has a drone's branch.
    """
    stated = options.get("model_2", "street")
    if stated not in ("street", "drone"):
        raise invalid("model_2", stated, "street or drone, the pictures that this branch describes")
    if stated == "street":
        return state
    if "drone" in _held(state):
        raise ModelFileError(
            f"{name} has a branch model_3, which describes drone pictures, but the opts.yaml beside it says model_2: drone; "
            "correct or remove it."
        )
    return {re.sub(r"^model_2\.", "model_3.", key): value for key, value in state.items()}


def name_unknown(name: str, method: str, unknown: Sequence[str]) -> None:
    """Warn of unread entries that the method's released code lacks: a later method may have written the file."""
    if unknown:
        log.warning(
            "%s has entries that %s's released code does not have, %d in number (%s); they are not read, so if descriptors "
            "depend on them, the file is of another method.",
            printable(name),
            method,
            len(unknown),
            first_few([printable(key)[:80] for key in unknown], 3),
        )


def infer_backbone(state: Mapping[str, Tensor], name: str) -> tuple[str, Literal["layer3", "layer4"]]:
    """Infer `backbone` and `last_layer` of `ModelSpec` from the names of a backbone's entries.

    Raises:
        ModelFileError: if the backbone is unknown.
    """
    keys = state.keys()
    normalised = "features.1.running_mean" in keys
    if normalised and {"features.0.weight", "features.40.weight"} <= keys and "features.43.weight" not in keys:
        return "vgg16_bn", "layer4"
    # VGG-19 has no convolution at 17, and VGG-13 none at 28.
    if not normalised and {"features.0.weight", "features.17.weight", "features.28.weight"} <= keys:
        return "vgg16", "layer4"
    last: Literal["layer3", "layer4"] = "layer4" if any(k.startswith("layer4.") for k in keys) else "layer3"
    if "layer1.0.se.fc1.weight" in keys:
        raise ModelFileError(
            f"{name} has LPN's heads on a SE-ResNet (layer1.0.se.fc1.weight), which LPN's released code does not have; if it is "
            "one of timm, write `backbone: timm:seresnet50` into an opts.yaml beside the file."
        )
    if "layer1.0.conv3.weight" in keys and "layer3.5.conv1.weight" in keys and "layer3.6.conv1.weight" not in keys:
        return "resnet50", last
    if "layer1.1.conv2.weight" in keys and not {"layer1.0.conv3.weight", "layer1.2.conv1.weight"} & keys:
        return "resnet18", last
    raise ModelFileError(f"The backbone in {name} is not one of {', '.join(BACKBONES)}, or entries of it are missing.")


def _check_options(options: dict[str, Any], name: str, views: tuple[View, ...], n_parts: int, backbone: str) -> None:
    """Refuse options of another model."""
    facts = [
        ("block", n_parts, f"{n_parts} heads"),
        ("views", len(views), f"the branches {', '.join(BRANCH[view] for view in views)}"),
        ("use_vgg16", backbone == "vgg16_bn", f"the backbone {backbone}"),
    ]
    for option, value, source in facts:
        counts = option != "block" or options.get("LPN")
        if counts and option in options and options[option] != value:
            raise ModelFileError(
                f"{name} has {source}, but the opts.yaml beside it says {option}: {options[option]}; correct or remove it."
            )


def _tell_views(options: dict[str, Any], name: str, panoramas: bool) -> None:
    """Log the reading of the branches model_1 and model_2 unless the options confirm it."""
    if "model_2" in options or any(data in _trained_on(options) for data in (_PANORAMAS if panoramas else ("1652",))):
        return
    if panoramas:
        read = (
            "they are read as satellite and street, as in the models released for CVUSA and CVACT. If model_2 saw drone "
            "pictures, write model_2: drone into an opts.yaml beside the file"
        )
    else:
        read = (
            "they are equal, so they are read as one network for satellite, street, and drone, with University-1652's rings. "
            "If model_2 saw panoramas, write model_2: street into an opts.yaml beside the file"
        )
    log.warning("%s has the branches model_1 and model_2; %s.", printable(name), read)


def _trained_on(options: dict[str, Any]) -> str:
    return f"{options.get('data_dir')} {options.get('name')}".lower()


def _held(state: StateDict) -> tuple[View, ...]:
    """Return the views that have a separate branch."""
    return tuple(view for view, branch in BRANCH.items() if any(k.startswith(branch + ".model.") for k in state))


def _branches_equal(state: StateDict, views: tuple[View, ...]) -> bool:
    second = "drone" if "drone" in views else views[-1]
    if second == "satellite" or "satellite" not in views:
        return False
    first, other = BRANCH["satellite"] + ".", BRANCH[second] + "."
    keys = [k[len(first) :] for k in state if k.startswith(first) and not re.search(UNUSED, k)]
    return all(other + k in state and torch.equal(state[first + k], state[other + k]) for k in keys)
