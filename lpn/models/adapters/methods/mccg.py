"""MCCG: one or two gated parts of a map, and the whole map, each with a head."""

from __future__ import annotations

import logging
from typing import cast

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError
from lpn.core.files import printable
from lpn.models.adapters.network import NORM_HELD, Account, PartBranch, by_heads
from lpn.models.adapters.published import PublishedParts, by_view, check_option, equal, published, size_of
from lpn.models.adapters.registry import Adapter
from lpn.models.adapters.trunks import STRIDE, hand_made_trunk
from lpn.models.entries import Entries

log = logging.getLogger(__name__)


class Gate(nn.Module):
    """MCCG's gate: a convolution over a plane of maxima and a plane of means, normalised, through a sigmoid."""

    def __init__(self, entries: Entries) -> None:
        super().__init__()
        self.conv, self.bn = nn.Conv2d(2, 1, 7, padding=3, bias=False), nn.BatchNorm2d(1)
        entries.fill(self)

    def forward(self, strongest: Tensor, mean: Tensor) -> Tensor:
        """Return the gate of planes (B, rows, columns) each."""
        return torch.sigmoid(self.bn(self.conv(torch.stack([strongest, mean], 1))))[:, 0]


class Mccg(PartBranch):
    """The means of the map under one or two gates, and the LayerNorm of its plain mean, each with a head.

    On a ResNet-101 the plain mean has no LayerNorm. The first gate has a value for each channel and column, the second for each
    row and channel.

    Args:
        entries: of one branch, such as those under `model_1.`.
        blocks: the number of gated parts, 1 or 2.
    """

    def __init__(self, entries: Entries, size: tuple[int, int], blocks: int) -> None:
        trunk = hand_made_trunk(entries)
        names = [*(f"classifier_mcb{number + 1}" for number in range(blocks)), "classifier1"]
        grid = size[0] // STRIDE, size[1] // STRIDE
        held = "the gates" if trunk.norm is None else f"the gates and {NORM_HELD}"
        super().__init__(grid, entries.heads(names, trunk.channels), held)
        self.trunk, self.norm = trunk, trunk.norm
        gates = entries.under("tri_layer.")
        self.gates = nn.ModuleList([Gate(gates.under(f"{name}.conv.")) for name in ("cw", "hc")[:blocks]])

    def gated(self, features: Tensor) -> list[Tensor]:
        """Return the map under each gate, (B, C, h, w) each."""
        columns = self.gates[0](features.amax(2), features.mean(2))
        maps = [features * columns[:, :, None]]
        if len(self.gates) > 1:
            # The sides of the second gate's plane are rows and channels.
            rows = self.gates[1](features.amax(3).transpose(1, 2), features.mean(3).transpose(1, 2))
            maps.append(features * rows.transpose(1, 2)[..., None])
        return maps

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the gates and the norm's mean and variance held."""
        features = self.trunk(images)
        weight, whole = cast(Tensor, self.weight), features
        constants = cast(Tensor, self.bias).expand(features.shape[0], -1, -1).clone()
        if self.norm is not None:
            scale, offset = self.norm.affine(features.mean((2, 3)))
            whole = features * scale[:, :, None, None]
            constants[:, -1] += offset @ weight[-1].T
        maps = torch.stack([*self.gated(features), whole], 1)
        batch, parts, _, height, width = maps.shape
        cells = maps.new_full((batch, parts, height, width), 1.0 / (height * width))
        return Account(by_heads(maps.mean((3, 4)), weight, constants), maps, cells, constants)


def build(entries: Entries) -> PublishedParts:
    """Build MCCG on a ConvNeXt of any size, or on a ResNet-101."""
    size = size_of(entries, (256, 256), STRIDE)
    blocks = entries.under("model_1.").count_heads("classifier_mcb")
    check_option(entries, "block", blocks)
    if blocks not in (1, 2):
        raise ModelFileError(
            f"{entries.name} has {blocks} heads classifier_mcb; MCCG has one for each of its 1 or 2 gates."
        )
    only = "model_1."
    if entries.has("model_2.") and not equal(entries, "model_1.", "model_2."):
        log.warning(
            "%s has two networks of different weights. As in the released test, which loads the second over the first, model_2 "
            "describes all views.",
            printable(entries.name),
        )
        only = "model_2."
        entries.read.update(key for key in entries.state if key.startswith("model_1."))
    branch = Mccg(entries.under(only), size, blocks)
    names = [*("gate of columns", "gate of rows")[:blocks], "whole"]
    return published(by_view(entries, [branch]), "MCCG", branch.trunk.title, size, names)


MCCG = (r"model_1\.convnext\.", r"model_1\.tri_layer\.cw\.", r"model_1\.classifier_mcb1\.add_block\.")
UNUSED = r"\.classifier(1|_mcb\d)\.classifier\.|\.convnext\.(head|model\.fc)\."
ADAPTERS = (Adapter("mccg", MCCG, build, rf"{UNUSED}|\.tri_layer\.hc\."),)
