"""A network in training: optimizer, learning rates, precision, and moving average."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager, nullcontext
from dataclasses import fields
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from lpn.core.views import View, branch_of
from lpn.models import checkpoints
from lpn.models.backbones import CHANNELS
from lpn.models.lpn import LPN
from lpn.models.spec import ModelSpec, is_timm
from lpn.training.loader import TrainingBatch
from lpn.training.losses import TrainingStep, loss_terms, open_loss
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

        By default each set is a separate batch, as in the published code. With `joint_views`, sets with equal weights and
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
        """Return the complete state for the next step, as tensors and numbers."""
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


class MixedPrecision:
    """The arithmetic of the forward pass: float32, or mixed precision in bfloat16 or float16.

    With float16 the loss is scaled, so that small gradients do not underflow.

    Attributes:
        fell_back: True if the recipe's float16 is replaced, for lack of CUDA.
    """

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        self.fell_back = recipe.precision == "float16" and device.type != "cuda"
        self.device, self.dtype = device, choose_dtype(recipe, device)
        self.scaler = torch.amp.GradScaler(device.type, enabled=self.dtype == torch.float16)

    @property
    def name(self) -> str:
        """Name of the dtype, such as "bfloat16"."""
        return str(self.dtype).removeprefix("torch.")

    def autocast(self) -> AbstractContextManager[object]:
        """Context of the forward pass."""
        return nullcontext() if self.dtype == torch.float32 else torch.autocast(self.device.type, self.dtype)

    def convolutions(self) -> AbstractContextManager[object]:
        """Context of a step: cuDNN uses the fastest algorithm for the fixed size of a batch, and float32 without TF32."""
        return torch.backends.cudnn.flags(enabled=True, benchmark=True, allow_tf32=self.dtype != torch.float32)

    def step(self, loss: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Update the weights. With float16, a step whose gradient overflows is skipped."""
        optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(loss).backward()  # type: ignore[no-untyped-call]
        self.scaler.step(optimizer)
        self.scaler.update()


def choose_dtype(recipe: Recipe, device: torch.device) -> torch.dtype:
    """Choose the dtype of the forward pass.

    "auto" is bfloat16 if the hardware has it, else float16 on CUDA and float32 elsewhere. Emulated bfloat16 would be slower
    than float32, and so would float16 on a CPU. So on a CPU "float16" means "auto".
    """
    if recipe.precision in ("float32", "bfloat16"):
        return torch.bfloat16 if recipe.precision == "bfloat16" else torch.float32
    if recipe.precision == "float16" and device.type == "cuda":
        return torch.float16
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float16
    return torch.bfloat16 if torch.cpu._is_avx512_bf16_supported() else torch.float32


def build_optimizer(network: LPN, recipe: Recipe) -> torch.optim.Optimizer:
    """Build the optimizer with two groups: the backbones at their lower rate, then the heads."""
    backbone = {id(p): p for view in network.spec.views for p in network.branch(view).model.parameters()}
    heads = [p for p in network.parameters() if id(p) not in backbone]
    groups = [
        {"params": list(backbone.values()), "lr": recipe.lr * recipe.backbone_ratio},
        {"params": heads, "lr": recipe.lr},
    ]
    if recipe.optimizer in ("adam", "adamw"):
        kind = torch.optim.AdamW if recipe.optimizer == "adamw" else torch.optim.Adam
        return kind(groups, weight_decay=recipe.weight_decay)
    return torch.optim.SGD(groups, momentum=0.9, nesterov=True, weight_decay=recipe.weight_decay)


def rate_factor(recipe: Recipe, step: int, steps: int) -> float:
    """Return the learning rate at a step relative to the recipe's.

    Args:
        step: number of the step, from 0, over all epochs.
        steps: steps per epoch.
    """
    factor = _warmup_factor(recipe, step, steps) if recipe.warmup == "rate" else 1.0
    if recipe.schedule == "cosine":
        return factor * 0.5 * (1 + math.cos(math.pi * step / (recipe.epochs * steps)))
    if recipe.schedule == "step":
        decays = [recipe.decay_epoch, *([recipe.second_decay_epoch] if recipe.second_decay_epoch else [])]
        factor *= 0.1 ** sum(step >= epoch * steps for epoch in decays)
    return factor


def loss_factor(recipe: Recipe, step: int, steps: int) -> float:
    """Return the factor of the loss at a step, below 1 during its warm-up; the arguments are those of `rate_factor`."""
    return _warmup_factor(recipe, step, steps) if recipe.warmup == "loss" else 1.0


def _warmup_factor(recipe: Recipe, step: int, steps: int) -> float:
    share = min(1.0, (step + 1) / max(recipe.warmup_epochs * steps, 1))
    return recipe.warmup_start + (1.0 - recipe.warmup_start) * share


def average_weights(network: LPN, decay: float) -> AveragedModel:
    """Make an exponential moving average of weights and BatchNorm statistics.

    The decay rises to `decay` with the count n of averaged steps: it is min(decay, n / (9 + n)). Set `n_averaged` to n before
    each update; AveragedModel would copy the weights at 0. Each branch of the network averages its tensors, so tensors that two
    branches share move twice a step.
    """

    def update(averages: list[Tensor], values: list[Tensor], _: Tensor | int) -> None:
        if not averages[0].is_floating_point():
            torch._foreach_copy_(averages, values)
            return
        n = int(average.n_averaged)  # on the CPU, so that reading it does not stall a GPU
        move = get_ema_multi_avg_fn(min(decay, n / (9 + n)))  # type: ignore[no-untyped-call]
        move(averages, values, n)
        shared = [pair for pair in zip(averages, values, strict=True) if branches[pair[0].data_ptr()] > 1]
        if shared:
            move(*map(list, zip(*shared, strict=True)), n)

    average = AveragedModel(network, multi_avg_fn=update, use_buffers=True)  # type: ignore[arg-type]
    branches = Counter(tensor.data_ptr() for tensor in average.module.state_dict().values())
    return average


def network_spec(recipe: Recipe, views: Sequence[View], classes: int) -> ModelSpec:
    """Return the architecture of a recipe's network for some views, with a class for each place."""
    settings = {field.name: getattr(recipe, field.name) for field in fields(ModelSpec) if hasattr(recipe, field.name)}
    if is_timm(recipe.backbone):
        settings["last_layer"] = "layer4"  # it is defined for our own backbones only
    elif recipe.pooling == "safa" or not recipe.linear:
        maps = recipe.maps if recipe.pooling == "safa" else 1
        settings["embedding"] = maps * CHANNELS[recipe.backbone, recipe.last_layer]
    # A map has no classes, but a network needs at least one.
    settings |= {"views": tuple(views), "classes": 1 if recipe.windows else classes}
    return ModelSpec(**settings | {"shared": recipe.shared and "drone" in views})


def build_network(recipe: Recipe, views: Sequence[View], classes: int) -> LPN:
    """Build the network of `network_spec`; torch's seed decides its weights."""
    network = LPN(network_spec(recipe, views, classes))
    initialise_heads(network, recipe)
    return network


def initialise_heads(network: LPN, recipe: Recipe) -> None:
    """Initialise the class layers by the recipe; heads without a linear layer get a fixed identity instead."""
    for head in network.heads:
        if recipe.class_init == "kaiming":
            nn.init.kaiming_normal_(cast(nn.Linear, head.classifier[0]).weight, mode="fan_out")
        if not recipe.linear:
            identity = cast(nn.Linear, head.add_block[0])
            nn.init.eye_(identity.weight)
            identity.requires_grad_(False)
