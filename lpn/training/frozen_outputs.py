"""The output of a frozen backbone for each variant of each place, computed once."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager

import torch
from torch import Tensor

from lpn.core.arrays import UInt8Array
from lpn.core.errors import InputError
from lpn.core.resources import memory
from lpn.core.views import branch_of
from lpn.models.network import LPN

# A place and its variant, each by its number.
Variant = tuple[int, int]
Pictures = dict[str, list[UInt8Array]]
# A variant, and its pictures of each set unless their outputs are here already.
DrawnVariant = tuple[Variant, Pictures | None]


class FrozenOutputs:
    """The inputs of a network's first adapted block, for all variants of all places, in memory as float16.

    Args:
        network: with adapted blocks; it is in training.
        variants: number of variants that all processes on this machine will store at most, to estimate the memory.
        autocast: context of the forward pass.
    """

    def __init__(self, network: LPN, variants: int, autocast: Callable[[], AbstractContextManager[object]]) -> None:
        self.network, self.variants, self.autocast = network, variants, autocast
        self._outputs: dict[Variant, dict[str, list[Tensor]]] = {}

    def draw(self, variant: Variant, draw: Callable[[], Pictures]) -> DrawnVariant:
        """Draw the pictures of a variant, unless their outputs are here; runs in a worker."""
        return variant, None if variant in self._outputs else draw()

    def sets(
        self, rows: Sequence[DrawnVariant], network_input: Callable[[Sequence[UInt8Array]], Tensor]
    ) -> dict[str, Tensor]:
        """Return the outputs of the rows of a batch for each set, float32, after computing those that are missing.

        Args:
            network_input: makes a batch of pictures the input of the network, on its device.

        Raises:
            InputError: if the outputs that will be stored on this machine need more memory than is free.
        """
        # A worker may have drawn a variant again before its outputs were computed.
        fresh = [
            (variant, pictures) for variant, pictures in rows if pictures is not None and variant not in self._outputs
        ]
        if fresh:
            self._compute(fresh, network_input)
        device = next(self.network.parameters()).device
        outputs = [self._outputs[variant] for variant, _ in rows]
        return {
            name: torch.stack([one for row in outputs for one in row[name]]).to(device, torch.float32)
            for name in outputs[0]
        }

    def _compute(
        self, fresh: Sequence[tuple[Variant, Pictures]], network_input: Callable[[Sequence[UInt8Array]], Tensor]
    ) -> None:
        computed: dict[str, list[Tensor]] = {}
        for name in fresh[0][1]:
            images = network_input([one for _, pictures in fresh for one in pictures[name]])
            with self.autocast():
                computed[name] = list(self.network.branch(branch_of(name)).frozen_output(images).half().cpu())
        if not self._outputs:
            self._check_memory(sum(one.nbytes for outputs in computed.values() for one in outputs) // len(fresh))
        for variant, pictures in fresh:
            self._outputs[variant] = {
                name: [computed[name].pop(0).clone() for _ in of_set] for name, of_set in pictures.items()
            }

    def _check_memory(self, bytes_each: int) -> None:
        needed, known = bytes_each * self.variants, memory()
        if known is not None and needed > (free := known[1]):
            raise InputError(
                f"The frozen blocks' outputs for {self.variants:,} variants of places need {needed / 1e9:.1f} GB of memory, and "
                f"{free / 1e9:.1f} GB are free; give fewer --variants, or leave them out."
            )
