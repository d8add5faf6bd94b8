"""The Local Pattern Network (Wang et al., section III): feature extraction, part partition, a classifier head for each part.

Module names follow the published checkpoints: `model_1.model.*` satellite, `model_2.model.*` street, `model_3.model.*` drone,
`classifier{i}.*` (or `classifier.*` for the baseline, n = 1). SAFA has other parts and no heads, see `lpn.models.safa`.
"""

from __future__ import annotations

from functools import lru_cache
from typing import cast

import torch
from torch import Tensor, nn

from lpn.core.errors import InputError
from lpn.core.views import BRANCH, View
from lpn.models import safa
from lpn.models.backbones import backbone_of
from lpn.models.partition import Partition
from lpn.models.spec import SLOPES, ModelSpec


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
            branch = Branch(spec, view) if owner == view else self.get_submodule(BRANCH[owner])
            self.add_module(BRANCH[view], branch)
        channels = self.branch(spec.views[0]).model.channels
        self.head_names = ["classifier"] if spec.n_parts == 1 else [f"classifier{i}" for i in range(spec.n_parts)]
        if spec.pooling == "safa":
            self.head_names = []
            if spec.embedding != spec.maps * channels:
                raise InputError(
                    f"The model's embedding is {spec.embedding}; SAFA with {spec.maps} maps of {channels} channels has "
                    f"{spec.maps * channels}."
                )
        for name in self.head_names:
            self.add_module(name, PartHead(channels, spec))

    def branch(self, view: View) -> Branch:
        """Return the branch of `view`; InputError if the model lacks the view."""
        if view not in self.spec.views:
            raise InputError(f"This model has no {view!r} view; it has {', '.join(self.spec.views)}.")
        return cast(Branch, self.get_submodule(BRANCH[view]))

    @property
    def heads(self) -> list[PartHead]:
        """The head of each part, in the checkpoint's classifier order; SAFA has none."""
        return [cast(PartHead, self.get_submodule(name)) for name in self.head_names]

    def features(self, images: Tensor, view: View) -> Tensor:
        """Extract the last feature map, III-B: (B, 3, H, W) -> (B, C, h, w)."""
        return cast(Tensor, self.branch(view)(images))

    def pool(self, features: Tensor, view: View) -> Tensor:
        """Average the cells of each part, III-C: (B, C, h, w) -> (B, n, C)."""
        height, width = features.shape[2:]
        cells = _pooling_weights(self.spec.partition(view), height, width, features.dtype, features.device)
        return torch.matmul(cells, features.flatten(2).transpose(1, 2))

    def embed(self, images: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor | None]:
        """Return part embeddings (B, n, D), the feature map (B, C, h, w), and SAFA's `attention` or None."""
        features = self.features(images, view)
        if self.spec.pooling == "safa":
            attention = safa.attention(features, self.spec.partition(view), self.branch(view).aware)
            return safa.weigh(features, attention), features, attention
        pooled = self.pool(features, view)
        return torch.stack([head.add_block(pooled[:, i]) for i, head in enumerate(self.heads)], 1), features, None

    def forward(self, images: Tensor, view: View) -> tuple[Tensor, Tensor]:
        """Return part embeddings (B, n, D) and class scores, III-D: (B, n, classes); SAFA has no classes."""
        embeddings = self.embed(images, view)[0]
        if not self.heads:
            return embeddings, embeddings[..., :0]
        scores = torch.stack([head.classifier(embeddings[:, i]) for i, head in enumerate(self.heads)], 1)
        return embeddings, scores


class Branch(nn.Module):
    """One view's backbone, named `model` as in the published checkpoints, and the spatial-aware layers of SAFA."""

    def __init__(self, spec: ModelSpec, view: View) -> None:
        super().__init__()
        self.model = backbone_of(spec)
        if spec.pooling == "safa":
            self.aware = safa.spatial_aware_layers(spec, spec.partition(view), self.model)

    def forward(self, images: Tensor) -> Tensor:
        return cast(Tensor, self.model(images))


class PartHead(nn.Module):
    """Linear, BatchNorm, optional ReLU or LeakyReLU(0.1), Dropout, then the class layer used in training only."""

    def __init__(self, channels: int, spec: ModelSpec) -> None:
        super().__init__()
        linear, norm, class_layer = (
            nn.Linear(channels, spec.embedding),
            nn.BatchNorm1d(spec.embedding),
            nn.Linear(spec.embedding, spec.classes),
        )
        nn.init.kaiming_normal_(linear.weight, mode="fan_out")
        nn.init.normal_(norm.weight, 1.0, 0.02)
        nn.init.normal_(class_layer.weight, 0.0, 0.001)
        for layer in (linear, class_layer):
            nn.init.zeros_(layer.bias)
        activation = [] if spec.activation == "none" else [nn.LeakyReLU(SLOPES[spec.activation])]
        self.add_block = nn.Sequential(linear, norm, *activation, nn.Dropout(spec.dropout))
        self.classifier = nn.Sequential(class_layer)

    def affine(self) -> tuple[Tensor, Tensor]:
        """Return the test-time head, without its activation, as one affine map: A (D, C) and c (D,)."""
        linear, norm = cast(nn.Linear, self.add_block[0]), cast(nn.BatchNorm1d, self.add_block[1])
        scale = norm.weight / torch.sqrt(cast(Tensor, norm.running_var) + norm.eps)
        return scale[:, None] * linear.weight, scale * (linear.bias - cast(Tensor, norm.running_mean)) + norm.bias


@lru_cache(maxsize=32)
def _pooling_weights(partition: Partition, height: int, width: int, dtype: torch.dtype, device: torch.device) -> Tensor:
    """Return the weight of each cell in each part, (n, h w), for training and inference alike."""
    with torch.inference_mode(False):
        return torch.from_numpy(partition.weights(height, width)).to(device, dtype).flatten(1)
