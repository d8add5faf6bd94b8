"""The baselines of SUES-200: a network of timm for each view under one linear head."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from lpn.core.errors import ModelFileError
from lpn.models.adapters.named import named_vector
from lpn.models.adapters.network import Account, PartBranch
from lpn.models.adapters.published import PublishedParts, numbered, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.entries import Entries

# Networks of timm. Each has an entry, with its shape, that all later networks in this table lack.
NETWORKS: dict[str, tuple[str, tuple[int, ...]]] = {
    "seresnet50": ("layer3.5.se.fc1.weight", (64, 1024, 1, 1)),
    "resnest50d": ("layer3.5.conv2.conv.weight", (512, 128, 3, 3)),
    "resnet50": ("layer3.5.conv3.weight", (1024, 256, 1, 1)),
    "vgg16_bn": ("features.40.weight", (512, 512, 3, 3)),
    "densenet201": ("features.denseblock4.denselayer32.conv2.weight", (32, 128, 3, 3)),
    "efficientnet_b4": ("conv_head.weight", (1792, 448, 1, 1)),
    "efficientnetv2_s": ("conv_head.weight", (1280, 256, 1, 1)),
    "inception_v4": ("features.21.branch0.conv.weight", (256, 1536, 1, 1)),
    "vit_base_patch16_384": ("pos_embed", (1, 577, 768)),
}


class LopsidedSum(PartBranch):
    """The released test's sum: the head's vector of the picture is scaled to length 1, the mirror's is added unscaled.

    Both passes are computed here. The mirror's map is flipped back, so that both share the cells of the picture.

    Args:
        vector: gives one vector, with or without cells.
        heads: A (1, D, C) and c (1, D).
    """

    def __init__(self, vector: PartBranch, heads: tuple[Tensor, Tensor]) -> None:
        held = None if vector.held is None else "the length of the picture's own pass"
        super().__init__(vector.grid, heads, held)
        self.vector = vector

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the length of the first pass held."""
        count = images.shape[0]
        # Both passes are one batch, so that the graph has one trunk, as `lpn.models.quantize` needs.
        both = self.vector.account(torch.cat([images, images.flip(3)]))
        vectors = self.headed(both.parts)
        scale = 1 / torch.linalg.vector_norm(vectors[:count], dim=2, keepdim=True)
        parts = vectors[:count] * scale + vectors[count:]
        if both.features is None or both.cells is None:
            return Account(parts)
        features = both.features[:count] * scale[..., None] + both.features[count:].flip(3)
        return Account(parts, features, both.cells[:count], cast(Tensor, self.bias) * (scale + 1))


def network_in(entries: Entries) -> str | None:
    """Return the first of `NETWORKS` whose entry has its shape; None without one."""
    shapes = {name: (entries.state.get(key), shape) for name, (key, shape) in NETWORKS.items()}
    return next((name for name, (one, shape) in shapes.items() if one is not None and one.shape == shape), None)


def build(entries: Entries) -> PublishedParts:
    """Build a baseline of SUES-200: `model_1` describes the satellite and `model_2` the drone."""
    own = entries.under("model_1.")
    name = network_in(own)
    if name is None or "classifier.add_block.0.weight" not in entries.state:
        raise ModelFileError(
            f"{entries.name} is an unsupported model of SUES-200, such as its LPN or CBAM (found "
            f"{next(map(own.file_name, own.state), 'nothing')}); expected one of {', '.join(NETWORKS)} with one head. Its "
            "descriptors open as plain arrays (lpn explore q.npy --gallery g.npy)."
        )
    size = size_of(entries, (384, 384))
    channels = entries.shape("classifier.add_block.0.weight", 2)[1]
    matrix, bias = entries.linear("classifier.add_block.0", channels)
    made = [LopsidedSum(named_vector(name, own, size)[0], (matrix[None], bias[None])) for own in numbered(entries)]
    # The branch adds the mirror itself.
    return published({"satellite": made[0], "drone": made[-1]}, "SUES-200", name, size, mirror="none")


ADAPTERS = (
    Adapter(
        "sues200",
        (r"model_1\.", r"model_2\.", r"classifier\d?\.add_block\.0\."),
        build,
        r"^classifier\d*\.classifier\.|^model_\d\.(model\.)?(fc|head|classifier|last_linear)\.",
    ),
)
