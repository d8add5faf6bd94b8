"""SDPL: ten parts of shifted square rings, pooled by generalised means and summed over three shifts."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from lpn.core.arrays import Int64Array
from lpn.core.errors import ModelFileError
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import Account, PartBranch, by_heads, on_grid
from lpn.models.adapters.pooled import FixedWeights, MapCells, PooledTokens
from lpn.models.adapters.published import PublishedParts, by_role, check_option, numbered, published, size_of
from lpn.models.adapters.registry import LPN, Adapter
from lpn.models.backbones import Bottleneck, ResNet
from lpn.models.contract import part_names
from lpn.models.partition import Partition

SHIFTS = (-2, 0, 2)
PARTS = 10
PART_NAMES = (
    "1 centre",
    "2 ring",
    "3 ring",
    "4 outer",
    "5 rings 1 and 2",
    "6 rings 2 and 3",
    "7 rings 3 and 4",
    "8 rings 1 to 3",
    "9 rings 2 to 4",
    "10 outer again",
)
# Pixels along a side of one cell of the map.
STRIDE = 16
# The rings need eight cells along a side, and shifts by two cells need sixteen.
SIDE_STEP, SMALLEST = 128, 256
# Lower bound of values in the generalised mean of exponent 3.
_FLOOR = 1e-6
DEPTHS = [3, 4, 6, 3]
_HIDDEN = ("0", "4", "6", "8")


class ShiftedPlane(NamedTuple):
    """The places of one part at one shift, with the cells of the map that each of them sums.

    Attributes:
        outer, inner: by place, the cell's number row * S + column, or S * S for none; (places,).
    """

    outer: Int64Array
    inner: Int64Array


def planes(side: int) -> list[list[ShiftedPlane]]:
    """Return the ten planes of each shift for a map of `side` x `side` cells, cut as in the released code.

    Each shift sets the box of its third ring to zero. The released code does that to the map itself, so later shifts
    find it empty. Checkpoints were trained with this, and need it.
    """
    unit, centre, none = side // 8, side // 2, side * side
    cells = np.arange(none).reshape(side, side)

    def box(ring: int, shift: int) -> tuple[slice, slice]:
        span = slice(centre - ring * unit + shift, centre + ring * unit + shift)
        return span, span

    def hollow(square: Int64Array, hole: int) -> Int64Array:
        square, middle = square.copy(), len(square) // 2
        square[middle - hole : middle + hole, middle - hole : middle + hole] = none
        return square

    def add(ring: Int64Array, *filling: Int64Array) -> tuple[Int64Array, Int64Array]:
        """Add the contents of a ring's middle; if the ring is not empty there, a place has two cells."""
        outer, inner = ring.copy(), np.full_like(ring, none)
        for square in filling:
            begin = (len(ring) - len(square)) // 2
            span = slice(begin, begin + len(square))
            occupied = outer[span, span] != none
            inner[span, span] = np.where(occupied, square, inner[span, span])
            outer[span, span] = np.where(occupied, outer[span, span], square)
        return outer, inner

    by_shift: list[list[ShiftedPlane]] = []
    for shift in SHIFTS:
        p0 = cells[box(1, shift)]
        p1, p2 = hollow(cells[box(2, shift)], unit), hollow(cells[box(3, shift)], 2 * unit)
        cells = cells.copy()
        cells[box(3, shift)] = none
        p3 = cells
        pairs = [add(p0), add(p1), add(p2), add(p3)]
        pairs += [add(p1, p0), add(p2, p1), add(p3, p2), add(p2, p1, p0), add(p3, p2, p1), add(p3)]
        by_shift.append([ShiftedPlane(outer.reshape(-1), inner.reshape(-1)) for outer, inner in pairs])
    return by_shift


