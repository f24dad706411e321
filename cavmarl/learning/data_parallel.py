"""`Ranks`: the processes of one training, which learn one network from their own worlds.

`torchrun` starts the processes. Each process collects data in its share of the worlds; before each
step of the optimiser, all processes average their gradients (data-parallel training, Li et al.
2020). So all processes have the same weights.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, Self, TypeVar

import torch
from torch import Tensor, nn
from torch import distributed as dist

from cavmarl.core.errors import ConfigError, TrainingError
from cavmarl.core.processes import die_with_parent

T = TypeVar("T")


class Ranks:
    """The processes of a training that `torchrun` has started, or this process alone.

    All processes must call the same methods in the same order. If this process is alone, the
    methods exchange nothing.

    Args:
        size: number of processes.
        rank: number of this process; process 0 writes all files.
    """

    def __init__(self, size: int = 1, rank: int = 0) -> None:
        self.size, self.rank = size, rank

    @classmethod
    def of_torchrun(cls) -> Self:
        """Return the processes that `torchrun` has started; without it, this process alone."""
        if not (dist.is_available() and dist.is_torchelastic_launched()):
            return cls()
        return cls(int(os.environ["WORLD_SIZE"]), int(os.environ["RANK"]))

    def __enter__(self) -> Self:
        """Connect the processes."""
        if self.size > 1:
            if torch.cuda.is_available():
                torch.cuda.set_device(int(os.environ["LOCAL_RANK"]) % torch.cuda.device_count())
            die_with_parent()  # `torchrun` may be killed
            with _connected():
                dist.init_process_group("gloo")
        return self

    def __exit__(self, *_: object) -> None:
        if self.size > 1:
            dist.destroy_process_group()

    def share(self, option: str, count: int) -> int:
        """Return the number of things per process if `count` things are divided equally.

        Raises:
            ConfigError: `count` is not a multiple of the number of processes.
        """
        if count % self.size:
            raise ConfigError(
                f"{option} {count}: cannot be divided equally among {self.size} processes; give a "
                f"multiple of {self.size}, or another --nproc-per-node to torchrun"
            )
        return count // self.size

    def gather(self, mine: T) -> list[T]:
        """Return the argument of each process, by rank."""
        found: list[T] = [mine] * self.size
        if self.size > 1:
            with _connected():
                dist.all_gather_object(found, mine)
        return found

    def gather_in_first(self, mine: T) -> list[T]:
        """Return the argument of each process in process 0, and an empty list in the others."""
        if self.size == 1:
            return [mine]
        found: list[Any] = [None] * self.size
        with _connected():
            dist.gather_object(mine, found if self.rank == 0 else None)
        return found if self.rank == 0 else []

    def of_first(self, mine: T) -> T:
        """Return the argument of process 0."""
        return self.gather(mine)[0]

    def copy_weights(self, network: nn.Module) -> None:
        """Copy the weights of process 0 to all processes; initial weights may differ."""
        if self.size > 1:
            self._reduce([*network.parameters()], lambda flat: dist.broadcast(flat, 0))

    def average_gradients(self, network: nn.Module, count: int) -> bool:
        """Average the gradients over all decisions; `count`: number in this process, or 0.

        Return whether there are any decisions.
        """
        if self.size == 1:
            return count > 0
        parameters = [*network.parameters()]
        with torch.no_grad():
            for each in parameters:
                each.grad = torch.zeros_like(each) if each.grad is None else each.grad * count
        total = torch.tensor([float(count)])
        gradients = [each.grad for each in parameters if each.grad is not None]
        self._reduce([*gradients, total], dist.all_reduce)
        for gradient in gradients:
            gradient /= max(float(total), 1.0)
        return bool(total > 0.0)

    def _reduce(self, tensors: list[Tensor], act: Callable[[Tensor], object]) -> None:
        """Apply `act` to all values of the tensors at once."""
        with torch.no_grad(), _connected():
            flat = torch.cat([each.detach().flatten().cpu() for each in tensors])
            act(flat)
            parts = torch.split(flat, [*map(torch.numel, tensors)])
            for each, values in zip(tensors, parts, strict=True):
                each.copy_(values.view_as(each))


ALONE = Ranks()


@contextmanager
def _connected() -> Iterator[None]:
    """Raise a TrainingError if another process has ended or cannot be reached."""
    try:
        yield
    except RuntimeError as error:
        raise TrainingError(
            f"another process of this training has ended or cannot be reached ("
            f"{str(error).strip().partition(chr(10))[0]}); its own message says why. Start all "
            "processes again with --resume FOLDER"
        ) from error
