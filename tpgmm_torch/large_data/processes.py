"""Several processes that learn one model: what they have to tell each other.

Each process sees its own share of the data; sums over all points are added up between them.
The processes are those of ``torch.distributed``'s default group, on one machine or many.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from numbers import Integral
from typing import Any

import numpy as np
import torch
from sklearn.utils import check_random_state
from torch import Tensor
from torch import distributed as dist

from tpgmm_torch.exceptions import DataError, DistributedError

__all__ = ["ALONE", "GroupOfProcesses", "Processes", "common_random_state", "joined_processes"]

#: How long a process waits for the others before it gives up.
PATIENCE = timedelta(minutes=30)


class Processes:
    """One process alone: there is nobody to talk to.

    Attributes
    ----------
    rank : int
        Number of this process, from 0.
    count : int
        How many there are.

    Examples
    --------
    >>> Processes().share(["a", "b", "c"])
    ['a', 'b', 'c']
    """

    rank = 0
    count = 1

    def sum(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Add float64 tensors of equal shapes over all processes.

        Parameters
        ----------
        *tensors : Tensor
            They are not changed.

        Returns
        -------
        tuple of Tensor
            To the last bit the same in every process.

        Raises
        ------
        DistributedError
            If a process has died, or does not answer.
        """
        return tensors

    def concatenate(self, values: Tensor) -> Tensor:
        """Put together, in order of the processes, what each has along the first axis.

        Parameters
        ----------
        values : Tensor of shape (n, ...)
            In float64; n may differ between processes.

        Returns
        -------
        Tensor of shape (sum of n, ...)

        Raises
        ------
        DistributedError
            If a process has died, or does not answer.
        """
        return values

    def texts(self, text: str) -> list[str]:
        """What each process says, in their order.

        Raises
        ------
        DistributedError
            If a process has died, or does not answer.
        """
        content = text.encode()
        codes = torch.tensor(list(content), dtype=torch.float64)
        size = torch.tensor([len(content)], dtype=torch.float64)
        lengths = [int(length) for length in self.concatenate(size)]
        everything = bytes(self.concatenate(codes).to(torch.uint8).tolist())
        ends = np.cumsum(lengths)
        return [
            everything[end - n : end].decode() for n, end in zip(lengths, ends, strict=True)
        ]

    def share[T](self, items: Sequence[T]) -> list[T]:
        """The consecutive part of ``items`` that is this process's, equal up to one.

        Raises
        ------
        DataError
            If there are fewer items than processes.
        """
        if len(items) < self.count:
            raise DataError(
                f"{len(items)} episodes or batches cannot be shared among {self.count} "
                "processes: start at most as many processes"
            )
        start, stop = (len(items) * rank // self.count for rank in (self.rank, self.rank + 1))
        return list(items[start:stop])


#: What ``fit`` uses by default.
ALONE = Processes()


class GroupOfProcesses(Processes):
    """The processes of ``torch.distributed``'s default group.

    Raises
    ------
    DistributedError
        If there is no such group.
    """

    def __init__(self) -> None:
        if not (dist.is_available() and dist.is_initialized()):
            raise DistributedError(
                "there is no process group: start with torchrun and use "
                "joined_processes(), or call torch.distributed.init_process_group() first"
            )
        self.rank, self.count = dist.get_rank(), dist.get_world_size()
        nccl = dist.get_backend() == "nccl"
        self._device = torch.device("cuda", torch.cuda.current_device()) if nccl else "cpu"

    def sum(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Add by one all-reduce."""
        packed = torch.cat([tensor.double().flatten() for tensor in tensors]).to(self._device)
        _speak(lambda: dist.all_reduce(packed))
        parts = packed.split([tensor.numel() for tensor in tensors])
        return tuple(
            part.view(tensor.shape).to(tensor.device)
            for part, tensor in zip(parts, tensors, strict=True)
        )

    def concatenate(self, values: Tensor) -> Tensor:
        """Put together by adding what each process writes into its own place."""
        lengths = torch.zeros(self.count, dtype=torch.float64)
        lengths[self.rank] = len(values)
        (lengths,) = self.sum(lengths)
        ends = lengths.cumsum(0).long().tolist()
        whole = values.new_zeros((ends[-1], *values.shape[1:]), dtype=torch.float64)
        whole[ends[self.rank] - len(values) : ends[self.rank]] = values
        (whole,) = self.sum(whole)
        return whole


def _speak(exchange: Callable[[], object]) -> None:
    try:
        exchange()
    except RuntimeError as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DistributedError(
            "another process of this job has stopped or does not answer, and the model cannot "
            f"be learned without its data: look for its own message ({reason})"
        ) from error


def common_random_state(seed: Any, processes: Processes) -> np.random.RandomState:
    """A random state that draws the same numbers in all processes.

    Parameters
    ----------
    seed : int, RandomState or None
        As scikit-learn takes it; what is not the same everywhere is taken from process 0.
    processes : Processes
    """
    if processes.count == 1 or isinstance(seed, Integral):
        return check_random_state(seed)
    own = float(check_random_state(seed).randint(2**31)) if processes.rank == 0 else 0.0
    (common,) = processes.sum(torch.tensor(own, dtype=torch.float64))
    return check_random_state(int(common))


@contextmanager
def joined_processes(device: str = "cpu", timeout: timedelta = PATIENCE) -> Iterator[Processes]:
    """The processes that ``torchrun`` started; this one alone if it started none.

    A default process group that exists already is used, and left as it is. Otherwise one is
    made from the environment that torchrun sets, and ended with the block.

    Parameters
    ----------
    device : str, default="cpu"
        "cuda" talks by nccl, each process with the GPU of its local rank; else by gloo.
    timeout : timedelta, default=30 minutes
        How long a process waits for the others, for example while they read their data.

    Yields
    ------
    Processes

    Raises
    ------
    DistributedError
        If the processes cannot reach each other.

    Examples
    --------
    >>> with joined_processes() as processes:
    ...     print(processes.rank, processes.count)
    0 1
    """
    if dist.is_available() and dist.is_initialized():
        yield GroupOfProcesses()
        return
    if not dist.is_available() or int(os.environ.get("WORLD_SIZE", "1")) == 1:
        yield ALONE
        return
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    _speak(lambda: dist.init_process_group("nccl" if on_gpu else "gloo", timeout=timeout))
    try:
        yield GroupOfProcesses()
    finally:
        dist.destroy_process_group()
