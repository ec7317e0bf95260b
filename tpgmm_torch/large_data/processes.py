"""Several processes that learn one model: what they have to tell each other.

Each process sees its own share of the data; sums over all points are added up between them.
The processes are those of ``torch.distributed``'s default group, on one machine or many.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from numbers import Integral
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from sklearn.utils import check_random_state
from torch import Tensor
from torch import distributed as dist

from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import DataError, DistributedError

__all__ = [
    "ALONE",
    "GroupOfProcesses",
    "Processes",
    "column_moments",
    "common_random_state",
    "joined_processes",
]

#: How long a process waits for the others before it gives up.
PATIENCE = timedelta(minutes=30)


class Processes:
    """One process alone: there is nobody to talk to.

    With several, each exchange raises a :class:`~tpgmm_torch.exceptions.DistributedError` if a
    process has died, or does not answer.

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
        """
        return torch.cat(self.gather(values.cpu())) if self.count > 1 else values

    def gather(self, value: Any) -> list[Any]:
        """The values of all processes, in their order: texts, numbers, lists."""
        return [value]

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

    def gather(self, value: Any) -> list[Any]:
        """Gather what pickle can carry."""
        values: list[Any] = [None] * self.count
        _speak(lambda: dist.all_gather_object(values, value))
        return values


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
    """
    if processes.count == 1 or isinstance(seed, Integral):
        return check_random_state(seed)
    return check_random_state(processes.gather(check_random_state(seed).randint(2**31))[0])


def column_moments(
    rows: Iterable[NDArray[np.floating]], processes: Processes = ALONE
) -> ColumnMoments:
    """Moments of the columns of batches of rows, in all processes together.

    Parameters
    ----------
    rows : iterable of array of shape (n, n_features)
        The batches of this process.

    Raises
    ------
    DataError
        If there are no rows, here or in another process, if the processes' rows have
        different numbers of columns, or if the variance overflows.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        parts = [ColumnMoments.of(batch) for batch in rows]
        gathered = processes.gather(ColumnMoments.merge(parts) if parts else None)
        empty = [rank for rank, part in enumerate(gathered) if part is None]
        if empty:
            where = f" in process(es) {empty} of {processes.count}"
            raise DataError(f"there are no rows{where if processes.count > 1 else ''}")
        widths = [len(part.mean) for part in gathered]
        if len(set(widths)) > 1:
            raise DataError(
                f"the processes' rows have {widths} columns: all need the same ones"
            )
        total = ColumnMoments.merge(gathered)
    if not np.isfinite(total.scatter).all():
        raise DataError("the variance of the data overflows; divide the data by a constant")
    return total


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
