"""Demonstrations of several processes, in a list or in batches larger than memory.

What is larger than memory, and what several processes learn together, is known here and to
:mod:`tpgmm_torch.mixture.processes` and :mod:`tpgmm_torch.mixture.row_file` alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import chain
from typing import Any

from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.processes import ALONE, Processes


class Share:
    """Demonstrations that this process learns from: checked, each read once.

    Parameters
    ----------
    X : iterable of Demonstration, or of sequence of Demonstration
        In one list, or in batches of a set that is larger than memory.
    processes : Processes
        Among which the demonstrations are spread.

    Attributes
    ----------
    first : list of Demonstration
        The first batch.
    in_memory : bool
        Whether these are all, of all processes.

    Raises
    ------
    DataError, ShapeError
        If some differ from those before in joints or frames, the message says in which batch;
        if a process has none, or of other joints or frames, the message says which.
    """

    def __init__(self, X: Any, processes: Processes = ALONE) -> None:
        self.processes, self._batches = processes, _check_batches(X)
        self.first = next(self._batches, [])
        self._check_alike()
        self._second = next(self._batches, [])
        self.in_memory = not self._second and processes.count == 1

    def read_rest(self) -> Iterator[Demonstration]:
        """Yield the demonstrations behind the first batch."""
        yield from chain(self._second, chain.from_iterable(self._batches))

    def _check_alike(self) -> None:
        """Refuse, in all processes, shares without demonstrations, or that differ."""
        text = ""
        for one in self.first[:1]:
            joints = list(one.joint_names or [f"{one.n_joints} without names"])
            text = f"joints {joints}, frames {sorted(one.frames)}"
        texts = self.processes.gather(text)
        self.processes.check_share(texts, "demonstration")
        for rank, other in enumerate(texts):
            if other != texts[0]:
                raise DataError(
                    f"process {rank} has demonstrations with {other}, process 0 with {texts[0]}"
                )


def _check_batches(X: Any) -> Iterator[list[Demonstration]]:
    """Check demonstrations batch by batch; a list of them is one batch."""
    first: list[Demonstration] = []
    for number, batch in enumerate(_split(X)):
        try:
            checked = check_demonstrations([*first, *batch])[len(first) :]
        except (ValueError, TypeError) as error:
            if number == 0:
                raise
            kind = type(error) if isinstance(error, DataError) else DataError
            raise kind(f"batch {number} of demonstrations: {error}") from error
        first = first or checked[:1]
        yield checked


def _split(X: Any) -> Iterator[Sequence[Demonstration]]:
    """Yield the batches of X, without empty ones; X itself if it holds demonstrations."""
    if not isinstance(X, Iterable):
        check_demonstrations(X)  # says what is wrong
    walk = iter(X)
    first = next(walk, None)
    if isinstance(first, Sequence):
        yield from (batch for batch in chain([first], walk) if len(batch))
    elif first is not None:
        yield list(chain([first], walk))
