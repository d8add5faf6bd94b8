"""The network of a recipe in training: network, optimizer, and average, the state that one step changes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn

from lpn.core.views import View, branch_of
from lpn.models import checkpoints
from lpn.models.backbones import CHANNELS
from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec, is_timm
from lpn.training.loader import TrainingBatch
from lpn.training.losses import TrainingStep, loss_terms, open_loss
from lpn.training.optimizer import MixedPrecision, average_weights, build_optimizer, loss_factor, rate_factor
from lpn.training.recipe import Recipe


class Learner:
    """A network in training.

    Args:
        network: moved to the device, in channels-last order, which makes its convolutions faster.
        recipe: optimizer, rates, losses, and precision.
        device: the device of the training.
    """

    def __init__(self, network: LPN, recipe: Recipe, device: torch.device) -> None:
        self.network, self.recipe, self.device = network, recipe, device
        network.to(device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        self.own_loss = open_loss(recipe.loss) if recipe.loss else None
        self.average = average_weights(network, recipe.ema) if recipe.ema else None
        self.mixed_precision = MixedPrecision(recipe, device)
        self.optimizer = build_optimizer(network, recipe)
        self.rates = [float(parameters["lr"]) for parameters in self.optimizer.param_groups]

    def step(self, batch: TrainingBatch, step: int, steps: int) -> tuple[dict[str, Tensor], float]:
        """Take one training step.

        Args:
            step: number of the step, from 0, over all epochs.
            steps: steps per epoch.

        Returns:
            The loss of the whole batch and its terms, without a warm-up's factor, and the learning rate of the heads.
        """
        factor = rate_factor(self.recipe, step, steps)
        for parameters, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            parameters["lr"] = rate * factor
        with self.mixed_precision.convolutions():
            with self.mixed_precision.autocast():
                outputs = self.outputs(batch.sets)
            parts, scores = ({name: of[i] for name, of in outputs.items()} for i in (0, 1))
            terms = loss_terms(
                TrainingStep(parts, scores, batch.labels, batch.overlaps, step), self.recipe, self.own_loss
            )
            loss = sum(terms.values(), torch.zeros((), device=self.device))
            self.mixed_precision.step(loss * loss_factor(self.recipe, step, steps), self.optimizer)
        if self.average is not None:
            # A resumed run knows its step, so the count need not be saved.
            self.average.n_averaged.fill_(step + 1)
            self.average.update_parameters(self.network)
        return {"loss": loss.detach()} | {name: of.detach() for name, of in terms.items()}, self.rates[-1] * factor

    def outputs(self, sets: Mapping[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
        """Compute part embeddings (b, n, D) and class scores (b, n, classes) of each set of pictures (b, 3, H, W).

        By default each set is a batch of its own, as in the published code. With `joint_views`, sets with equal weights and
        partition form one batch, so that BatchNorm sees them together.
        """
        groups = self.network.spec.groups()
        batches: dict[object, list[str]] = {}
        for name in sets:
            key = next(g for g in groups if branch_of(name) in g) if self.recipe.joint_views else name
            batches.setdefault(key, []).append(name)
        outputs: dict[str, tuple[Tensor, Tensor]] = {}
        for names in batches.values():
            embeddings, scores = self.network(torch.cat([sets[name] for name in names]), branch_of(names[0]))
            sizes = [len(sets[name]) for name in names]
            of_sets = zip(embeddings.split(sizes), scores.split(sizes), strict=True)
            outputs |= dict(zip(names, of_sets, strict=True))
        return outputs

    def save_model(self, path: Path, metadata: dict[str, str]) -> None:
        """Write the averaged model, or the model itself if the recipe has no average."""
        model = self.network if self.average is None else cast(LPN, self.average.module)
        checkpoints.save(model, path, metadata)

    def state(self) -> dict[str, Any]:
        """Return the complete state of the next step, as tensors and numbers."""
        return {
            "network": self.network.state_dict(),
            "average": {} if self.average is None else self.average.module.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.mixed_precision.scaler.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Restore the result of `state`.

        Raises:
            RuntimeError, ValueError, KeyError: when the state does not fit this network and optimizer.
        """
        self.network.load_state_dict(state["network"])
        if self.average is not None:
            self.average.module.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        # The scaler's state is empty if the run did not use float16.
        if state["scaler"]:
            self.mixed_precision.scaler.load_state_dict(state["scaler"])


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
            # A map has no classes, but a network needs at least one.
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
    """Initialise the class layers by the recipe; in heads without a first layer, it becomes an untrained identity."""
    for head in network.heads:
        if recipe.class_init == "kaiming":
            nn.init.kaiming_normal_(cast(nn.Linear, head.classifier[0]).weight, mode="fan_out")
        if not recipe.linear:
            identity = cast(nn.Linear, head.add_block[0])
            nn.init.eye_(identity.weight)
            identity.requires_grad_(False)
