"""The contract of a part-based model: its description of itself, and the result of one forward pass.

For the passes p (the picture, and its mirror if the test adds it) and the part i, the raw embedding is

    e_i = sum_p s_pi * [ sum_x a_pi(x) A_i F_pi(x) + c_pi ]

over the cells x of a map. F_p is one map for all parts or one for each part. A_i is a static head, or the identity. a_pi are
the weights of the cells, c_pi is a constant, and s_pi are the slopes of an activation after the head, 1 without one. Other
quantities that differ between pictures are held at their value for this picture; `Contract.held` names them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple, get_args

import numpy as np

from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import printable
from lpn.core.images import MEAN, STD, Triple
from lpn.core.views import VIEWS, View
from lpn.models.partition import Partition

AccountLevel = Literal["exact", "exact, with held", "parts only", "one vector"]
Resize = Literal["bicubic", "linear", "area", "bilinear"]
Mirror = Literal["sum", "none"]
# Maxima far beyond any sensible network: of a side in pixels; then of parts, length of a part, height, and width. A larger
# claim in a file would take all memory.
MAX_SIDE = 4096
_MAXIMA = (256, 1 << 17, MAX_SIDE, MAX_SIDE)
# Bounds of mean and std, far inside float32's range; for values 0 .. 255, the std is 1/255.
_MAX_MEAN, _STD_RANGE = 1e3, (1e-4, 1e4)
# The branch of a model whose branches have roles: the first describes queries, the second the gallery.
Role = Literal["query", "gallery"]


@dataclass(frozen=True)
class Contract:
    """The description of a loaded model by itself.

    Attributes:
        method: such as "LPN" or "FSRA".
        title: one line for headers and logs.
        views: the views that it describes, in the order satellite, street, drone.
        input_size: (height, width) of the network input in pixels.
        n_parts, embedding: n and D of a descriptor (n, D).
        level: exactness of evidence, see `claim`.
        held: quantities held at their values for each picture, such as "the regions of each picture"; "" for other levels.
        groups: the views that share weights; by default all in one group, or each in its own if branches have roles.
        roles: "view" if the view chooses the branch. "role" if one branch describes queries and the other the gallery, see
            `Model.for_task`; there are two views then.
        resize: "bicubic" (Pillow's, anti-aliased), "linear" (OpenCV's INTER_LINEAR_EXACT, not anti-aliased), "area" (OpenCV's
            INTER_AREA, the mean over each pixel's area), or "bilinear" (Pillow's, anti-aliased).
        mean, std: of red, green, and blue, for values 0 .. 1.
        mirror: "sum" if the raw parts of the mirrored picture are added before normalisation.
        partitions: by view, the partition of every map; a view without one has parts that differ between pictures.
        part_names: by view; by default those of its partition, else numbers.
        polar: the views whose pictures are first unrolled around their centre, see `images.polar`.

    Raises:
        InputError: if the values contradict each other.
    """

    method: str
    title: str
    views: tuple[View, ...]
    input_size: tuple[int, int]
    n_parts: int
    embedding: int
    level: AccountLevel
    held: str = ""
    groups: tuple[tuple[View, ...], ...] = ()
    roles: Literal["view", "role"] = "view"
    resize: Resize = "bicubic"
    mean: Triple = MEAN
    std: Triple = STD
    mirror: Mirror = "sum"
    partitions: Mapping[View, Partition] = field(default_factory=dict)
    part_names: Mapping[View, Sequence[str]] = field(default_factory=dict)
    polar: tuple[View, ...] = ()

    def __post_init__(self) -> None:
        if not self.views or any(view not in VIEWS for view in self.views):
            raise InputError(f"The views are {self.views}; expected one to three of {', '.join(VIEWS)}.")
        object.__setattr__(self, "views", tuple(view for view in VIEWS if view in self.views))
        by_default = tuple((view,) for view in self.views) if self.roles == "role" else (self.views,)
        object.__setattr__(self, "groups", self.groups or by_default)
        if sorted(view for group in self.groups for view in group) != sorted(self.views):
            raise InputError(f"The groups {self.groups} do not hold each of the views {', '.join(self.views)} once.")
        choices = {"level": AccountLevel, "roles": Literal["view", "role"], "resize": Resize, "mirror": Mirror}
        for name, allowed in choices.items():
            if getattr(self, name) not in get_args(allowed):
                raise InputError(
                    f"The contract's {name} is {getattr(self, name)!r}; expected one of {', '.join(get_args(allowed))}."
                )
        if self.roles == "role" and [len(group) for group in self.groups] != [1, 1]:
            groups = ", ".join(" ".join(group) for group in self.groups)
            raise InputError(
                f"The contract's roles are 'role' and its groups {groups!r}; one branch describes queries and one the gallery, "
                "so give two groups of one view each, or the roles 'view'."
            )
        counts = {"parts": self.n_parts, "numbers of a part": self.embedding}
        counts |= {"height": self.input_size[0], "width": self.input_size[1]}
        for (name, value), most in zip(counts.items(), _MAXIMA, strict=True):
            if not isinstance(value, int) or isinstance(value, bool) or not 1 <= value <= most:
                raise InputError(f"The contract's {name} is {value!r}; expected a whole number from 1 to {most}.")
        low, high = _STD_RANGE
        within = all(abs(value) <= _MAX_MEAN for value in self.mean) and all(low <= value <= high for value in self.std)
        if len(self.mean) != 3 or len(self.std) != 3 or not within:
            raise InputError(
                f"The mean is {self.mean} and std {self.std}; expected three numbers each, the mean from -{_MAX_MEAN:g} to "
                f"{_MAX_MEAN:g}, std above 0, from {low:g} to {high:g}."
            )
        if bool(self.held) != (self.level == "exact, with held"):
            raise InputError(
                f"The contract's level is {self.level!r} and held is {self.held!r}; name what is held with 'exact, with "
                "held', and only then."
            )
        if (self.level == "one vector" and self.n_parts != 1) or (self.level == "parts only" and self.n_parts == 1):
            raise InputError(f"The contract's level is {self.level!r} with {self.n_parts} parts; one of both is wrong.")
        for view, names in self.part_names.items():
            if len(names) != self.n_parts:
                raise InputError(f"The {view} has {len(names)} names of parts; expected {self.n_parts}.")
        for view, partition in self.partitions.items():
            if partition.n != self.n_parts:
                raise InputError(f"The {view}'s partition has {partition.n} parts; expected {self.n_parts}.")

    @property
    def has_cells(self) -> bool:
        """True if each part is a sum over cells, so that there is evidence."""
        return self.level in ("exact", "exact, with held")

    @property
    def claim(self) -> str:
        """The level in words: "exact", "exact, with X held", "parts only: the model gives no cells", or "one vector"."""
        if self.level == "exact, with held":
            return f"exact, with {self.held} held"
        return "parts only: the model gives no cells" if self.level == "parts only" else self.level

    def with_held(self, what: str) -> Contract:
        """Return this contract with one more held quantity; unchanged without cells."""
        if not self.has_cells:
            return self
        return replace(self, level="exact, with held", held=f"{self.held} and {what}" if self.held else what)

    def partition(self, view: View) -> Partition | None:
        """Return the partition of every map of a view; None if each picture's cells define its parts."""
        return self.partitions.get(view)

    def names(self, view: View) -> list[str]:
        """Return a short name for each part of a view."""
        if view in self.part_names:
            return [printable(name) for name in self.part_names[view]]
        partition = self.partition(view)
        return [str(part + 1) for part in range(self.n_parts)] if partition is None else part_names(partition)

    @property
    def part_noun(self) -> str:
        """The noun for a part: "ring" if the first view is divided into several rings, else "part"."""
        partition = self.partition(self.views[0])
        return "ring" if partition is not None and partition.kind == "rings" and partition.n > 1 else "part"

    def default_role(self, view: View) -> Role:
        """Return the role of a view outside of a task: the first view, such as the satellite, is the gallery."""
        return "gallery" if view == self.views[0] else "query"

    def unrolled(self, view: View) -> bool:
        """Return whether pictures of `view` are first unrolled around their centre."""
        return view in self.polar


