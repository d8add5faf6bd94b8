"""The Local Pattern Network (Wang et al., section III): backbone, partition, one classifier head per part.

Module names follow the published checkpoints: `model_1.model.*` satellite, `model_2.model.*` street,
`model_3.model.*` drone, `classifier{i}.*` (or `classifier.*` for the baseline, n = 1). SAFA has no classifiers, but
spatial-aware layers in each branch, `model_1.aware.{i}.*`, one for each part.
"""

from __future__ import annotations

import copy
from typing import cast

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from lpn.core.errors import InputError
from lpn.core.views import BRANCH, View
from lpn.models.backbones import VGG16, BackboneName, LastLayer, ResNet, build_backbone
from lpn.models.partition import Partition
from lpn.models.spec import SLOPES, TIMM, ModelSpec
from lpn.models.timm_networks import TimmMap


class SpatialAware(nn.Module):
    """The spatial-aware layers of SAFA (Shi et al. 2019) for one part of P cells.

    Each of M weight maps is computed from the maximum over channels by two linear layers without an activation between
    them, P to P/2 to P.
    """

    def __init__(self, cells: int, maps: int) -> None:
        super().__init__()
        half = max(cells // 2, 1)
        self.weight1 = nn.Parameter(nn.init.trunc_normal_(torch.empty(maps, cells, half), std=0.005, a=-0.01, b=0.01))
        self.bias1 = nn.Parameter(torch.full((maps, 1, half), 0.1))
        self.weight2 = nn.Parameter(nn.init.trunc_normal_(torch.empty(maps, half, cells), std=0.005, a=-0.01, b=0.01))
        self.bias2 = nn.Parameter(torch.full((maps, 1, cells), 0.1))

    def forward(self, features: Tensor) -> Tensor:
        """Return the weight of each cell in each map: (B, C, h, w) -> (B, M, h w)."""
        strongest = features.amax(dim=1).flatten(1).unsqueeze(0)
        hidden = torch.matmul(strongest, self.weight1) + self.bias1
        return (torch.matmul(hidden, self.weight2) + self.bias2).transpose(0, 1)


class Branch(nn.Module):
    """One view's backbone, named `model` as in the published checkpoints, and the spatial-aware layers of SAFA."""

    def __init__(self, spec: ModelSpec, partition: Partition) -> None:
        super().__init__()
        self.model = _backbone(spec)
        if spec.pooling == "safa":
            height, width = map_size(self.model, spec.input_size)
            if width < spec.n_parts:
                raise InputError(
                    f"The feature map is {height} x {width} cells, too few for {spec.n_parts} strips; use wider pictures or "
                    "fewer parts."
                )
            begin, end = partition.strip(0, width)
            self.aware = nn.ModuleList([SpatialAware(height * (end - begin), spec.maps) for _ in range(spec.n_parts)])

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.model(images))


def _backbone(spec: ModelSpec) -> ResNet | VGG16 | TimmMap:
    if spec.backbone.startswith(TIMM):
        return TimmMap(spec.backbone.removeprefix(TIMM), spec.input_size)
    return build_backbone(
        cast(BackboneName, spec.backbone),
        cast(LastLayer, spec.last_layer),
        spec.last_stride,
        spec.backbone_dropout,
        # Released SAFA pools with TensorFlow's padding SAME: 112 x 616 pixels give 4 x 20 cells, not 3 x 19.
        ceil_mode=spec.pooling == "safa",
    )


def map_size(backbone: nn.Module, input_size: tuple[int, int]) -> tuple[int, int]:
    """Return (h, w) of the feature map for an input size, without computing it."""
    with torch.device("meta"):
        shadow = copy.deepcopy(backbone).to("meta").eval()
        return cast("tuple[int, int]", tuple(shadow(torch.zeros(1, 3, *input_size)).shape[2:]))


class PartHead(nn.Module):
    """Linear, BatchNorm, optional ReLU or LeakyReLU(0.1), Dropout, then the class layer used in training only."""

    def __init__(self, channels: int, spec: ModelSpec) -> None:
        super().__init__()
        linear, norm = nn.Linear(channels, spec.embedding), nn.BatchNorm1d(spec.embedding)
        nn.init.kaiming_normal_(linear.weight, mode="fan_out")
        nn.init.zeros_(linear.bias)
        nn.init.normal_(norm.weight, 1.0, 0.02)
        layers: list[nn.Module] = [linear, norm]
        if spec.activation != "none":
            layers.append(nn.LeakyReLU(SLOPES[spec.activation]) if spec.activation == "leaky_relu" else nn.ReLU())
        self.add_block = nn.Sequential(*layers, nn.Dropout(spec.dropout))
        class_layer = nn.Linear(spec.embedding, spec.classes)
        nn.init.normal_(class_layer.weight, 0.0, 0.001)
        nn.init.zeros_(class_layer.bias)
        self.classifier = nn.Sequential(class_layer)

    def affine(self) -> tuple[Tensor, Tensor]:
        """Return the test-time head, without its activation, as one affine map: A (D, C) and c (D,)."""
        linear, norm = cast(nn.Linear, self.add_block[0]), cast(nn.BatchNorm1d, self.add_block[1])
        mean, var = cast(Tensor, norm.running_mean), cast(Tensor, norm.running_var)
        scale = norm.weight / torch.sqrt(var + norm.eps)
        return scale[:, None] * linear.weight, scale * (linear.bias - mean) + norm.bias


