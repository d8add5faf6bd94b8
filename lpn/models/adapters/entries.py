"""The entries of a published checkpoint as an adapter reads them: by prefix, with their shapes checked."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor, nn

from lpn.core.errors import ModelFileError

_EPSILON = 1e-5
# Entries that layers have; one of them alone is no layer.
_OF_LAYER = ("weight", "bias", "running_mean", "running_var", "gamma")


_BLOCK = re.compile(r"(?:.*\.)?(?:blocks|layers|stages)\.\d+(?=\.)")


@dataclass(frozen=True)
class Entries:
    """Named tensors of a checkpoint, and the options beside it.

    Attributes:
        name: of the file, for messages.
        state: the tensors.
        options: of `opts.yaml`; empty without one.
        prefix: what was cut off the names of `state`, for messages.
        read: identities of the tensors that were read, in common with the entries that these are part of.
    """

    name: str
    state: Mapping[str, Tensor]
    options: Mapping[str, Any] = field(default_factory=dict)
    prefix: str = ""
    read: set[int] = field(default_factory=set)

    def under(self, prefix: str) -> Entries:
        """Return the entries whose names begin with a prefix, without it."""
        cut = {key[len(prefix) :]: value for key, value in self.state.items() if key.startswith(prefix)}
        return Entries(self.name, cut, self.options, self.prefix + prefix, self.read)

    def renamed(self, patterns: Mapping[str, str]) -> Entries:
        """Return the entries under other names: the first pattern that matches a name's begin replaces it."""
        renamed: dict[str, Tensor] = {}
        for key, value in self.state.items():
            for pattern, replacement in patterns.items():
                changed, count = re.subn(f"^{pattern}", replacement, key)
                if count:
                    key = changed
                    break
            renamed[key] = value
        return Entries(self.name, renamed, self.options, self.prefix, self.read)

    def count(self, pattern: str) -> int:
        """Return how many numbers 0, 1, ... in a row complete a pattern such as `blocks.{}.norm1.weight`.

        Raises:
            ModelFileError: if further numbers are there behind one that is missing.
        """
        return self._counted(pattern, 0)

    def count_heads(self, name: str) -> int:
        """Count the heads `name`1, `name`2, ...

        Raises:
            ModelFileError: if further heads are there behind one that is missing.
        """
        return self._counted(f"{name}{{}}.add_block.0.weight", 1)

    def _counted(self, pattern: str, first: int) -> int:
        number = first
        while pattern.format(number) in self.state:
            number += 1
        begin = re.escape(pattern.partition("{")[0])
        there = [int(match[1]) for key in self.state if (match := re.match(rf"{begin}(\d+)\.", key))]
        if there and max(there) >= number:
            self.shape(pattern.format(number), 1)
        return number - first

    def left_over(self) -> list[str]:
        """Return the names of the entries that nothing has read.

        Raises:
            ModelFileError: if a layer or a block was read in part, such as its weight without its bias.
        """
        # The tensors of `state` live since before anything was read, so no freed tensor can have had an identity of theirs.
        read = {key for key, value in self.state.items() if id(value) in self.read}
        layers = {_layer(key) for key in read}
        unread = [key for key in self.state if key not in read]
        for key in unread:
            if key.rpartition(".")[2] in _OF_LAYER and _layer(key) in layers:
                raise ModelFileError(
                    f"{self.name} has {self.prefix}{key}, and others of its kind are missing; the file is incomplete or of a "
                    "changed model, so give a whole checkpoint."
                )
        return unread

    def shape(self, key: str, sides: int) -> tuple[int, ...]:
        """Return the shape of an entry.

        Raises:
            ModelFileError: if it is missing, or has another number of sides or an empty one.
        """
        tensor = self.state.get(key)
        if tensor is None:
            raise ModelFileError(
                f"{self.name} lacks {self.prefix}{key}; the file is incomplete or of another model, so give a whole checkpoint."
            )
        if tensor.ndim != sides or 0 in tensor.shape:
            raise ModelFileError(
                f"In {self.name}, {self.prefix}{key} has shape {tuple(tensor.shape)}; expected {sides} sides above 0."
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
        self.read.add(id(self.state[key]))
        value = self.state[key].to(torch.float32)
        # The sum is a cheap test: it is finite only if all entries are.
        if not bool(value.sum().isfinite()) and not bool(value.isfinite().all()):
            raise ModelFileError(
                f"In {self.name}, {self.prefix}{key} holds values that are not finite; take an earlier checkpoint."
            )
        return value

    def fill(self, network: nn.Module) -> None:
        """Put the entries into a network of the same names, also one on the meta device; further entries are ignored.

        Raises:
            ModelFileError: as for `tensor`.
        """
        wanted = {key: value for key, value in network.state_dict().items() if not key.endswith("num_batches_tracked")}
        # Parameters that take a tensor as it is must own it: branches of one file may share tensors.
        tensors = {key: self.tensor(key, tuple(value.shape)) for key, value in wanted.items()}
        counters = {
            key: torch.zeros((), dtype=torch.int64)
            for key in network.state_dict()
            if key.endswith("num_batches_tracked")
        }
        network.load_state_dict(tensors | counters, assign=True)

    def head(self, prefix: str, channels: int) -> tuple[Tensor, Tensor]:
        """Return a head's Linear and BatchNorm1d at test time as one affine map: A (D, C) and c (D,).

        Raises:
            ModelFileError: as for `tensor`.
        """
        weight, bias = self.linear(f"{prefix}.add_block.0", channels)
        size = len(bias)
        gamma, beta, mean, variance = (
            self.tensor(f"{prefix}.add_block.1.{key}", (size,))
            for key in ("weight", "bias", "running_mean", "running_var")
        )
        scale = gamma / torch.sqrt(variance + _EPSILON)
        return scale[:, None] * weight, scale * (bias - mean) + beta

    def linear(self, prefix: str, channels: int) -> tuple[Tensor, Tensor]:
        """Return a head that is one linear layer: A (D, C) and c (D,).

        Raises:
            ModelFileError: as for `tensor`.
        """
        size = self.shape(f"{prefix}.weight", 2)[0]
        return self.tensor(f"{prefix}.weight", (size, channels)), self.tensor(f"{prefix}.bias", (size,))

    def heads(self, prefixes: list[str], channels: int) -> tuple[Tensor, Tensor]:
        """Return the heads of several parts: A (n, D, C) and c (n, D).

        Raises:
            ModelFileError: as for `tensor`, and if their sizes differ.
        """
        pairs = [self.head(prefix, channels) for prefix in prefixes]
        sizes = [len(bias) for _, bias in pairs]
        if len(set(sizes)) > 1:
            raise ModelFileError(
                f"In {self.name}, the heads {', '.join(prefixes)} give {', '.join(map(str, sizes))} numbers; expected one size."
            )
        return torch.stack([weight for weight, _ in pairs]), torch.stack([bias for _, bias in pairs])


def _layer(key: str) -> str:
    """Return the block that an entry is of, else its layer."""
    block = _BLOCK.match(key)
    return block[0] if block else key.rpartition(".")[0]
