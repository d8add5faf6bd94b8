"""Teachers of a training: trained models whose similarities between the pictures of a batch the network learns."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

import lpn
from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.views import View, branch_of
from lpn.models.base import Model


class Teachers:
    """Trained models of any method, size, and file that `lpn.load` opens.

    Args:
        models: at least one.
        views: those of the training.

    Raises:
        InputError: when a model lacks a view, unrolls tiles, or tells queries from the gallery, which the pictures of a training
            are not.
    """

    def __init__(self, models: Sequence[Model], views: Sequence[View]) -> None:
        self.models = tuple(models)
        for model in models:
            lacks = [view for view in views if view not in model.views]
            reason = f"has no branch for {' and '.join(lacks)}" if lacks else ""
            if model.contract.roles != "view":
                reason = "has branches for queries and gallery in place of views"
            if model.contract.polar:
                reason = "is shown unrolled tiles, which no other network is"
            if reason:
                raise InputError(f"The teacher {model.contract.title} {reason}; give another --teacher.")

    @classmethod
    def load(cls, paths: Sequence[Path], views: Sequence[View]) -> Teachers:
        """Load models.

        Raises:
            ModelFileError: when a file is not a model.
            InputError: see the class.
        """
        return cls([lpn.load(path) for path in paths], views)

    @property
    def digest(self) -> str:
        """A hexadecimal digest of all models."""
        return hashlib.sha256(" ".join(model.fingerprint for model in self.models).encode()).hexdigest()

    def descriptors(self, sets: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Describe a batch: (b, F) by picture set, whose inner products are the mean of the models' cosines.

        Args:
            sets: the input of the network that is trained, (b, 3, H, W), normalised as ImageNet's.
        """
        found: dict[str, list[Tensor]] = {name: [] for name in sets}
        for model in self.models:
            for name, pictures in sets.items():
                parts = model.descriptors(_prepared(pictures, model), branch_of(name), mirror=False)
                found[name].append(torch.from_numpy(parts.reshape(len(parts), -1)).to(pictures.device))
        scale = math.sqrt(len(self.models))
        return {name: torch.cat(one, dim=1) / scale for name, one in found.items()}


def _prepared(pictures: Tensor, model: Model) -> Float32Array:
    """Return the pictures as a model takes them: of its size, and normalised by its mean and standard deviation."""
    size, contract = model.input_size, model.contract
    sized = pictures.float()
    if tuple(sized.shape[-2:]) != size:
        sized = F.interpolate(sized, size=size, mode="bicubic", align_corners=False, antialias=True)
    ours, theirs = ((images.MEAN, images.STD), (contract.mean, contract.std))
    if theirs != ours:
        (mean, std), (other_mean, other_std) = (
            [sized.new_tensor(values).view(3, 1, 1) for values in pair] for pair in (ours, theirs)
        )
        sized = (sized * std + mean - other_mean) / other_std
    return np.ascontiguousarray(sized.cpu().numpy(), np.float32)
