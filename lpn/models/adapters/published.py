"""The common part of the builders of published models: the model as its checkpoint tells, its views, sizes, and options."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, cast

import torch

from lpn.core.errors import ModelFileError
from lpn.core.views import View
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import PartBranch
from lpn.models.contract import Contract, Level, Role

PAIR: tuple[View, ...] = ("satellite", "drone")
_TRIPLE: tuple[View, ...] = ("satellite", "street", "drone")
# Entries that the published code keeps and does not use for descriptors.
_UNUSED = re.compile(
    r".*(\bclassifier\.\d+\.|num_batches_tracked$)|(bn|gem\d+|model\.fc|transformer\.fc|convnext\.(head|model\.fc))\."
)
NORM_HELD = "the LayerNorm's mean and variance"


@dataclass(frozen=True)
class PublishedParts:
    """A model as its checkpoint tells.

    Attributes:
        contract: what the model says of itself.
        branches: by view, or by role where the contract's roles are "role".
        length: of a descriptor that the released test code writes.
    """

    contract: Contract
    branches: Mapping[View | Role, PartBranch]
    length: float = 1.0


def by_view(
    entries: Entries,
    branch: Callable[[str], PartBranch],
    method: str,
    backbone: str,
    size: tuple[int, int],
    names: list[str],
    level: Level,
    held: str = "",
) -> PublishedParts:
    """Build a model whose satellite and drone share `model_1`; `model_2`, where there is one, describes the street."""
    three = has(entries, "model_2.")
    check_views(entries, 3 if three else 2)
    shared = not three or equal(entries, "model_1.", "model_2.")
    first = branch("model_1.")
    numbered = tuple(f"{number + 1} {name}" for number, name in enumerate(names))
    branches: dict[View | Role, PartBranch] = dict.fromkeys(_TRIPLE if three else PAIR, first)
    if not shared:
        branches["street"] = branch("model_2.")
    bias = cast(torch.Tensor, first.bias)
    parts, embedding = bias.shape
    views = _TRIPLE if three else PAIR
    return PublishedParts(
        Contract(
            method=method,
            title=f"{method} {backbone}, n = {parts}, {size[0]} x {size[1]}",
            views=views,
            input_size=size,
            n_parts=parts,
            embedding=embedding,
            level=level,
            held=held,
            groups=(views,) if shared else (PAIR, ("street",)),
            part_names=dict.fromkeys(views, numbered),
        ),
        branches,
    )


def count_regions(entries: Entries) -> int:
    """Return the number of regions by the heads beside that of the class token.

    With one block the released code describes by the class token alone, so its region's head may be there or not.
    """
    count = entries.count_heads("classifier_heat")
    if count or entries.options.get("block") != 1:
        check_option(entries, "block", count)
    return count if count > 1 else 0


def region_names(count: int) -> list[str]:
    """Return a short name for each region of tokens, in the order of falling heat."""
    middle = ["region"] * max(count - 2, 0)
    return ["hottest", *middle, "coolest"][:count]


def regions_level(regions: int) -> dict[str, Any]:
    return {"level": "exact, with held", "held": "the regions of each picture"} if regions else {"level": "one vector"}


def roles_of(shared: bool) -> dict[str, Any]:
    """Return roles and groups of a contract; a branch for each role is a group for the view of that role outside of a task."""
    return {} if shared else {"roles": "role", "groups": (("satellite",), ("drone",))}


def has(entries: Entries, prefix: str) -> bool:
    return any(key.startswith(prefix) for key in entries.state)


def equal(entries: Entries, first: str, second: str) -> bool:
    """Return whether two branches describe alike."""
    one, other = (entries.under(prefix).state for prefix in (first, second))
    return all(key in other and torch.equal(value, other[key]) for key, value in one.items() if not _UNUSED.match(key))


def size_of(entries: Entries, default: tuple[int, int], step: int = 1) -> tuple[int, int]:
    """Return the input size of the options, by default that of the released script.

    Raises:
        ModelFileError: if it is no multiple of `step`, or huge.
    """
    size = (int(entries.options.get("h", default[0])), int(entries.options.get("w", default[1])))
    if any(side % step or side > 4096 for side in size):
        raise ModelFileError(
            f"The opts.yaml beside {entries.name} says {size[0]} x {size[1]} pixels; expected multiples of {step} up to 4096."
        )
    return size


def check_views(entries: Entries, found: int) -> None:
    stated = entries.options.get("views", found)
    if stated != found:
        raise ModelFileError(
            f"{entries.name} describes {found} views by the networks that it holds, but the opts.yaml beside it says "
            f"views: {stated}; correct or remove it."
        )


def check_option(entries: Entries, option: str, found: int) -> None:
    stated = entries.options.get(option, found)
    if stated != found:
        raise ModelFileError(
            f"{entries.name} has {found} of these heads, but the opts.yaml beside it says {option}: {stated}; correct or "
            "remove it."
        )
