"""The entries of a checkpoint: selected by prefix, checked for their shapes, and recorded when they are read."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError

_EPSILON = 1e-5
_BLOCK = re.compile(r"(?:.*\.)?(?:blocks|layers|stages)\.\d+(?=\.)")
# Entries of a layer. A layer may be unread as a whole, but not in part.
_OF_LAYER = ("weight", "bias", "running_mean", "running_var", "gamma")


@dataclass(frozen=True)
class Entries:
    """Named tensors of a checkpoint, and the options beside it.

    Attributes:
        name: of the file, for messages.
        state: the tensors.
        options: of `opts.yaml`; empty without one.
        names: for each name in `state`, the name in the file, if it differs.
        prefix: the removed prefix of the names of `state`, for messages.
        read: the names in the file of all tensors that were read; all `Entries` of one file share it.
    """

    name: str
    state: Mapping[str, Tensor]
    options: Mapping[str, Any] = field(default_factory=dict)
    names: Mapping[str, str] = field(default_factory=dict)
    prefix: str = ""
    read: set[str] = field(default_factory=set)

    def file_name(self, key: str) -> str:
        """Return the name of an entry in the file."""
        return self.names.get(key, self.prefix + key)

    def has(self, prefix: str) -> bool:
        """Return whether any name begins with a prefix."""
        return any(key.startswith(prefix) for key in self.state)

    def under(self, prefix: str) -> Entries:
        """Return the entries whose names begin with a prefix; the prefix is removed."""
        cut = {key[len(prefix) :]: value for key, value in self.state.items() if key.startswith(prefix)}
        names = {key: self.file_name(prefix + key) for key in cut}
        return replace(self, state=cut, names=names, prefix=self.prefix + prefix)

    def renamed(self, patterns: Mapping[str, str]) -> Entries:
        """Return the entries under other names: the value of the first matching pattern replaces a name's beginning."""
        state, names = {}, {}
        for key, value in self.state.items():
            found = (pattern for pattern in patterns if re.match(pattern, key))
            changed = next((re.sub(f"^{pattern}", patterns[pattern], key) for pattern in found), key)
            state[changed], names[changed] = value, self.file_name(key)
        return replace(self, state=state, names=names)

    def count(self, pattern: str, first: int = 0) -> int:
        """Count the consecutive numbers from `first` that complete a pattern such as `blocks.{}.norm1.weight`.

        Raises:
            ModelFileError: if further numbers follow a missing one.
        """
        number = first
        while pattern.format(number) in self.state:
            number += 1
        begin = re.escape(pattern.partition("{")[0])
        there = [int(match[1]) for key in self.state if (match := re.match(rf"{begin}(\d+)\.", key))]
        if there and max(there) >= number:
            self.shape(pattern.format(number), 1)
        return number - first

    def count_heads(self, name: str) -> int:
        """Count the heads `name`1, `name`2, ...; see `count`."""
        return self.count(f"{name}{{}}.add_block.0.weight", 1)

    def left_over(self, unused: str) -> list[str]:
        """Return the file's names of unread entries, except for matches of the pattern `unused`.

        Raises:
            ModelFileError: if a layer or a block was read in part, such as its weight without its bias.
        """
        layers = {_layer(key) for key in self.read}
        unread = [key for key in map(self.file_name, self.state) if key not in self.read]
        for key in unread:
            if key.rpartition(".")[2] in _OF_LAYER and _layer(key) in layers:
                raise ModelFileError(
                    f"{self.name} has {key}, but the model reads only other entries of this layer; the file is incomplete or of "
                    "a changed model, so give a whole checkpoint."
                )
        return [key for key in unread if not re.search(rf"num_batches_tracked$|{unused}", key)]

    def shape(self, key: str, sides: int) -> tuple[int, ...]:
        """Return the shape of an entry.

        Raises:
            ModelFileError: if it is missing, has another number of dimensions, or an empty one.
        """
        tensor = self.state.get(key)
        if tensor is None:
            raise ModelFileError(
                f"{self.name} lacks {self.prefix}{key}; the file is incomplete or of another model, so give a whole checkpoint."
            )
        if tensor.ndim != sides or 0 in tensor.shape:
            raise ModelFileError(
                f"In {self.name}, {self.prefix}{key} has shape {tuple(tensor.shape)}; expected {sides} dimensions, none 0."
            )
        return tuple(tensor.shape)

    def tensor(self, key: str, shape: tuple[int, ...]) -> Tensor:
        """Return an entry as float32.

        Raises:
            ModelFileError: if it is missing, has another shape, or holds values that are not finite.
        """
        if self.shape(key, len(shape)) != shape:
            raise ModelFileError(
                f"In {self.name}, {self.prefix}{key} has shape {tuple(self.state[key].shape)}; expected {shape}."
            )
        self.read.add(self.file_name(key))
        value = self.state[key].to(torch.float32)
        # The sum is a cheap test: it is finite only if all entries are.
        if not bool(value.sum().isfinite()) and not bool(value.isfinite().all()):
            raise ModelFileError(
                f"In {self.name}, {self.prefix}{key} holds values that are not finite; take an earlier checkpoint."
            )
        return value

    def fill(self, network: nn.Module, optional: str = "num_batches_tracked$") -> None:
        """Load the entries into a network with entries of the same names, even on the meta device; ignore further entries.

        Args:
            optional: a pattern of entries that may be missing, and are 0 then.

        Raises:
            ModelFileError: as for `tensor`.
        """
        tensors, wanted = {}, network.state_dict()
        missing = [key for key in wanted if key not in self.state and not re.search(optional, key)]
        if len(missing) > 1:
            raise ModelFileError(
                f"{self.name} lacks {len(missing)} of {len(wanted)} entries, the first being {self.prefix}{missing[0]}; the file "
                "is incomplete or of another architecture."
            )
        for key, value in wanted.items():
            if re.search(optional, key) and (key not in self.state or not value.is_floating_point()):
                tensors[key] = torch.zeros(value.shape, dtype=value.dtype)
            else:
                # A copy: branches may share tensors, and results would depend on a tensor's alignment in its file.
                tensors[key] = self.tensor(key, tuple(value.shape)).clone()
        network.load_state_dict(tensors, assign=True)

    def linear(self, prefix: str, channels: int) -> tuple[Tensor, Tensor]:
        """Return a head of one linear layer: A (D, C) and c (D,)."""
        size = self.shape(f"{prefix}.weight", 2)[0]
        return self.tensor(f"{prefix}.weight", (size, channels)), self.tensor(f"{prefix}.bias", (size,))

    def head(self, prefix: str, channels: int) -> tuple[Tensor, Tensor]:
        """Return a head's Linear and BatchNorm1d at test time as one affine map: A (D, C) and c (D,)."""
        weight, bias = self.linear(f"{prefix}.add_block.0", channels)
        gamma, beta, mean, variance = (
            self.tensor(f"{prefix}.add_block.1.{key}", (len(bias),))
            for key in ("weight", "bias", "running_mean", "running_var")
        )
        scale = gamma / torch.sqrt(variance + _EPSILON)
        return scale[:, None] * weight, scale * (bias - mean) + beta

    def heads(self, prefixes: list[str], channels: int) -> tuple[Tensor, Tensor]:
        """Return the heads of several parts, all of one size: A (n, D, C) and c (n, D)."""
        pairs = [self.head(prefix, channels) for prefix in prefixes]
        sizes = [len(bias) for _, bias in pairs]
        if len(set(sizes)) > 1:
            raise ModelFileError(
                f"In {self.name}, the heads {', '.join(prefixes)} give {', '.join(map(str, sizes))} numbers; expected one size."
            )
        return torch.stack([weight for weight, _ in pairs]), torch.stack([bias for _, bias in pairs])


def _layer(key: str) -> str:
    """Return an entry's block, else its layer."""
    block = _BLOCK.match(key)
    return block[0] if block else key.rpartition(".")[0]
