"""The local data of demonstrations that a model goes on to learn with."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.large_data.row_batches import StoredRows
from tpgmm_torch.training.local_data import constant_columns
from tpgmm_torch.training.training_rows import LearningRows

__all__ = ["KeptRows"]


@dataclass(frozen=True, eq=False)
class KeptRows:
    """Rows of each demonstration, from which a mixture can be learned again.

    Parameters
    ----------
    rows : tuple of array of shape (T_m, sum_j (1 + D_j))
        Of each demonstration.
    first : tuple of int
        At which instant of the common grid each begins; 0 where there is none.
    numbers : tuple of int
        Which demonstrations of all these are.
    n_instants : int
        Of the common grid, at each of which demonstrations share a responsibility; 0 where
        each point has its own.
    """

    rows: tuple[NDArray[np.floating], ...]
    first: tuple[int, ...]
    numbers: tuple[int, ...]
    n_instants: int

    @classmethod
    def of(cls, learning: LearningRows, lengths: Sequence[int], numbers: Sequence[int]) -> Self:
        """Of rows in memory, without a copy.

        Parameters
        ----------
        learning : LearningRows
        lengths : sequence of int
            Time steps of each demonstration.
        numbers : sequence of int
            Which demonstrations these are.
        """
        assert isinstance(learning.rows, StoredRows)
        together, size = learning.rows.rows, len(lengths)
        grouped = learning.group_size == size and len(set(lengths)) == 1
        if grouped:
            rows = tuple(together[m::size] for m in range(size))
        else:
            rows = tuple(np.split(together, np.cumsum(lengths)[:-1]))
        return cls(rows, (0,) * size, tuple(numbers), lengths[0] if grouped else 0)

    @property
    def n_bytes(self) -> int:
        """What they take in memory."""
        return sum(rows.nbytes for rows in self.rows)

    def without(self, numbers: Collection[int]) -> Self:
        """Without some demonstrations, by their ``numbers``."""
        left = [i for i, number in enumerate(self.numbers) if number not in numbers]
        return replace(
            self,
            rows=tuple(self.rows[i] for i in left),
            first=tuple(self.first[i] for i in left),
            numbers=tuple(self.numbers[i] for i in left),
        )

    def and_also(
        self, rows: Sequence[NDArray[np.floating]], first: Sequence[int], number: int
    ) -> Self:
        """With more demonstrations, which are counted from ``number`` on.

        Parameters
        ----------
        rows, first
            As in the class.
        number : int
        """
        return replace(
            self,
            rows=(*self.rows, *rows),
            first=(*self.first, *first),
            numbers=(*self.numbers, *range(number, number + len(rows))),
        )

    def table(
        self, widths: Sequence[int], turns: Sequence[bool], like: torch.Tensor
    ) -> tuple[Array, NDArray[np.bool_], int]:
        """All rows, which of them count, and how many share a responsibility.

        Where a demonstration is no whole one, what it does not show does not count.

        Parameters
        ----------
        widths : sequence of int
            ``1 + D_j`` of each operator.
        turns : sequence of bool
            For each operator, whether there are rotation vectors among its coordinates.
        like : Tensor
            Of the model's precision, which says what varies by rounding alone.

        Raises
        ------
        DataError
            If nothing is left of the demonstrations, at some instant.
        """
        if not self.rows:
            raise DataError("no demonstration is left to learn from")
        if not self.n_instants:
            table, group = np.concatenate(self.rows), 1
            members = np.ones(len(table), dtype=bool)
        else:
            group, n = len(self.rows), self.n_instants
            counts = np.zeros((n, group), dtype=bool)
            grid = np.empty((n, group, self.rows[0].shape[1]))
            for m, (rows, first) in enumerate(zip(self.rows, self.first, strict=True)):
                counts[first : first + len(rows), m] = True
                grid[:, m] = rows[np.clip(np.arange(n) - first, 0, len(rows) - 1)]
            if not counts.any(1).all():
                raise DataError(
                    f"at {int((~counts.any(1)).sum())} of {n} instants no demonstration is "
                    "left: forget fewer"
                )
            table, members = grid.reshape(n * group, -1), counts.ravel()
        known = torch.from_numpy(table[members]).to(like)
        constant = constant_columns(known.amin(0), known.amax(0), widths, turns).cpu().numpy()
        table[:, constant] = table[np.flatnonzero(members)[0], constant]
        return table, members, group
