"""The common part of the builders of published models: views, sizes, and options of a checkpoint."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch

from lpn.core.errors import ModelFileError
from lpn.core.views import View
from lpn.models.adapters.entries import Entries
from lpn.models.adapters.network import PartBranch
from lpn.models.contract import AccountLevel, Contract, Role
from lpn.models.options import picture_size

PAIR: tuple[View, ...] = ("satellite", "drone")
# Entries of the published code that descriptors do not use.
_UNUSED = re.compile(
    r".*(\bclassifier\.\d+\.|num_batches_tracked$)|(bn|gem\d+|model\.fc|transformer\.fc|convnext\.(head|model\.fc))\."
)
NORM_HELD = "the LayerNorm's mean and variance"


@dataclass(frozen=True)
class PublishedParts:
    """A model built from a checkpoint.

    Attributes:
        contract: the model's contract.
        branches: by view, or by role if the contract's roles are "role".
        length: of a descriptor in the released test code.
    """

    contract: Contract
    branches: Mapping[View | Role, PartBranch]
    length: float = 1.0


def published(
    branches: Mapping[View | Role, PartBranch],
    method: str,
    backbone: str,
    size: tuple[int, int],
    level: AccountLevel,
    held: str = "",
    parts: Sequence[str] = (),
    embedding: int = 0,
    **further: Any,
) -> PublishedParts:
    """Return a model of branches by view, or by the roles query and gallery; views of one branch share its weights.

    Args:
        parts: their names with numbers; none for a method of one vector.
        embedding: length of a part; 0 for that of the branch's heads.
        further: other fields of the contract.
    """
    roles = "query" in branches
    views = PAIR if roles else cast("tuple[View, ...]", tuple(branches))
    by_branch = [tuple(view for view in views if branches.get(view) is one) for one in dict.fromkeys(branches.values())]
    names = tuple(parts) or ("1 whole",)
    contract = Contract(
        method=method,
        title=f"{method} {backbone}, {f'n = {len(names)}, ' if parts else ''}{size[0]} x {size[1]}",
        views=views,
        input_size=size,
        n_parts=len(names),
        embedding=embedding or cast(torch.Tensor, next(iter(branches.values())).bias).shape[1],
        level=level,
        held=held,
        groups=() if roles else tuple(by_branch),
        roles="role" if roles else "view",
        part_names=dict.fromkeys(views, names),
        **further,
    )
    return PublishedParts(contract, branches)


def by_view(
    entries: Entries,
    branch: Callable[[Entries], PartBranch],
    method: str,
    backbone: str,
    size: tuple[int, int],
    names: list[str],
    level: AccountLevel,
    held: str = "",
) -> PublishedParts:
    """Build a model whose satellite and drone share `model_1`; `model_2`, if it exists, describes the street."""
    three = entries.has("model_2.")
    check_option(entries, "views", 3 if three else 2)
    made = [branch(own) for own in numbered(entries)]
    branches: dict[View | Role, PartBranch] = {"satellite": made[0], "drone": made[0]}
    if three:
        branches = {"satellite": made[0], "street": made[-1], "drone": made[0]}
    parts = [f"{number + 1} {name}" for number, name in enumerate(names)]
    return published(branches, method, backbone, size, level, held, parts)


def distinct(entries: Entries, *prefixes: str) -> list[Entries]:
    """Return the entries of one or two branches by their prefixes; only the first if both are equal."""
    alike = len(prefixes) == 2 and equal(entries, *prefixes)
    return [entries.under(prefix) for prefix in (prefixes[:1] if alike else prefixes)]


def numbered(entries: Entries) -> list[Entries]:
    """Return the entries of `model_1`, and those of `model_2` if they exist and differ."""
    return distinct(entries, "model_1.", *(["model_2."] if entries.has("model_2.") else []))


def by_role(made: Sequence[PartBranch]) -> dict[View | Role, PartBranch]:
    """Return one branch for both views, or the first of two for queries and the second for the gallery."""
    return dict.fromkeys(PAIR, made[0]) if len(made) == 1 else {"query": made[0], "gallery": made[1]}


def count_regions(entries: Entries) -> int:
    """Return the number of FSRA's regions, from the heads beside the class token's.

    With one block, the released code describes by the class token alone, so a region's head is optional.
    """
    count = entries.count_heads("classifier_heat")
    if count or entries.options.get("block") != 1:
        check_option(entries, "block", count)
    return count if count > 1 else 0


def region_names(count: int) -> list[str]:
    """Return a short name for each region of tokens, in the order of falling heat."""
    return ["hottest", *["region"] * max(count - 2, 0), "coolest"][:count]


def regions_level(regions: int) -> dict[str, Any]:
    """Return a contract's arguments for the exactness of the evidence of FSRA's regions."""
    return {"level": "exact, with held", "held": "the regions of each picture"} if regions else {"level": "one vector"}


def equal(entries: Entries, first: str, second: str) -> bool:
    """Return whether two branches are equal; then the second one counts as read."""
    one, other = entries.under(first), entries.under(second)
    compared = [key for key in one.state if not _UNUSED.match(key)]
    alike = all(key in other.state and torch.equal(one.state[key], other.state[key]) for key in compared)
    if alike:
        entries.read.update(other.file_name(key) for key in compared)
    return alike


def size_of(entries: Entries, default: tuple[int, int], step: int = 1) -> tuple[int, int]:
    """Return the input size of the options, by default the released script's.

    Raises:
        ModelFileError: if it is no multiple of `step`, or huge.
    """
    return picture_size(entries.options, entries.name, default, step=step)


def check_option(entries: Entries, option: str, held: int) -> None:
    """Raise ModelFileError if an option contradicts the number in the entries."""
    stated = entries.options.get(option, held)
    if stated != held:
        what = "networks describe as many views" if option == "views" else "of these heads"
        raise ModelFileError(
            f"{entries.name} has {held} {what}, but the opts.yaml beside it says {option}: {stated}; correct or remove it."
        )
