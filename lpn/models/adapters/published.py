"""A published model of another method in PyTorch, and the common part of the builders."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lpn.core.arrays import Float32Array
from lpn.core.errors import ModelFileError
from lpn.core.views import VIEWS, View
from lpn.models.adapters.network import Account, PartBranch
from lpn.models.base import Model
from lpn.models.checkpoints import exact_inference
from lpn.models.contract import AccountLevel, Contract, ForwardPass, Heads, Role
from lpn.models.entries import Entries
from lpn.models.options import picture_size

PAIR: tuple[View, ...] = ("satellite", "drone")
# Entries of the published code that descriptors do not use.
_UNUSED = re.compile(
    r".*(\bclassifier\.\d+\.|num_batches_tracked$)|(bn|gem\d+|model\.fc|transformer\.fc|convnext\.(head|model\.fc))\."
)


@dataclass(frozen=True)
class PublishedParts:
    """A model built from a checkpoint.

    Attributes:
        contract: the model's contract.
        branches: by view, or by role if the contract's roles are "role".
    """

    contract: Contract
    branches: Mapping[View | Role, PartBranch]


class PublishedModel(Model):
    """A published model that runs in PyTorch, on a device.

    Args:
        published: its contract and branches.
        fingerprint: of its file.
        device: such as "cpu".
    """

    def __init__(self, published: PublishedParts, fingerprint: str, device: torch.device | str = "cpu") -> None:
        self.contract, self.fingerprint = published.contract, fingerprint
        self._device = torch.device(device)
        self.device = self._device.type
        self.batch = 64 if self.device == "cuda" else 8
        self.networks: Mapping[View | Role, PartBranch] = {
            key: branch.eval().requires_grad_(False).to(self._device) for key, branch in published.branches.items()
        }

    def network(self, view: View) -> PartBranch:
        """Return the branch that describes a view, by its role if branches have roles.

        Raises:
            InputError: if the model lacks the view.
        """
        self.check_view(view)
        return self.networks[self.role(view) if self.contract.roles == "role" else view]

    def run(self, images: Float32Array, view: View) -> ForwardPass:
        """Run one forward pass of images (B, 3, H, W).

        Raises:
            InputError: if the model lacks the view, or the images have another size.
        """
        account = cast(Account, self._forward(images, view, account=True))
        return ForwardPass(*(None if tensor is None else _array(tensor) for tensor in account))  # type: ignore[arg-type]

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        return _array(cast(Tensor, self._forward(images, view, account=False)))

    def _forward(self, images: Float32Array, view: View, account: bool) -> Tensor | Account:
        network = self.network(view)
        self.check_size(images)
        with exact_inference():
            batch = torch.tensor(images, device=self._device)
            return network.account(batch) if account else cast(Tensor, network(batch))

    def heads(self, view: View) -> Heads:
        """Return the static heads; empty if the features include them."""
        weight = self.network(view).weight
        return Heads() if weight is None or not self.contract.has_cells else Heads(_array(weight))

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the map of an image of the model's input size; 1 x 1 without cells."""
        return self.network(view).grid


def _array(tensor: Tensor) -> Float32Array:
    return np.ascontiguousarray(tensor.cpu().numpy(), np.float32)


def published(
    branches: Mapping[View | Role, PartBranch],
    method: str,
    backbone: str,
    size: tuple[int, int],
    parts: Sequence[str] = (),
    embedding: int = 0,
    **further: Any,
) -> PublishedParts:
    """Return a model of branches by view, or by the roles query and gallery; views of one branch share its weights.

    Args:
        parts: their names without numbers; none for a method of one vector.
        embedding: length of a part; 0 takes the length from the branch's heads.
        further: other fields of the contract.
    """
    roles = "query" in branches
    views = PAIR if roles else cast("tuple[View, ...]", tuple(branches))
    by_branch = [tuple(view for view in views if branches.get(view) is one) for one in dict.fromkeys(branches.values())]
    names, first = [f"{i} {name}" for i, name in enumerate(parts or ["whole"], 1)], next(iter(branches.values()))
    level: AccountLevel = "exact, with held" if first.held else "exact"
    contract = Contract(
        method=method,
        title=f"{method} {backbone}, {f'n = {len(names)}, ' if parts else ''}{size[0]} x {size[1]}",
        views=views,
        input_size=size,
        n_parts=len(names),
        embedding=embedding or cast(Tensor, first.bias).shape[1],
        level="one vector" if first.held is None else level,
        held=first.held or "",
        groups=() if roles else tuple(by_branch),
        roles="role" if roles else "view",
        part_names=dict.fromkeys(views, tuple(names)),
        **further,
    )
    return PublishedParts(contract, branches)


def by_view(entries: Entries, made: Sequence[PartBranch]) -> dict[View | Role, PartBranch]:
    """Return the first branch for satellite and drone, and the last for the street if there is a `model_2`."""
    views: tuple[View, ...] = VIEWS if entries.has("model_2.") else PAIR
    check_option(entries, "views", len(views))
    return {view: made[-1 if view == "street" else 0] for view in views}


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
        what = "views" if option == "views" else "heads of parts"
        raise ModelFileError(
            f"{entries.name} has {held} {what}, but the opts.yaml beside it says {option}: {stated}; correct or remove it."
        )