def part_names(partition: Partition) -> list[str]:
    """Return a short name for each part: "1 centre", "2", "3", "4 outer"."""
    if partition.n == 1:
        return ["1 whole"]
    ends = {"rows": ("top", "bottom"), "columns": ("left", "right"), "windows": ("left", "right")}
    first, last = ends.get(partition.kind, ("centre", "outer"))[:: -1 if partition.outside_in else 1]
    return [f"1 {first}", *(str(i + 1) for i in range(1, partition.n - 1)), f"{partition.n} {last}"]


@dataclass(frozen=True)
class Heads:
    """The terms of the module's equations that are equal for all pictures of a view.

    Attributes:
        weight: A, (n, D, C) float32; None for the identity, with D = C.
        bias: c, (n, D) float32; None for 0.
        cells: the weight of each cell in each part, (n, h, w) float32; None if it differs between pictures.
    """

    weight: Float32Array | None = None
    bias: Float32Array | None = None
    cells: Float32Array | None = None


class ForwardPass(NamedTuple):
    """The result of one forward pass of B pictures.

    Attributes:
        parts: raw parts, (B, n, D).
        features: a map for all parts, (B, C, h, w), or one for each part, (B, n, C, h, w); None without cells.
        cells: the weight of each cell in each part, (B, n, h, w); None for the heads' cells.
        constants: (B, n, D), in place of the heads' bias; None for the heads' bias.
        slopes: of an activation after the head, (B, n, D); None without one.
    """

    parts: Float32Array
    features: Float32Array | None = None
    cells: Float32Array | None = None
    constants: Float32Array | None = None
    slopes: Float32Array | None = None


