"""Distributed training by the processes that `torchrun` starts, one for each GPU."""

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
Tensors = TypeVar("Tensors", bound=tuple[Tensor, ...])

# Processes wait while the leader tests. If one dies, torchrun ends the others at once.
_TIMEOUT = timedelta(days=1)


@dataclass(frozen=True)
class ProcessGroup:
    """The processes of one training; a training without torchrun is a group of one.

    Attributes:
        device: the device of this process.
        rank: number of this process; 0 is the leader, which prints, tests, and writes.
        size: number of processes.
        local_size: number of processes on this machine.
    """

    device: torch.device
    rank: int = 0
    size: int = 1
    local_size: int = 1

    @property
    def is_leader(self) -> bool:
        """True for the process that prints, tests, and writes."""
        return self.rank == 0

    def share(self, batch: int) -> slice:
        """Select this process's rows of every batch.

        Raises:
            InputError: when the batch is not divisible, or a process gets fewer than the two rows that BatchNorm needs.
        """
        each, remainder = divmod(batch, self.size)
        if remainder or each < 2:
            raise InputError(
                f"A batch of {batch} places cannot be shared by {self.size} processes; set --batch to a multiple of "
                f"{self.size}, at least {2 * self.size}."
            )
        return slice(self.rank * each, (self.rank + 1) * each)

    def gather(self, outputs: Mapping[str, Tensors]) -> dict[str, Tensors]:
        """Gather the outputs of all processes in the order of the batch: each tensor (b, ...) becomes (b size, ...).

        The rows of a place stand together if a view has several pictures of each place.

        Every process computes the loss of the whole batch from them. The gradient flows into the process's own rows only,
        multiplied by `size`, so that DistributedDataParallel's mean over processes is the gradient of that loss.
        """
        if self.size == 1:
            return dict(outputs)
        every = [tensor for tensors in outputs.values() for tensor in tensors]
        places = min(map(len, every))
        flat = [tensor.float().reshape(places, -1) for tensor in every]
        rows = cast(Tensor, _Gather.apply(torch.cat(flat, 1), self))  # type: ignore[no-untyped-call]
        columns = iter(torch.split(rows, [tensor.shape[1] for tensor in flat], 1))
        return {
            name: cast(Tensors, tuple(next(columns).reshape(-1, *own.shape[1:]) for own in tensors))
            for name, tensors in outputs.items()
        }

    def run_on_all(self, work: Callable[[], T]) -> T:
        """Run work in every process before the first step; if it fails in one, all exit and one reports the error.

        Raises:
            LPNError: the error of `work`, in the first process it failed in.
            SystemExit: in the other processes.
        """
        if self.size == 1:
            return work()
        failure: LPNError | None = None
        result: list[T] = []
        try:
            result.append(work())
        except LPNError as error:
            failure = error
        failed: list[Any] = [None] * self.size
        dist.all_gather_object(failed, failure is not None)
        if True in failed:
            raise self.error_once(failure, failed.index(True))
        return result[0]

    def error_once(self, error: LPNError | None, rank: int = 0) -> BaseException:
        """Return `error` in the process `rank`, and a silent SystemExit in all others, to be raised."""
        return error if error is not None and rank == self.rank else SystemExit(2)

    def run_on_leader(self, work: Callable[[], T]) -> T:
        """Run work in the leader while the others wait, and return its result in every process.

        Raises:
            LPNError: the error of `work`, in the leader.
            SystemExit: in the other processes then.
        """
        if self.size == 1:
            return work()
        failure: LPNError | None = None
        box: list[Any] = [None, False]
        if self.is_leader:
            try:
                box[0] = work()
            except LPNError as error:
                failure, box[1] = error, True
        dist.broadcast_object_list(box, src=0)
        if box[1]:
            raise self.error_once(failure)
        return cast(T, box[0])

    @contextmanager
    def report_lost_process(self) -> Iterator[None]:
        """Turn the loss of another process into one sentence.

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
            raise LPNError(
                f"Process {self.rank} stops because another process stopped; see the message of that process."
            ) from error

    def leave(self) -> None:
        """Leave the group after a successful training."""
        if self.size > 1:
            dist.destroy_process_group()


def single_process() -> ProcessGroup:
    """Make a group of this process only, on the GPU if there is one."""
    return ProcessGroup(best_device())


def join() -> ProcessGroup:
    """Join the group in which `torchrun` started this process, or make a group of one.

    Raises:
        InputError: when there are more processes than GPUs, or the group cannot be formed.
    """
    if int(os.environ.get("WORLD_SIZE", "1")) == 1 or "RANK" not in os.environ:
        return single_process()
    rank, size = int(os.environ["RANK"]), int(os.environ["WORLD_SIZE"])
    local_rank, local_size = (int(os.environ.get(f"LOCAL_{key}", "0")) for key in ("RANK", "WORLD_SIZE"))
    device = best_device()
    if device.type == "cuda":
        if local_rank >= torch.cuda.device_count():
            raise InputError(
                f"There are {local_size} processes for {torch.cuda.device_count()} GPUs; give torchrun at most "
                f"--nproc-per-node {torch.cuda.device_count()}."
            )
        device = torch.device("cuda", local_rank)
        torch.cuda.set_device(device)
    try:
        dist.init_process_group("nccl" if device.type == "cuda" else "gloo", timeout=_TIMEOUT)
    except (ValueError, RuntimeError) as error:
        raise InputError(
            f"The processes of the training cannot connect to each other ({error}); start them with torchrun."
        ) from error
    return ProcessGroup(device, rank, size, max(local_size, 1))


class _Gather(torch.autograd.Function):
    """All-gather of rows, whose backward pass keeps the process's own rows times the number of processes."""

    @staticmethod
    def forward(ctx: Any, rows: Tensor, group: ProcessGroup) -> Tensor:
        ctx.group = group
        rows = rows.contiguous()
        gathered = [torch.empty_like(rows) for _ in range(group.size)]
        dist.all_gather(gathered, rows)
        return torch.cat(gathered)

    @staticmethod
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor, None]:
        group: ProcessGroup = ctx.group
        return gradients[0].chunk(group.size)[group.rank] * group.size, None
