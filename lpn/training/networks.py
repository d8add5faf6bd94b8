"""The network of a recipe, before it is trained."""

from __future__ import annotations

from collections.abc import Sequence
from typing import cast

from torch import nn

from lpn.core.views import View
from lpn.models.backbones import CHANNELS
from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec, is_timm
from lpn.training.recipe import Recipe


def build_network(recipe: Recipe, views: Sequence[View], classes: int) -> LPN:
    """Build a recipe's network for some views, with a class for each place; torch's seed decides its weights."""
    # `last_layer` is defined for our own backbones only.
    last_layer = "layer4" if is_timm(recipe.backbone) else recipe.last_layer
    embedding = ModelSpec.embedding
    if recipe.pooling == "safa":
        embedding = recipe.maps * CHANNELS[recipe.backbone, last_layer]
    elif not recipe.linear:
        embedding = CHANNELS[recipe.backbone, last_layer]
    network = LPN(
        ModelSpec(
            backbone=recipe.backbone,
            last_layer=last_layer,
            last_stride=recipe.last_stride,
            views=tuple(views),
            shared=recipe.shared and "drone" in views,
            n_parts=recipe.n_parts,
            layout=recipe.layout,
            weighting=recipe.weighting,
            activation=recipe.activation,
            # A map has none, and a network at least one.
            classes=1 if recipe.windows else classes,
            dropout=recipe.dropout,
            input_size=recipe.input_size,
            pooling=recipe.pooling,
            maps=recipe.maps,
            polar=recipe.polar,
            backbone_dropout=recipe.backbone_dropout,
            embedding=embedding,
        )
    )
    initialise_heads(network, recipe)
    return network


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