def check_pass(contract: Contract, outputs: ForwardPass, heads: Heads) -> None:
    """Refuse a forward pass with cells whose shapes contradict its contract, or whose numbers are not finite.

    Raises:
        ModelFileError: with actual and expected shapes, or the name of the output that is not finite.
    """
    if outputs.features is None:
        raise ModelFileError(
            f"{contract.method} returns no features, but its contract says {contract.claim!r}; return them, or say "
            f"{'one vector' if contract.n_parts == 1 else 'parts only'!r}."
        )
    found = {name: array for name, array in outputs._asdict().items() if array is not None}
    static = {"the heads' weight": heads.weight, "the heads' bias": heads.bias}
    found |= {name: array for name, array in static.items() if array is not None}
    check_shapes(contract, {name: array.shape for name, array in found.items()})
    for name, array in [*found.items(), ("the heads' cells", heads.cells)]:
        if array is not None and not np.isfinite(array).all():
            raise ModelFileError(
                f"{contract.method} gives {name} with values that are not finite, so its weights are damaged or its code divides "
                "by zero; mend it, or use another model."
            )


def check_shapes(contract: Contract, found: Mapping[str, Sequence[int]], channels: bool = True) -> None:
    """Refuse shapes that contradict the contract or each other.

    Args:
        found: shapes by name: the fields of `ForwardPass`, "the heads' weight", "the heads' bias", "the heads' cells", and
            "pictures", (B,), which by default is the B of the parts.
        channels: whether to check the channels of the features.

    Raises:
        ModelFileError: with actual and expected shape.
    """
    n, size = contract.n_parts, contract.embedding
    count = found.get("pictures", found.get("parts", (1,)))[0]
    expected: dict[str, tuple[int, ...]] = {"parts": (count, n, size)}
    if (shape := tuple(found.get("features", ()))) or "features" in found:
        width = (shape[-3] if len(shape) > 3 else 1) if "the heads' weight" in found or not channels else size
        by_part, cells = (n,) if len(shape) == 5 else (), shape[-2:]
        expected |= {"features": (count, *by_part, width, *cells), "cells": (count, n, *cells)}
        expected |= {"constants": (count, n, size), "slopes": (count, n, size), "the heads' cells": (n, *cells)}
        expected |= {"the heads' weight": (n, size, width), "the heads' bias": (n, size)}
    for name, wanted in expected.items():
        if name in found and tuple(found[name]) != wanted:
            raise ModelFileError(
                f"{contract.method} gives {name} of shape {shown(found[name])}; by its contract of {n} parts of {size} numbers, "
                f"and its map, they are {shown(wanted)}."
            )


def shown(shape: Sequence[object]) -> str:
    """Return a shape as text, such as 4 x 512."""
    return " x ".join(map(str, shape))
