"""Training by several processes, one for each GPU, as `torchrun` starts them; a training alone is a group of one."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import timedelta
from typing import Any, TypeVar, cast

import torch
import torch.distributed as dist
from torch import Tensor

from lpn.core.errors import InputError, LPNError
from lpn.models.checkpoints import best_device

T = TypeVar("T")

_PATIENCE = timedelta(days=1)
"""How long processes wait for the first, which tests alone; where one dies, torchrun ends the others at once."""


@dataclass(frozen=True)
class ProcessGroup:
    """The processes of one training.

    Attributes:
        device: what this process computes on.
        rank, size: this process's number, 0 for the one that prints and writes, and how many there are.
        local_size: how many of them share this machine.
    """

    device: torch.device
    rank: int = 0
    size: int = 1
    local_size: int = 1

    @property
    def leads(self) -> bool:
        """Whether this process prints, tests, and writes."""
        return self.rank == 0

    def share(self, batch: int) -> slice:
        """Which rows of every batch are this process's.

        Raises:
            InputError: when the batch cannot be shared evenly, or leaves a process fewer than the two BatchNorm needs.
        """
        each, rest = divmod(batch, self.size)
        if rest or each < 2:
            raise InputError(
                f"A batch of {batch} places cannot be shared by {self.size} processes; set --batch to a multiple of "
                f"{self.size}, at least {2 * self.size}."
            )
        return slice(self.rank * each, (self.rank + 1) * each)

    def gather(self, outputs: Mapping[str, tuple[Tensor, Tensor]]) -> dict[str, tuple[Tensor, Tensor]]:
        """The outputs of all processes in the order of the batch: of each pair (b, ...), all (b size, ...).

        Every process computes the loss of the whole batch from them. Its gradient reaches the process's own rows alone,
        times `size`, so that DistributedDataParallel's mean over processes is the gradient of that loss.
        """
        if self.size == 1:
            return dict(outputs)
        flat = [tensor.float().flatten(1) for pair in outputs.values() for tensor in pair]
        rows = cast(Tensor, _Gather.apply(torch.cat(flat, 1), self))  # type: ignore[no-untyped-call]
        columns = iter(torch.split(rows, [tensor.shape[1] for tensor in flat], 1))
        return {
            name: cast("tuple[Tensor, Tensor]", tuple(next(columns).reshape(-1, *own.shape[1:]) for own in pair))
            for name, pair in outputs.items()
        }

    def together(self, work: Callable[[], T]) -> T:
        """What each process does for itself before the first step.

        Where it fails, one of those it failed for says why, and all leave.

        Raises:
            LPNError: that of `work`, in the first process it failed for.
            SystemExit: in the others.
        """
        if self.size == 1:
            return work()
        failure: LPNError | None = None
        result: list[T] = []
        try:
            result.append(work())
        except LPNError as error:
            failure = error
        heard: list[Any] = [None] * self.size
        dist.all_gather_object(heard, failure is not None)
        if True in heard:
            raise self.said_once(failure, heard.index(True))
        return result[0]

    def said_once(self, error: LPNError | None, rank: int = 0) -> BaseException:
        """What to raise for an error all processes have met: the error in one, a silent exit in the others."""
        return error if error is not None and rank == self.rank else SystemExit(2)

    def led(self, work: Callable[[], T]) -> T:
        """What the first process alone does, and all get the result of; the others wait."""
        if self.size == 1:
            return work()
        box: list[Any] = [work() if self.leads else None]
        dist.broadcast_object_list(box, src=0)
        return cast(T, box[0])

    @contextmanager
    def watch(self) -> Iterator[None]:
        """Turn the loss of another process into a sentence.

        Raises:
            LPNError: when another process has stopped.
        """
        try:
            yield
        except RuntimeError as error:
            lost = isinstance(error, dist.DistError) or any(
                word in str(error) for word in ("gloo", "NCCL", "Connection")
            )
            if self.size == 1 or not lost:
                raise
            raise LPNError(f"Process {self.rank} stops, because another one stopped; that one says why.") from error

    def leave(self) -> None:
        """Take the group apart after a training that went well."""
        if self.size > 1:
            dist.destroy_process_group()


def alone() -> ProcessGroup:
    """A group of this process only, on the GPU where there is one."""
    return ProcessGroup(best_device())


def join() -> ProcessGroup:
    """The group in which `torchrun` started this process, else `alone`.

    Raises:
        InputError: when there are more processes than GPUs, or the group cannot be formed.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or "RANK" not in os.environ:
        return alone()
    rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    local_rank, local_size = (int(os.environ.get(f"LOCAL_{key}", "0")) for key in ("RANK", "WORLD_SIZE"))
    device = best_device()
    if device.type == "cuda":
        if local_rank >= torch.cuda.device_count():
            raise InputError(
                f"There are {local_size} processes for {torch.cuda.device_count()} GPUs; start torchrun with at most that "
                "many by --nproc-per-node."
            )
        device = torch.device("cuda", local_rank)
        torch.cuda.set_device(device)
    try:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=_PATIENCE)
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"The processes of the training do not find each other ({error}); start it by torchrun."
        ) from error
    return ProcessGroup(device, rank, size, max(local_size, 1))


class _Gather(torch.autograd.Function):
    """Rows of all processes; backwards, the rows of this one, times the number of processes."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, group: ProcessGroup) -> Tensor:
        ctx.group = group
        rows = rows.contiguous()
        heard = [torch.empty_like(rows) for _ in range(group.size)]
        dist.all_gather(heard, rows)
        return torch.cat(heard)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        group: ProcessGroup = ctx.group
        return gradients[0].chunk(group.size)[group.rank] * group.size, None
