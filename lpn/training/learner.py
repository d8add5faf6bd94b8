"""What a training changes, one step at a time: the network, its optimizer, and the average of its weights."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel

from lpn.core.views import branch_of
from lpn.models import checkpoints
from lpn.models.network import LPN
from lpn.training.loader import TrainingBatch
from lpn.training.losses import total_loss
from lpn.training.multi_process import ProcessGroup
from lpn.training.optimizer import Arithmetic, build_optimizer, follow, rate_factor
from lpn.training.recipes import Recipe


class Learner:
    """A network in training.

    Args:
        network: moved to the group's device, channels last, which is the quicker order for its convolutions.
        recipe: optimizer, rates, losses, and precision.
        group: the processes that share the training; `share_out` joins their networks.
    """

    def __init__(self, network: LPN, recipe: Recipe, group: ProcessGroup) -> None:
        self.network, self.recipe, self.group = network, recipe, group
        network.to(group.device, memory_format=torch.channels_last)  # type: ignore[call-overload]
        # What is saved and tested is the first process's.
        self.average = copy.deepcopy(network) if recipe.ema and group.leads else None
        self.arithmetic = Arithmetic(recipe, group.device)
        self.optimizer = build_optimizer(network, recipe)
        self.rates = [float(parameters["lr"]) for parameters in self.optimizer.param_groups]
        self.views: nn.Module = Views(network, recipe.joint_views)

    def share_out(self) -> None:
        """Let the processes' gradients be averaged from now on; on GPUs, BatchNorm sees the pictures of all."""
        if self.group.size == 1 or isinstance(self.views, DistributedDataParallel):
            return
        device = self.group.device
        cuda = device.type == "cuda"
        if cuda:
            nn.SyncBatchNorm.convert_sync_batchnorm(self.network)  # type: ignore[no-untyped-call]
        # A static graph allows for heads that the recipe's loss does not use.
        self.views = DistributedDataParallel(self.views, device_ids=[device.index] if cuda else None, static_graph=True)

    def step(self, batch: TrainingBatch, step: int, steps: int) -> tuple[Tensor, float]:
        """One step, counted from 0 over all epochs of `steps` each: the loss of the whole batch, and the heads' rate."""
        factor = rate_factor(self.recipe, step, steps)
        for parameters, rate in zip(self.optimizer.param_groups, self.rates, strict=True):
            parameters["lr"] = rate * factor
        with self.arithmetic.forward():
            outputs = self.views(batch.sets)
        loss = total_loss(self.group.gather(outputs), batch.places, self.recipe)
        self.arithmetic.step(loss, self.optimizer)
        if self.average is not None:
            follow(self.average, self.network, self.recipe.ema, step)
        return loss.detach(), self.rates[-1] * factor

    def finite(self) -> bool:
        """Whether every weight is a number."""
        return all(bool(torch.isfinite(tensor).all()) for tensor in self.network.state_dict().values())

    def save_model(self, path: Path, metadata: dict[str, str]) -> None:
        """Write the model, which is the average where there is one."""
        checkpoints.save(self.average or self.network, path, metadata)

    def state(self) -> dict[str, Any]:
        """All that the next step depends on, as tensors and numbers."""
        return {
            "network": self.network.state_dict(),
            "average": self.average.state_dict() if self.average is not None else {},
            "optimizer": self.optimizer.state_dict(),
            "scaler": self.arithmetic.scaler.state_dict(),
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to what `state` gave; RuntimeError, ValueError, or KeyError where it does not fit."""
        self.network.load_state_dict(state["network"])
        if self.average is not None:
            self.average.load_state_dict(state["average"])
        self.optimizer.load_state_dict(state["optimizer"])
        # Empty when the run that goes on had no use for a scaler.
        if state["scaler"]:
            self.arithmetic.scaler.load_state_dict(state["scaler"])


class Views(nn.Module):
    """A network as it is trained: all sets of a step in one call, as DistributedDataParallel needs it.

    Each set is a batch of its own, as published, or where `joint`, those that share weights and partition are one:
    BatchNorm then sees them together.
    """

    def __init__(self, network: LPN, joint: bool) -> None:
        super().__init__()
        self.network, self.joint = network, joint

    def forward(self, sets: dict[str, Tensor]) -> dict[str, tuple[Tensor, Tensor]]:
        """Part embeddings (b, n, D) and class scores (b, n, classes) of each set (b, 3, H, W)."""
        outputs: dict[str, tuple[Tensor, Tensor]] = {}
        groups = self.network.spec.groups()
        batches: dict[object, list[str]] = {}
        for name in sets:
            key = next(g for g in groups if branch_of(name) in g) if self.joint else name
            batches.setdefault(key, []).append(name)
        for names in batches.values():
            embeddings, scores = self.network(torch.cat([sets[name] for name in names]), branch_of(names[0]))
            sizes = [len(sets[name]) for name in names]
            for name, e, s in zip(names, embeddings.split(sizes), scores.split(sizes), strict=True):
                outputs[name] = (e, s)
        return outputs