class LPN(nn.Module):
    """An LPN with one branch per view of `spec`; branches that share weights are one module under two names.

    Raises:
        InputError: if the spec contradicts itself.
    """

    def __init__(self, spec: ModelSpec) -> None:
        super().__init__()
        self.spec = spec
        for view in spec.views:
            owner = spec.owner(view)
            branch = Branch(spec, spec.partition(view)) if owner == view else self.get_submodule(BRANCH[owner])
            self.add_module(BRANCH[view], branch)
        channels = self.branch(spec.views[0]).model.channels
        self.head_names: list[str] = []
        if spec.pooling == "safa":
            if spec.embedding != spec.maps * channels:
                raise InputError(
                    f"The model's embedding is {spec.embedding}; SAFA with {spec.maps} maps of {channels} channels has "
                    f"{spec.maps * channels}."
                )
            return
        self.head_names = ["classifier"] if spec.n_parts == 1 else [f"classifier{i}" for i in range(spec.n_parts)]
        for name in self.head_names:
            self.add_module(name, PartHead(channels, spec))

    def branch(self, view: View) -> Branch:
        """Return the branch of `view`.

        Raises:
            InputError: if the model lacks the view.
        """
        if view not in self.spec.views:
            raise InputError(f"This model has no {view!r} view; it has {', '.join(self.spec.views)}.")
        return cast(Branch, self.get_submodule(BRANCH[view]))

    @property
    def heads(self) -> list[PartHead]:
        """The head of each part, in the checkpoint's classifier order; SAFA has none."""
        return [cast(PartHead, self.get_submodule(name)) for name in self.head_names]

    def features(self, images: Tensor, view: View) -> Tensor:
        """Return the last feature map: (B, 3, H, W) -> (B, C, h, w)."""
        return cast(Tensor, self.branch(view)(images))

    def pool(self, features: Tensor, view: View) -> Tensor:
        """Pool each part of a feature map: (B, C, h, w) -> (B, n, C)."""
        weights = self.spec.partition(view).weights(features.shape[2], features.shape[3])
        cells = torch.from_numpy(weights).to(features).flatten(1)
        return torch.matmul(cells, features.flatten(2).transpose(1, 2))

    def attention(self, features: Tensor, view: View) -> Tensor:
        """Return SAFA's cell weights in each map of each part, 0 outside of the part: (B, C, h, w) -> (B, n, M, h, w).

        Raises:
            InputError: if the model has no spatial-aware layers.
        """
        if self.spec.pooling != "safa":
            raise InputError(
                "This model weighs the cells of every picture alike; only SAFA has weight maps of a picture."
            )
        partition, maps = self.spec.partition(view), []
        height, width = features.shape[2:]
        for part, layers in enumerate(self.branch(view).aware):
            begin, end = partition.strip(part, width)
            weights = layers(features[..., begin:end]).unflatten(2, (height, end - begin))
            maps.append(F.pad(weights, (begin, width - end)))
        return torch.stack(maps, 1)

    def forward(self, images: Tensor, view: View) -> tuple[Tensor, Tensor]:
        """Return part embeddings (B, n, D) and class scores (B, n, classes) of images (B, 3, H, W); SAFA has no classes."""
        embeddings = self.embed(images, view)[0]
        if not self.heads:
            return embeddings, embeddings[..., :0]
        scores = torch.stack([head.classifier(embeddings[:, i]) for i, head in enumerate(self.heads)], 1)
        return embeddings, scores

    def embed(self, images: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return part embeddings (B, n, D), the feature map (B, C, h, w), and SAFA's `attention` or None."""
        features = self.features(images, view)
        if self.spec.pooling == "safa":
            attention = self.attention(features, view)
            return weigh(features, attention), features, attention
        pooled = self.pool(features, view)
        return torch.stack([head.add_block(pooled[:, i]) for i, head in enumerate(self.heads)], 1), features, None


def weigh(features: Tensor, attention: Tensor) -> Tensor:
    """Return SAFA's part embeddings: features (B, C, h, w) and weights (B, n, M, h, w) give (B, n, M C), map by map."""
    cells = features.flatten(2).transpose(1, 2).unsqueeze(1)
    return torch.matmul(attention.flatten(3), cells).flatten(2)