def build_branch(entries: Entries, heads: Entries, size: tuple[int, int]) -> tuple[PartBranch, tuple[str, ...]]:
    """Build a branch of SDPL, or of the two baselines of its code, and return it with the names of its parts.

    The baselines have no shifts: LPN's rings, divided by their own areas, or the whole map of a ResNet-50 whose last stage has
    stride 2.

    Args:
        entries: of the branch, such as those under `model_1.`.
        heads: the entries of the whole checkpoint.

    Raises:
        ModelFileError: if entries are missing or have wrong shapes, or the size does not fit SDPL.
    """
    if entries.has("shift_blocks."):
        if size[0] != size[1] or size[0] % SIDE_STEP or size[0] < SMALLEST:
            raise ModelFileError(
                f"The opts.yaml beside {entries.name} says {size[0]} x {size[1]} pixels; SDPL takes squares of a multiple of "
                f"{SIDE_STEP} pixels from {SMALLEST}."
            )
        return Sdpl(entries, heads, size), PART_NAMES
    rings = heads.count("classifier{}.add_block.0.weight")
    names = [f"classifier{ring}" for ring in range(rings)] if rings else ["classifier"]
    partition = Partition("rings", rings, "area") if rings else Partition("whole", 1)
    stride = 1 if rings else 2
    with torch.device("meta"):
        trunk = ResNet(Bottleneck, DEPTHS, "layer4", last_stride=stride)
    entries.under("model.").fill(trunk)
    step = STRIDE * stride
    # Convolutions of stride 2 round sides up.
    grid = -(-size[0] // step), -(-size[1] // step)
    weights = FixedWeights(torch.from_numpy(partition.weights(*grid)).flatten(1))
    branch = PooledTokens(MapCells(trunk, grid, trunk.channels), weights, heads.heads(names, trunk.channels))
    return branch, tuple(part_names(partition))


class Sdpl(PartBranch):
    """One branch of SDPL and the heads, which both branches share.

    Args:
        entries: of the branch, such as those under `model_1.`.
        heads: the entries of `classifier0` to `classifier9`.
    """

    def __init__(self, entries: Entries, heads: Entries, size: tuple[int, int]) -> None:
        side = size[0] // STRIDE
        super().__init__((side, side))
        with torch.device("meta"):
            self.trunk = ResNet(Bottleneck, DEPTHS, "layer4", last_stride=1)
            blocks = entries.under("shift_blocks.")
            first = nn.Conv2d(self.trunk.channels, blocks.shape("0.weight", 4)[0], 1)
            sizes = [blocks.shape(f"{name}.weight", 2) for name in _HIDDEN[1:]]
            self.shift_blocks = nn.ModuleDict({"0": first})
            for name, (to, source) in zip(_HIDDEN[1:], sizes, strict=True):
                self.shift_blocks[name] = nn.Linear(source, to)
        entries.under("model.").fill(self.trunk)
        blocks.fill(self.shift_blocks)
        matrix, bias = heads.heads([f"classifier{number}" for number in range(PARTS)], self.trunk.channels)
        self.matrix, self.bias = nn.Buffer(matrix), nn.Buffer(bias)
        self._places: dict[int, list[list[tuple[Tensor, Tensor]]]] = {}

    def check_size(self, size: tuple[int, int], trained: tuple[int, int]) -> None:
        """Check that a picture is a square of a size that fits the rings."""
        fits = size[0] == size[1] and size[0] % SIDE_STEP == 0 and size[0] >= SMALLEST
        self._check_size(size, trained, fits, f"squares of a multiple of {SIDE_STEP} pixels from {SMALLEST}")

    def shift_weights(self, features: Tensor) -> Tensor:
        """Return the weight of each shift: (B, C, S, S) -> (B, 3)."""
        hidden = torch.relu(self.shift_blocks["0"](features)).mean((2, 3))
        for name in _HIDDEN[1:]:
            hidden = self.shift_blocks[name](hidden)
        return torch.softmax(hidden, 1)

    def places(self, features: Tensor) -> list[list[tuple[Tensor, Tensor]]]:
        """Return `planes` of maps of this size as tensors on their device."""
        side = features.shape[2]
        if side not in self._places:
            self._places[side] = [
                [(torch.from_numpy(outer), torch.from_numpy(inner)) for outer, inner in parts] for parts in planes(side)
            ]
        places_of_side = self._places[side]
        return [
            [(outer.to(features.device), inner.to(features.device)) for outer, inner in parts]
            for parts in places_of_side
        ]

    def forward(self, images: Tensor) -> Tensor:
        """Return the raw parts of pictures: (B, 3, H, W) -> (B, 10, D)."""
        features = self.trunk(images)
        return by_heads(self.pool(features, self.shift_weights(features)), self.matrix, self.bias)

    def pool(self, features: Tensor, weights: Tensor) -> Tensor:
        """Pool each part of maps (B, C, S, S) with the weights of the shifts (B, 3): (B, 10, C)."""
        flat, places = nn.functional.pad(features.flatten(2), (0, 1)), self.places(features)
        parts = []
        for part in range(PARTS):
            pooled = [generalised_mean(flat[:, :, shift[part][0]] + flat[:, :, shift[part][1]]) for shift in places]
            parts.append((torch.stack(pooled, 2) * weights[:, None]).sum(2))
        return torch.stack(parts, 1)

    def account(self, images: Tensor) -> Account:
        """Return the parts and their account, with the pooled values and the weights of the shifts held.

        The features include the heads, as each part has a map of its own: (B, 10, D, S, S). The weight of a cell in a part is its
        share of the part's places, weighted over the shifts.
        """
        features = self.trunk(images)
        weights = self.shift_weights(features)
        parts = by_heads(self.pool(features, weights), self.matrix, self.bias)
        batch, count = features.shape[0], features.shape[2] * features.shape[3]
        flat, places = nn.functional.pad(features.flatten(2), (0, 1)), self.places(features)
        maps, cells, constants = [], [], []
        for part in range(PARTS):
            shares = torch.zeros_like(flat)
            rest = flat.new_zeros(batch, flat.shape[1])
            covered = flat.new_zeros(batch, count + 1)
            for shift, parts_of_shift in enumerate(places):
                both = [flat[:, :, cells] for cells in parts_of_shift[part]]
                values = both[0] + both[1]
                mean = generalised_mean(values)
                # By Euler's theorem the mean is the sum of these shares. A value at the lower bound comes from no cell.
                factor = weights[:, shift, None] / (values.shape[2] * mean * mean)
                square = torch.where(values > _FLOOR, values * values, 0.0) * factor[:, :, None]
                rest += factor * _FLOOR**3 * (values <= _FLOOR).sum(2)
                for term, where in zip(both, parts_of_shift[part], strict=True):
                    shares.index_add_(2, where, term * square)
                    weight = (weights[:, shift, None] / len(where)).expand(-1, len(where))
                    covered.index_add_(1, where, weight)
            weight = covered[:, :count]
            turned = torch.matmul(self.matrix[part], shares[:, :, :count])
            maps.append(turned / torch.where(weight > 0, weight, 1.0)[:, None])
            cells.append(weight)
            constants.append(rest @ self.matrix[part].T + self.bias[part])
        return Account(
            parts,
            on_grid(torch.stack(maps, 1), tuple(features.shape[2:])),
            on_grid(torch.stack(cells, 1), tuple(features.shape[2:])),
            torch.stack(constants, 1),
        )


def generalised_mean(values: Tensor) -> Tensor:
    """Return the cube root of the mean cube over the last axis, of values from 1e-6."""
    return values.clamp(min=_FLOOR).pow(3).mean(-1).pow(1 / 3)


def build(entries: Entries) -> PublishedParts:
    """Build SDPL, or one of the two baselines of its code."""
    check_option(entries, "views", 2)
    size = size_of(entries, (512, 512))
    shifted = entries.has("model_1.shift_blocks.")
    made = [build_branch(branch, entries, size) for branch in numbered(entries)]
    return published(
        by_role([branch for branch, _ in made]),
        "SDPL",
        "ResNet-50",
        size,
        level="exact, with held" if shifted else "exact",
        held="pooled values and shift weights" if shifted else "",
        parts=made[0][1],
    )


# SDPL and its baselines have one entry more than an LPN of two branches; for one baseline it is an option.
_UNUSED = r"^classifier\d*\.classifier\.|^model_\d\.(bn|model\.fc)\.|^model_\d\.gem\d+\.p$"
ADAPTERS = tuple(
    Adapter("sdpl", (*LPN.needs, more), build, _UNUSED)
    for more in (r"model_1\.shift_blocks\.", r"model_1\.gem\d+\.p$", "opts.yaml:dense_LPN$")
)
