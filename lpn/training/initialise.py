"""The initialisation of the layers that are added to a backbone, where a recipe has another one than the network's own."""

from __future__ import annotations

from typing import cast

from torch import nn

from lpn.models.lpn import LPN
from lpn.training.recipes import Recipe


def initialise_heads(network: LPN, recipe: Recipe) -> None:
    """Initialise the class layers as the recipe says, and make the first layer of heads without one the identity.

    The identity is not trained.
    """
    for head in network.heads:
        if recipe.class_init == "kaiming":
            nn.init.kaiming_normal_(cast(nn.Linear, head.classifier[0]).weight, mode="fan_out")
        if not recipe.linear:
            identity = cast(nn.Linear, head.add_block[0])
            nn.init.eye_(identity.weight)
            identity.requires_grad_(False)
