"""A memory of the latest descriptors of all training places, as further negatives beside those of the batch.

Cross-batch memory (Wang et al. 2020): weights change slowly, so descriptors of the last epochs still stand for their places.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from lpn.training.losses import descriptors


class DescriptorMemory:
    """The latest descriptor of each place in each picture set.

    Args:
        places: number of places, which are the classes of the labels.
    """

    def __init__(self, places: int) -> None:
        self.places = places
        self.rows: dict[str, Tensor] = {}

    def others(self, labels: Tensor) -> dict[str, Tensor]:
        """Return descriptors (M, F) of the places that are remembered and not among `labels`, by picture set, M of the set."""
        fresh = torch.ones(self.places, dtype=torch.bool)
        fresh[labels.cpu()] = False
        # A descriptor has norm 1, so a row of zeros is none.
        return {name: rows[fresh.to(rows.device) & rows.any(dim=1)] for name, rows in self.rows.items()}

    def remember(self, outputs: Mapping[str, tuple[Tensor, Tensor]], labels: Tensor) -> None:
        """Keep the descriptors of a step; `outputs` are those of `MultiViewNetwork`, of sets with the same labels (B,)."""
        for name, (parts, _) in outputs.items():
            found = descriptors(parts.detach().float())
            if name not in self.rows:
                self.rows[name] = torch.zeros(self.places, found.shape[1], device=found.device)
            self.rows[name][labels] = found

    def state(self) -> dict[str, Tensor]:
        """Return what `restore` takes."""
        return {f"rows.{name}": rows for name, rows in self.rows.items()}

    def restore(self, state: Mapping[str, Tensor], device: torch.device) -> None:
        """Restore what `state` returned, on a device.

        Raises:
            KeyError: if the state is another one.
        """
        self.rows = {
            key.removeprefix("rows."): rows.to(device) for key, rows in state.items() if key.startswith("rows.")
        }
