"""Several processes that learn one model: sums over all data are added up between them.

Each process has its own share of the data. The processes are those of ``torch.distributed``'s
default group, on one machine or many.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import timedelta
from typing import Any

import torch
from torch import Tensor
from torch import distributed as dist

from tpgmm_torch.exceptions import DataError, DistributedError

__all__ = ["joined_processes"]


class Processes:
    """The processes that learn together; by default this one alone.

    With several, each exchange raises a :class:`~tpgmm_torch.exceptions.DistributedError` if a
    process has died, or does not answer.

    Parameters
    ----------
    together : bool, default=False
        Whether they are those of ``torch.distributed``'s default group, which has to exist.

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

    def __init__(self, *, together: bool = False) -> None:
        self.rank, self.count = (dist.get_rank(), dist.get_world_size()) if together else (0, 1)

    def sum(self, *tensors: Tensor) -> tuple[Tensor, ...]:
        """Add float64 tensors of equal shapes over all processes, by one all-reduce.

        Parameters
        ----------
        *tensors : Tensor
            They are not changed.

        Returns
        -------
        tuple of Tensor
            To the last bit the same in every process.
        """
        if self.count == 1:
            return tensors
        packed = torch.cat([tensor.double().flatten() for tensor in tensors])
        packed = packed.to("cuda" if dist.get_backend() == "nccl" else "cpu")
        _exchange(lambda: dist.all_reduce(packed))
        parts = packed.split([tensor.numel() for tensor in tensors])
        return tuple(p.view(t.shape).to(t.device) for p, t in zip(parts, tensors, strict=True))

    def gather(self, value: Any) -> list[Any]:
        """Gather the values of all processes, in their order: what pickle can carry."""
        values: list[Any] = [value] * self.count
        if self.count > 1:
            _exchange(lambda: dist.all_gather_object(values, value))
        return values

    @staticmethod
    def check_share(shares: Sequence[Any], what: str) -> None:
        """Refuse that a process has none of the data, or nobody has.

        Parameters
        ----------
        shares : sequence
            Something true of each process that has some.
        what : str
            How the error message calls the data.

        Raises
        ------
        DataError
            If there is none; the message says in which process.
        """
        if empty := [rank for rank, share in enumerate(shares) if not share]:
            where = f" in process(es) {empty} of {len(shares)}" if len(shares) > 1 else ""
            raise DataError(
                f"there are no {what}s, X is empty{where}: expected at least one {what}"
            )

    def share[T](self, items: Sequence[T]) -> list[T]:
        """Select this process's consecutive part of ``items``, equal up to one.

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


def _exchange(collective: Callable[[], object]) -> None:
    try:
        collective()
    except RuntimeError as error:
        reason = (str(error).splitlines() or [type(error).__name__])[0]
        raise DistributedError(
            "another process of this job has stopped or does not answer, and the model cannot "
            f"be learned without its data: look for its own message ({reason})"
        ) from error


@contextmanager
def joined_processes(
    device: str = "cpu", timeout: timedelta = timedelta(minutes=30)
) -> Iterator[Processes]:
    """Join the processes that ``torchrun`` started; this one alone if it started none.

    A default process group that exists already is used, and left as it is. Otherwise one is
    made from the environment that torchrun sets, and ended with the block.

    Parameters
    ----------
    device : str, default="cpu"
        "cuda" exchanges by nccl, each process with the GPU of its local rank; else by gloo.
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
    existing = dist.is_available() and dist.is_initialized()
    if existing or not dist.is_available() or os.environ.get("WORLD_SIZE", "1") == "1":
        yield Processes(together=existing)
        return
    on_gpu = torch.device(device).type == "cuda"
    if on_gpu:
        torch.cuda.set_device(int(os.environ.get("LOCAL_RANK", "0")))
    _exchange(lambda: dist.init_process_group("nccl" if on_gpu else "gloo", timeout=timeout))
    try:
        yield Processes(together=True)
    finally:
        dist.destroy_process_group()
