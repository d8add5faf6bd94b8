"""How a step changes the weights: the optimizer, its rates, the arithmetic, and the average of the weights."""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext

import torch
from torch import Tensor

from lpn.models.network import LPN
from lpn.training.recipes import Recipe


class Arithmetic:
    """The forward pass's numbers: float32, or mixed precision in bfloat16 or float16.

    float16, whose range is small, has its loss scaled so that small gradients do not vanish.
    """

    def __init__(self, recipe: Recipe, device: torch.device) -> None:
        self.device, self.dtype = device, choose_dtype(recipe, device)
        self.scaler = torch.amp.GradScaler(device.type, enabled=self.dtype == torch.float16)

    @property
    def name(self) -> str:
        """Such as "bfloat16"."""
        return str(self.dtype).removeprefix("torch.")

    def forward(self) -> AbstractContextManager[object]:
        """What the forward pass runs in."""
        return nullcontext() if self.dtype == torch.float32 else torch.autocast(self.device.type, self.dtype)

    def step(self, loss: Tensor, optimizer: torch.optim.Optimizer) -> None:
        """Change the weights by the gradient of `loss`; with float16, a step whose gradient overflows is left out."""
        optimizer.zero_grad(set_to_none=True)
        self.scaler.scale(loss).backward()  # type: ignore[no-untyped-call]
        self.scaler.step(optimizer)
        self.scaler.update()


def choose_dtype(recipe: Recipe, device: torch.device) -> torch.dtype:
    """What the recipe asks for; "auto" is bfloat16 where the hardware has it, else float16 on CUDA, else float32.

    Emulated, bfloat16 would be slower than float32.
    """
    if recipe.precision != "auto":
        return torch.bfloat16 if recipe.precision == "bfloat16" else torch.float32
    if device.type == "cuda":
        return torch.bfloat16 if torch.cuda.is_bf16_supported(including_emulation=False) else torch.float16
    return torch.bfloat16 if torch.cpu._is_avx512_bf16_supported() else torch.float32


def build_optimizer(network: LPN, recipe: Recipe) -> torch.optim.Optimizer:
    """Two groups: the backbones at their lower rate, then the heads."""
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
    """The learning rate at a step, counted from 0 over all epochs of `steps` each, relative to the recipe's."""
    factor = min(1.0, (step + 1) / max(recipe.warmup_epochs * steps, 1))
    if recipe.schedule == "cosine":
        return factor * 0.5 * (1 + math.cos(math.pi * step / (recipe.epochs * steps)))
    return factor * (0.1 if step >= recipe.decay_epoch * steps else 1.0)


@torch.no_grad()
def follow(average: LPN, network: LPN, decay: float, step: int) -> None:
    """Move an average of the weights towards them, faster at the start."""
    share = 1 - min(decay, (1 + step) / (10 + step))
    for mean, value in zip(average.state_dict().values(), network.state_dict().values(), strict=True):
        if mean.is_floating_point():
            mean.lerp_(value, share)
        else:
            mean.copy_(value)
