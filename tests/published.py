"""What the published LPN answers for a state dict, told step by step in plain torch; nothing of `lpn` is used here."""

from __future__ import annotations

import json
import math

import torch
import torch.nn.functional as F
from torch import Tensor

from tests import seeded

State = dict[str, Tensor]

VGG_CONVOLUTIONS = (0, 3, 7, 10, 14, 17, 20, 24, 27, 30, 34, 37, 40)
VGG_POOLINGS = (6, 13, 23, 33, 43)


def backbone_shapes(backbone: str) -> dict[str, list[int]]:
    """Names and shapes of torchvision's ResNet-50 or VGG-16-BN, class layers included."""
    if backbone == "resnet50":
        shapes = json.loads((seeded.DATA / "keys_n4.json").read_text())
        prefix = "model_1.model."
        return {name.removeprefix(prefix): shape for name, shape in shapes.items() if name.startswith(prefix)}
    shapes, channels = {}, 3
    for index in VGG_CONVOLUTIONS:
        width = min(64 * 2 ** sum(pooling < index for pooling in VGG_POOLINGS), 512)
        shapes |= {f"features.{index}.weight": [width, channels, 3, 3], f"features.{index}.bias": [width]}
        shapes |= _norm_shapes(f"features.{index + 1}", width)
        channels = width
    return shapes


def head_shapes(name: str, channels: int, classes: int = 7) -> dict[str, list[int]]:
    """Names and shapes of one part's head, class layer included."""
    return {
        f"{name}.add_block.0.weight": [512, channels],
        f"{name}.add_block.0.bias": [512],
        **_norm_shapes(f"{name}.add_block.1", 512),
        f"{name}.classifier.0.weight": [classes, 512],
        f"{name}.classifier.0.bias": [classes],
    }


def _norm_shapes(name: str, channels: int) -> dict[str, list[int]]:
    names = ("weight", "bias", "running_mean", "running_var")
    return {**{f"{name}.{entry}": [channels] for entry in names}, f"{name}.num_batches_tracked": []}


def feature_map(state: State, branch: str, images: Tensor, stride: int = 1) -> Tensor:
    """The last feature map of a branch, "model_1" and so on: (B, 3, H, W) -> (B, C, h, w)."""
    own = {k.removeprefix(f"{branch}.model."): v for k, v in state.items() if k.startswith(f"{branch}.model.")}
    return _resnet50(own, images, stride) if "conv1.weight" in own else _vgg16(own, images)


def _resnet50(state: State, x: Tensor, last_stride: int) -> Tensor:
    x = F.relu(_norm(state, "bn1", F.conv2d(x, state["conv1.weight"], stride=2, padding=3)))
    x = F.max_pool2d(x, 3, 2, 1)
    for layer, (depth, first_stride) in enumerate(((3, 1), (4, 2), (6, 2), (3, last_stride)), start=1):
        for block in range(depth):
            name, stride = f"layer{layer}.{block}", first_stride if block == 0 else 1
            y = F.relu(_norm(state, f"{name}.bn1", F.conv2d(x, state[f"{name}.conv1.weight"])))
            y = F.conv2d(y, state[f"{name}.conv2.weight"], stride=stride, padding=1)
            y = F.relu(_norm(state, f"{name}.bn2", y))
            y = _norm(state, f"{name}.bn3", F.conv2d(y, state[f"{name}.conv3.weight"]))
            if block == 0:
                x = F.conv2d(x, state[f"{name}.downsample.0.weight"], stride=stride)
                x = _norm(state, f"{name}.downsample.1", x)
            x = F.relu(x + y)
    return x


def _vgg16(state: State, x: Tensor) -> Tensor:
    for index in range(max(VGG_POOLINGS) + 1):
        if index in VGG_POOLINGS:
            x = F.max_pool2d(x, 2, 2)
        elif index in VGG_CONVOLUTIONS:
            x = F.conv2d(x, state[f"features.{index}.weight"], state[f"features.{index}.bias"], padding=1)
            x = F.relu(_norm(state, f"features.{index + 1}", x))
    return x


def _norm(state: State, name: str, x: Tensor) -> Tensor:
    mean, variance = state[f"{name}.running_mean"], state[f"{name}.running_var"]
    return F.batch_norm(x, mean, variance, state[f"{name}.weight"], state[f"{name}.bias"])


def rings(features: Tensor, n: int, align_corners: bool) -> list[Tensor]:
    """The n pooled rings from the centre outwards, (B, C) each: every cell goes to the smallest box it lies in, and a
    ring's sum is divided by the area of its whole box."""
    if min(features.shape[2:]) // (2 * n) < 1:
        features = F.interpolate(features, (2 * n, 2 * n), mode="bilinear", align_corners=align_corners)
    height, width = features.shape[2:]
    down, across = height // (2 * n), width // (2 * n)
    sums = [torch.zeros_like(features[:, :, 0, 0]) for _ in range(n)]
    for row in range(height):
        for column in range(width):
            ring = n
            for i in range(n - 1, 0, -1):
                inside = -i * down <= row - height // 2 < i * down
                if inside and -i * across <= column - width // 2 < i * across:
                    ring = i
            sums[ring - 1] += features[:, :, row, column]
    areas = [2 * i * down * 2 * i * across for i in range(1, n)] + [height * width]
    return [total / area for total, area in zip(sums, areas, strict=True)]


def rows(features: Tensor, n: int) -> list[Tensor]:
    """The means of n horizontal strips, top to bottom, (B, C) each; adjacent strips share a row where n does not fit."""
    height = features.shape[2]
    bounds = [(math.floor(i * height / n), math.ceil((i + 1) * height / n)) for i in range(n)]
    return [features[:, :, top:bottom].mean((2, 3)) for top, bottom in bounds]


def embeddings(state: State, view: str, features: Tensor) -> Tensor:
    """What the heads make of a view's feature map: (B, n, 512), in the order of the classifiers."""
    two_views = not any(key.startswith("model_3.") for key in state)
    names = sorted(
        {key.split(".")[0] for key in state if key.startswith("classifier")}, key=lambda name: (len(name), name)
    )
    n = len(names)
    if not two_views:
        pooled = rings(features, n, align_corners=True)
    elif view == "street":
        pooled = rows(features, n)
    else:
        pooled = rings(features, n, align_corners=False)[::-1]
    return torch.stack([head(state, name, part) for name, part in zip(names, pooled, strict=True)], 1)


def head(state: State, name: str, pooled: Tensor) -> Tensor:
    """What a part's head makes of the part: (B, C) -> (B, 512). Released heads have no activation."""
    linear = F.linear(pooled, state[f"{name}.add_block.0.weight"], state[f"{name}.add_block.0.bias"])
    return _norm(state, f"{name}.add_block.1", linear)


def descriptor(of_image: Tensor, of_mirror: Tensor) -> Tensor:
    """The descriptor (B, n, 512) from the head outputs of an image and of its mirror."""
    both = of_image + of_mirror
    return both / both.norm(dim=2, keepdim=True) / math.sqrt(both.shape[1])
