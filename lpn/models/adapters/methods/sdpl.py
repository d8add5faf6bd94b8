"""SDPL: ten parts of shifted square rings, pooled by generalised means and summed over three shifts."""

from __future__ import annotations

from functools import lru_cache, reduce

import numpy as np
import torch
from torch import Tensor, nn

from lpn.core.arrays import Int64Array
from lpn.core.errors import ModelFileError
from lpn.models.adapters.network import Account, PartBranch, by_heads, on_grid
from lpn.models.adapters.published import PublishedParts, by_role, check_option, numbered, published, size_of
from lpn.models.adapters.registry import LPN, Adapter
from lpn.models.backbones import Bottleneck, ResNet
from lpn.models.entries import Entries

SHIFTS = (-2, 0, 2)
# The parts by name, each with its first and its last of four rings. The last ring is the rest of the map.
_RINGS = (
    ("centre", 1, 1),
    ("ring", 2, 2),
    ("ring", 3, 3),
    ("outer", 4, 4),
    ("rings 1 and 2", 1, 2),
    ("rings 2 and 3", 2, 3),
    ("rings 3 and 4", 3, 4),
    ("rings 1 to 3", 1, 3),
    ("rings 2 to 4", 2, 4),
    ("outer again", 4, 4),
)
# Pixels along a side of one cell of the map.
_STRIDE = 16
# The rings need eight cells along a side, and shifts by two cells need sixteen.
_SIDE_STEP, _SMALLEST = 128, 256
# Lower bound of values in the generalised mean of exponent 3.
_FLOOR = 1e-6
_HIDDEN = ("4", "6", "8")


def planes(side: int) -> list[list[list[Int64Array]]]:
    """Return the places of the ten parts at each shift for a map of `side` x `side` cells, cut as in the released code.

    A part's places are one or two arrays (P,) of the map's cells, row * S + column, or S * S for none. Cells at
    equal positions of two arrays are added. Each shift sets the box of its third ring to zero. The released code does that in the
    map itself, so this box is also zero in later shifts. Checkpoints were trained with this, and need it.
    """
    unit, centre, none = side // 8, side // 2, side * side
    rest = np.arange(none).reshape(side, side)

    def box(ring: int, shift: int = 0) -> tuple[slice, slice]:
        span = slice(centre - ring * unit + shift, centre + ring * unit + shift)
        return span, span

    by_shift: list[list[list[Int64Array]]] = []
    for shift in SHIFTS:
        cells, rest = rest, rest.copy()
        rest[box(3, shift)] = none
        parts = []
        for _, first, last in _RINGS:
            inner = np.full_like(cells, none)
            inner[box(min(last, 3))] = cells[box(min(last, 3), shift)]
            inner[box(first - 1)] = none
            squares = [inner[box(last)]] if last < 4 else [rest] if first == 4 else [rest, inner]
            parts.append([square.reshape(-1) for square in squares])
        by_shift.append(parts)
    return by_shift


@lru_cache(maxsize=8)
def _places(side: int, device: torch.device) -> list[list[list[Tensor]]]:
    """Return the places of each part at each shift, by part, as tensors."""
    with torch.inference_mode(False):
        made = [[[torch.from_numpy(cells).to(device) for cells in part] for part in parts] for parts in planes(side)]
    return [list(of_part) for of_part in zip(*made, strict=True)]


