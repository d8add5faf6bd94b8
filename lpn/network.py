"""The Local Pattern Network (Wang et al., section III): backbone, partition, one classifier head per part.

Module names follow the published checkpoints: `model_1.model.*` satellite, `model_2.model.*` street,
`model_3.model.*` drone, `classifier{i}.*` (or `classifier.*` for the baseline, n = 1).
"""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor, nn

from lpn.backbones import BackboneName, LastLayer, build_backbone
from lpn.errors import InputError
from lpn.spec import BRANCH, ModelSpec, View


class Branch(nn.Module):
    """One view's backbone under the name the published checkpoints give it, `model`."""

    def __init__(self, spec: ModelSpec) -> None:
        super().__init__()
        self.model = build_backbone(
            cast(BackboneName, spec.backbone), cast(LastLayer, spec.last_layer), spec.last_stride
        )

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.model(images))


class PartHead(nn.Module):
    """Linear, BatchNorm, optional LeakyReLU(0.1), Dropout, then the class layer used in training only."""

    def __init__(self, channels: int, spec: ModelSpec) -> None:
        super().__init__()
        linear, norm = nn.Linear(channels, spec.embedding), nn.BatchNorm1d(spec.embedding)
        nn.init.kaiming_normal_(linear.weight, mode="fan_out")
        nn.init.zeros_(linear.bias)
        nn.init.normal_(norm.weight, 1.0, 0.02)
        layers: list[nn.Module] = [linear, norm]
        if spec.activation == "leaky_relu":
            layers.append(nn.LeakyReLU(0.1))
        self.add_block = nn.Sequential(*layers, nn.Dropout(spec.dropout))
        class_layer = nn.Linear(spec.embedding, spec.classes)
        nn.init.normal_(class_layer.weight, 0.0, 0.001)
        nn.init.zeros_(class_layer.bias)
        self.classifier = nn.Sequential(class_layer)

    def affine(self) -> tuple[Tensor, Tensor]:
        """The test-time head before any activation as one affine map: A (D, C) and c (D,)."""
        linear, norm = cast(nn.Linear, self.add_block[0]), cast(nn.BatchNorm1d, self.add_block[1])
        mean, var = cast(Tensor, norm.running_mean), cast(Tensor, norm.running_var)
        scale = norm.weight / torch.sqrt(var + norm.eps)
        return scale[:, None] * linear.weight, scale * (linear.bias - mean) + norm.bias


class LPN(nn.Module):
    """An LPN with one branch per view of `spec`; branches that share weights are one module under two names."""

    def __init__(self, spec: ModelSpec) -> None:
        super().__init__()
        self.spec = spec
        for view in spec.views:
            owner = spec.owner(view)
            self.add_module(BRANCH[view], Branch(spec) if owner == view else self.get_submodule(BRANCH[owner]))
        channels = self.branch(spec.views[0]).model.channels
        self.head_names = ["classifier"] if spec.n_parts == 1 else [f"classifier{i}" for i in range(spec.n_parts)]
        for name in self.head_names:
            self.add_module(name, PartHead(channels, spec))

    def branch(self, view: View) -> Branch:
        """The branch that describes `view`.

        Raises:
            InputError: when the model has no such view.
        """
        if view not in self.spec.views:
            raise InputError(f"This model has no {view!r} view; it has {', '.join(self.spec.views)}.")
        return cast(Branch, self.get_submodule(BRANCH[view]))

    @property
    def heads(self) -> list[PartHead]:
        """The head of each part, in the checkpoint's classifier order."""
        return [cast(PartHead, self.get_submodule(name)) for name in self.head_names]

    def features(self, images: Tensor, view: View) -> Tensor:
        """The last feature map: (B, 3, H, W) -> (B, C, h, w)."""
        return cast(Tensor, self.branch(view)(images))

    def pool(self, features: Tensor, view: View) -> Tensor:
        """Pool each part of a feature map: (B, C, h, w) -> (B, n, C)."""
        weights = self.spec.partition(view).weights(features.shape[2], features.shape[3])
        cells = torch.from_numpy(weights).to(features).flatten(1)
        return torch.matmul(cells, features.flatten(2).transpose(1, 2))

    def forward(self, images: Tensor, view: View) -> tuple[Tensor, Tensor]:
        """Part embeddings (B, n, D), the raw head outputs, and class scores (B, n, classes)."""
        pooled = self.pool(self.features(images, view), view)
        embeddings = torch.stack([head.add_block(pooled[:, i]) for i, head in enumerate(self.heads)], 1)
        scores = torch.stack([head.classifier(embeddings[:, i]) for i, head in enumerate(self.heads)], 1)
        return embeddings, scores

    def embed(self, images: Tensor, view: View) -> tuple[Tensor, Tensor]:
        """Part embeddings (B, n, D) and the feature map (B, C, h, w) they were pooled from."""
        features = self.features(images, view)
        pooled = self.pool(features, view)
        return torch.stack([head.add_block(pooled[:, i]) for i, head in enumerate(self.heads)], 1), features
