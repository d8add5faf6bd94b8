"""The optimizer, its learning rates, mixed precision, and the moving average of the weights."""

from __future__ import annotations

import math
from collections import Counter
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor
from torch.optim.swa_utils import AveragedModel, get_ema_multi_avg_fn

from lpn.models.lpn import LPN
from lpn.training.recipe import Recipe


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
    than float32, and so would float16 on a CPU, which therefore means "auto" there.
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
