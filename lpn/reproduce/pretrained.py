"""Pretrained weights by backbone, and the features of a backbone without training."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import cast

import torch
from torch import nn

from lpn.core.errors import InputError, ModelFileError
from lpn.core.files import fingerprint
from lpn.models import checkpoints
from lpn.models.backbones import CHANNELS
from lpn.models.lpn import LPN
from lpn.models.shipped import model_file
from lpn.models.spec import ModelSpec
from lpn.training.recipes import Recipe


def by_backbone(files: Sequence[Path]) -> dict[str, Path]:
    """Sort the files of --init by the backbone they hold.

    Raises:
        ModelFileError: when a file cannot be read or holds no known backbone.
        InputError: when two files hold the same backbone.
    """
    files_of: dict[str, Path] = {}
    for weights in files:
        file = model_file(weights, trained=True)
        name = checkpoints.backbone_in(file)
        if name in files_of:
            raise InputError(f"{files_of[name]} and {file} both hold a {name}; give one of them with --init.")
        files_of[name] = file
    return files_of


def features_alone(recipe: Recipe, init: Path) -> checkpoints.TorchModel:
    """Make a network whose descriptor is the mean over the last feature map of a pretrained backbone.

    Raises:
        ModelFileError: when `init` lacks weights of that backbone.
    """
    channels = CHANNELS[recipe.backbone, recipe.last_layer]
    spec = ModelSpec(
        recipe.backbone, recipe.last_layer, views=("street",), shared=False, n_parts=1, embedding=channels, classes=1,
        input_size=recipe.input_size,
    )  # fmt: skip
    network = LPN(spec)
    _, _, missing = checkpoints.load_backbone(network, init)
    if missing:
        raise ModelFileError(
            f"{init.name} lacks {', '.join(missing)} of {recipe.backbone}, so its features alone cannot be measured; give a file "
            "of the whole backbone with --init."
        )
    block = network.heads[0].add_block
    linear, norm = cast(nn.Linear, block[0]), cast(nn.BatchNorm1d, block[1])
    with torch.no_grad():
        linear.weight.copy_(torch.eye(channels))
        norm.weight.fill_(1.0)
    print_of = fingerprint(init, also=f"features alone {spec.to_json()}")
    return checkpoints.TorchModel(network.to(checkpoints.best_device()), print_of)
