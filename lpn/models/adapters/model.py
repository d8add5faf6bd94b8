"""A published model of another method than LPN, in PyTorch."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor

from lpn.core.arrays import Float32Array
from lpn.core.views import View
from lpn.models.adapters.network import Account, PartBranch
from lpn.models.adapters.published import PublishedParts
from lpn.models.base import Model
from lpn.models.checkpoints import exact_inference
from lpn.models.contract import ForwardPass, Heads, Role


class PublishedModel(Model):
    """A published model that runs in PyTorch, on a device.

    Pictures may have other sizes than the model's if its positions allow that.

    Args:
        published: its contract and branches.
        fingerprint: of its file.
        device: such as "cpu".
    """

    def __init__(self, published: PublishedParts, fingerprint: str, device: torch.device | str = "cpu") -> None:
        self.contract, self.fingerprint, self.length = published.contract, fingerprint, published.length
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
            InputError: if the model lacks the view, or cannot take pictures of this size.
        """
        account = cast(Account, self._forward(images, view, account=True))
        return ForwardPass(*(None if tensor is None else _array(tensor) for tensor in account))  # type: ignore[arg-type]

    def _parts(self, images: Float32Array, view: View) -> Float32Array:
        return _array(cast(Tensor, self._forward(images, view, account=False)))

    def _forward(self, images: Float32Array, view: View, account: bool) -> Tensor | Account:
        network = self.network(view)
        network.check_size(tuple(images.shape[2:]), self.input_size)
        with exact_inference():
            batch = torch.tensor(images, device=self._device)
            return network.account(batch) if account else cast(Tensor, network(batch))

    def released_descriptors(self, images: Any, view: View) -> Float32Array:
        """Return the rows of the released test code: (B, D n), the part index fastest.

        They are `descriptors` in that order. Only the rows of DenseUAV with the heads FSRA and LPN have the length
        sqrt((k + 1) / k) for k regions or rings beside the class token.

        Raises:
            InputError, ModelFileError: as for `descriptors`.
        """
        parts = self.descriptors(images, view)
        return parts.transpose(0, 2, 1).reshape(len(parts), -1) * np.float32(self.length)

    def heads(self, view: View) -> Heads:
        """Return the static heads; empty if the features include them."""
        weight = self.network(view).weight
        return Heads() if weight is None or not self.contract.has_cells else Heads(_array(weight))

    def map_size(self, view: View) -> tuple[int, int]:
        """Return (h, w) of the map of an image of the model's input size; 1 x 1 without cells."""
        return self.network(view).grid


def _array(tensor: Tensor) -> Float32Array:
    return np.ascontiguousarray(tensor.cpu().numpy(), np.float32)
