"""The baselines of SUES-200, a network of timm for each view with one linear head, and its LPN with a head for each ring."""

from __future__ import annotations

import re
from typing import Any, cast

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.views import View
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.named import matching, named_vector
from lpn.models.adapters.network import Account, MeanVector, PartBranch, by_heads
from lpn.models.adapters.pooled import FixedWeights, MapCells, PooledTokens
from lpn.models.adapters.published import PAIR, PublishedParts, check_option, numbered, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.contract import Role, part_names
from lpn.models.partition import Partition
from lpn.models.timm_networks import TimmMap

# timm's networks of the option `model`, each with an entry, and its shape, that later ones lack.
_NETWORKS: dict[str, tuple[str, tuple[int, ...]]] = {
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


# The network of its LPN, the prefix of its entries, and the channels of its map.
_LPN_NETWORK, _LPN_ENTRIES, _LPN_CHANNELS = "seresnet50", "model.layer3.5.se.", 2048


class LopsidedSum(PartBranch):
    """The released test's sum: the head's vector of the picture is scaled to length 1, the mirror's is added unscaled.

    Both passes are computed here. The mirror's map is flipped back, so that both share the cells of the picture.

    Args:
        vector: gives one vector, with or without cells.
        head: A (1, D, C) and c (1, D).
    """

    def __init__(self, vector: PartBranch, head: tuple[Tensor, Tensor]) -> None:
        super().__init__(vector.grid, head[0])
        self.vector, self.bias = vector, nn.Buffer(head[1])

    def check_size(self, size: tuple[int, int], trained: tuple[int, int]) -> None:
        """Check the size of a picture for the network."""
        self.vector.check_size(size, trained)

    def account(self, images: Tensor) -> Account:
        """Return the vector and its account, with the length of the first pass held."""
        weight = cast(Tensor, self.weight)
        count = images.shape[0]
        # Both passes are one batch, so that the graph has one trunk, as `lpn.models.quantize` needs.
        both = self.vector.account(torch.cat([images, images.flip(3)]))
        vectors = by_heads(both.parts, weight, self.bias)
        scale = 1 / torch.linalg.vector_norm(vectors[:count], dim=2, keepdim=True)
        parts = vectors[:count] * scale + vectors[count:]
        if both.features is None or both.cells is None:
            return Account(parts)
        features = both.features[:count] * scale[..., None] + both.features[count:].flip(3)
        return Account(parts, features, both.cells[:count], self.bias * (scale + 1))


def build(entries: Entries) -> PublishedParts:
    """Build a baseline of SUES-200, or its LPN: `model_1` describes the satellite and `model_2` the drone.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or the network is none of timm's baselines.
        InputError: if timm is needed and cannot be imported.
    """
    own = entries.under("model_1.")
    if own.has(_LPN_ENTRIES) and any(re.match(r"classifier\d", key) for key in entries.state):
        return _lpn(entries)
    name = matching(_NETWORKS, own)
    if name is None or "classifier.add_block.0.weight" not in entries.state:
        entry = next((f"{own.prefix}{key}" for key in own.state), "nothing")
        raise ModelFileError(
            f"{entries.name} is a baseline of SUES-200 that is not read (its CBAM, or another; found {entry}); "
            f"expected one of {', '.join(_NETWORKS)} with one head. Its descriptors open as plain arrays (lpn explore "
            "q.npy --gallery g.npy)."
        )
    size = size_of(entries, (384, 384))
    channels = entries.shape("classifier.add_block.0.weight", 2)[1]
    matrix, bias = entries.linear("classifier.add_block.0", channels)

    made = [LopsidedSum(named_vector(name, own, size)[0], (matrix[None], bias[None])) for own in numbered(entries)]
    cells = isinstance(made[0].vector, MeanVector)
    return published(
        {"satellite": made[0], "drone": made[-1]},
        "SUES-200",
        name,
        size,
        level="exact, with held" if cells else "one vector",
        held="the length of the picture's own pass" if cells else "",
        # The branch adds the mirror itself.
        mirror="none",
    )


def _lpn(entries: Entries) -> PublishedParts:
    """Build SUES-200's LPN: square rings of a SE-ResNet-50's map, each under a linear head without a BatchNorm.

    Options, not entries, hold the last stage's `stride`, by default 1 as in the released code, and the `pool`.
    """
    count = entries.count("classifier{}.add_block.0.weight")
    check_option(entries, "block", count)
    channels = entries.shape("classifier0.add_block.0.weight", 2)[1]
    if entries.options.get("pool") not in (None, "avg") or channels != _LPN_CHANNELS:
        raise ModelFileError(
            f"{entries.name} is an LPN of SUES-200 that pools its rings by their maximum (pool: max or avg+max); only the "
            "average (avg) is read."
        )
    stride = int(entries.options.get("stride", 1))
    if stride not in (1, 2):
        raise ModelFileError(f"The opts.yaml beside {entries.name} says stride: {stride}; expected 1 or 2.")
    size = size_of(entries, (384, 384), 16 * stride)
    pairs = [entries.linear(f"classifier{number}.add_block.0", channels) for number in range(count)]
    heads = torch.stack([matrix for matrix, _ in pairs]), torch.stack([bias for _, bias in pairs])
    partition = Partition("rings", count) if count > 1 else Partition("whole", 1)
    grid = size[0] // (16 * stride), size[1] // (16 * stride)

    def branch(own: Entries) -> PartBranch:
        network = cast(Any, TimmMap(_LPN_NETWORK, size))
        if stride == 1:
            first = network.network.layer4[0]
            first.conv2.stride = first.downsample[0].stride = (1, 1)
        try:
            own.under("model.").fill(network.network)
        except ModelFileError as error:
            raise ModelFileError(f"As timm's {_LPN_NETWORK}: {error}") from error
        shares = torch.from_numpy(partition.weights(*grid)).flatten(1)
        return PooledTokens(MapCells(network, grid, channels), FixedWeights(shares), heads)

    made = [branch(own) for own in numbered(entries)]
    views = {"satellite": made[0], "drone": made[-1]}
    return published(
        cast("dict[View | Role, PartBranch]", views),
        "SUES-200, LPN",
        "SE-ResNet-50",
        size,
        level="exact",
        parts=part_names(partition),
        partitions=dict.fromkeys(PAIR, partition),
    )


ADAPTERS = (
    Adapter(
        "sues200",
        (r"model_1\.", r"model_2\.", r"classifier\d?\.add_block\.0\."),
        build,
        r"^classifier\d*\.classifier\.|^model_\d\.(model\.)?(fc|head|classifier|last_linear)\.",
    ),
)