class Sdpl(PartBranch):
    """One branch of SDPL and the heads, which both branches share.

    Args:
        entries: of the branch, such as those under `model_1.`.
        heads: A (10, D, C) and c (10, D).
    """

    def __init__(self, entries: Entries, heads: tuple[Tensor, Tensor], size: tuple[int, int]) -> None:
        super().__init__((size[0] // _STRIDE, size[0] // _STRIDE), held="pooled values and shift weights")
        blocks = entries.under("shift_blocks.")
        with torch.device("meta"):
            self.trunk = ResNet(Bottleneck, [3, 4, 6, 3], "layer4", last_stride=1)
            first = nn.Conv2d(self.trunk.channels, blocks.shape("0.weight", 4)[0], 1)
            self.shift_blocks = nn.ModuleDict({"0": first})
            for name in _HIDDEN:
                to, source = blocks.shape(f"{name}.weight", 2)
                self.shift_blocks[name] = nn.Linear(source, to)
        entries.under("model.").fill(self.trunk)
        blocks.fill(self.shift_blocks)
        self.matrix, self.offsets = (nn.Buffer(tensor) for tensor in heads)

    def shift_weights(self, features: Tensor) -> Tensor:
        """Return the weight of each shift: (B, C, S, S) -> (B, 3)."""
        hidden = torch.relu(self.shift_blocks["0"](features)).mean((2, 3))
        for name in _HIDDEN:
            hidden = self.shift_blocks[name](hidden)
        return torch.softmax(hidden, 1)

    def forward(self, images: Tensor) -> Tensor:
        """Return the raw parts of pictures: (B, 3, H, W) -> (B, 10, D)."""
        features = self.trunk(images)
        return by_heads(self.pool(features, self.shift_weights(features)), self.matrix, self.offsets)

    def pool(self, features: Tensor, weights: Tensor) -> Tensor:
        """Pool each part of maps (B, C, S, S) with the weights of the shifts (B, 3): (B, 10, C)."""
        flat = nn.functional.pad(features.flatten(2), (0, 1))
        parts = []
        for shifts in _places(self.grid[0], features.device):
            pooled = [_mean(_summed(flat, cells)) for cells in shifts]
            parts.append((torch.stack(pooled, 2) * weights[:, None]).sum(2))
        return torch.stack(parts, 1)

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the pooled values and the weights of the shifts held.

        The features include the heads, as each part has a map of its own: (B, 10, D, S, S). The weight of a cell in a part is its
        share of the part's places, weighted over the shifts.
        """
        features = self.trunk(images)
        weights, places = self.shift_weights(features), _places(self.grid[0], features.device)
        flat = nn.functional.pad(features.flatten(2), (0, 1))
        maps, cells, constants = [], [], []
        for matrix, offset, shifts in zip(self.matrix, self.offsets, places, strict=True):
            shares, rest, covered = torch.zeros_like(flat), torch.zeros_like(flat[..., 0]), torch.zeros_like(flat[:, 0])
            for shift, arrays in enumerate(shifts):
                values = _summed(flat, arrays)
                mean, own = _mean(values), weights[:, shift, None]
                # By Euler's theorem the mean is the sum of these shares. A value at the lower bound comes from no cell.
                factor = own / (values.shape[2] * mean * mean)
                square = torch.where(values > _FLOOR, values * values, 0.0) * factor[:, :, None]
                rest += factor * _FLOOR**3 * (values <= _FLOOR).sum(2)
                for where in arrays:
                    shares.index_add_(2, where, flat[:, :, where] * square)
                    covered.index_add_(1, where, (own / len(where)).expand(-1, len(where)))
            weight = covered[:, :-1]
            turned = torch.matmul(matrix, shares[..., :-1])
            maps.append(turned / torch.where(weight > 0, weight, 1.0)[:, None])
            cells.append(weight)
            constants.append(rest @ matrix.T + offset)
        return Account(
            by_heads(self.pool(features, weights), self.matrix, self.offsets),
            on_grid(torch.stack(maps, 1), self.grid),
            on_grid(torch.stack(cells, 1), self.grid),
            torch.stack(constants, 1),
        )


def _summed(flat: Tensor, arrays: list[Tensor]) -> Tensor:
    """Return the sums of the cells at each place: (B, C, S S + 1) -> (B, C, P)."""
    return reduce(torch.add, [flat[:, :, where] for where in arrays])


def _mean(values: Tensor) -> Tensor:
    """Return the cube root of the mean cube over the last axis; smaller values than 1e-6 count as 1e-6."""
    return values.clamp(min=_FLOOR).pow(3).mean(-1).pow(1 / 3)


def build(entries: Entries) -> PublishedParts:
    """Build SDPL: `model_1` describes queries, and `model_2` the gallery."""
    check_option(entries, "views", 2)
    size = size_of(entries, (512, 512))
    if size[0] != size[1] or size[0] % _SIDE_STEP or size[0] < _SMALLEST:
        raise ModelFileError(
            f"The opts.yaml beside {entries.name} says {size[0]} x {size[1]} pixels; SDPL takes squares with a side that "
            f"is a multiple of {_SIDE_STEP} pixels, {_SMALLEST} or more."
        )
    heads = entries.heads([f"classifier{number}" for number in range(len(_RINGS))], 2048)
    branches = by_role([Sdpl(branch, heads, size) for branch in numbered(entries)])
    return published(branches, "SDPL", "ResNet-50", size, [name for name, *_ in _RINGS], heads[1].shape[1])


# SDPL has one entry more than an LPN of two branches.
_UNUSED = r"^classifier\d*\.classifier\.|^model_\d\.(bn|model\.fc)\.|^model_\d\.gem\d+\.p$"
ADAPTERS = (Adapter("sdpl", (*LPN.needs, r"model_1\.shift_blocks\."), build, _UNUSED),)
