"""Features carried over to landmarks (Table VI) as released: layumi/cnnimageretrieval-pytorch, test_My1652model.py.

A picture keeps its aspect ratio; its longer side is shrunk to 1024 pixels. A query is first cropped to its box, and shrunk by
the whole picture's factor. Its descriptor is the mean over the last feature map, without head, mirror, or normalisation.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from lpn.core import images
from lpn.core.arrays import Float32Array
from lpn.core.errors import InputError
from lpn.core.progress import tracked
from lpn.core.views import View
from lpn.datasets import Picture
from lpn.models.base import Model

if TYPE_CHECKING:
    from lpn.models.checkpoints import TorchModel

SIDE = 1024
SENTENCE = (
    f"pictures of at most {SIDE} pixels in their original aspect ratio, the mean over the last feature map, neither mirrored nor "
    "normalised, as released"
)


def check_model(model: Model) -> TorchModel:
    """Check that a model computes feature maps of pictures of any size, and return it.

    Raises:
        InputError: if it is not an LPN or a baseline in PyTorch.
    """
    from lpn.models.checkpoints import TorchModel

    if isinstance(model, TorchModel) and model.spec.pooling == "average":
        return model
    raise InputError(
        "The released transfer describes pictures of any size by the mean of their map, which takes an LPN or a baseline as "
        ".safetensors or .pth; give one, or leave --protocol out."
    )


def map_means(model: Model, pictures: Sequence[Picture], view: View, side: int = SIDE) -> Float32Array:
    """Return the mean over a branch's last feature map of each picture, (N, 1, C) float32.

    Args:
        side: pixels of a whole picture's longer side.

    Raises:
        InputError: if the model is not an LPN in PyTorch, or lacks the view.
        PictureError: if a picture cannot be read.
    """
    import torch

    from lpn.models.checkpoints import exact_inference

    network = check_model(model).network
    model.check_view(view)
    means, device = [], next(network.parameters()).device
    for picture in tracked(f"Describing {view} pictures, as released", pictures, len(pictures)):
        shrunk = images.shrink_to(images.load_picture(picture.path, upright=False), side, picture.box)
        batch = torch.from_numpy(images.normalise(shrunk)[None]).to(device)
        with exact_inference():
            means.append(network.features(batch, view).mean((2, 3)).cpu().numpy())
    return np.stack(means).astype(np.float32)
