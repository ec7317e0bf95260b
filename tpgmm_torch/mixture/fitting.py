"""How a mixture is learned from rows: its units, the family it belongs to, and its starts.

The folds of a cross-validation share the passes over the rows: :func:`learn_subsets`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import torch
from numpy.random import RandomState
from numpy.typing import NDArray

from tpgmm_torch.em.ascent import Run, ascend
from tpgmm_torch.em.block_gaussians import Family, Parameters, Standardization, check_blocks
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.em.points import Subset
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.large_data.processes import ALONE, Processes, common_random_state
from tpgmm_torch.large_data.row_batches import Rows
from tpgmm_torch.large_data.row_points import RowPoints
from tpgmm_torch.mixture.checkpoints import Checkpoint, Purpose
from tpgmm_torch.mixture.initial_parameters import GivenStart
from tpgmm_torch.mixture.initialization import StartDrawer, check_distinct

__all__ = ["Learning", "learn_subsets"]


@dataclass(frozen=True)
class Learning:
    """A mixture that is to be learned.

    Parameters
    ----------
    settings : mapping of str to object
        Parameters of :class:`BlockGaussianMixture`.
    known : tuple
        Weights, means and covariances of the start as far as they are given, or None.
    rows : Rows
        Of this process.
    moments : ColumnMoments
        Of the rows of all processes.
    processes : Processes

    Raises
    ------
    ShapeError, DataError
        Where one is asked for what does not fit the rows.
    """

    settings: Mapping[str, Any]
    known: tuple[Any, Any, Any]
    rows: Rows
    moments: ColumnMoments
    processes: Processes = ALONE

    @cached_property
    def units(self) -> Standardization:
        """The units of the columns in which it is learned."""
        if self.moments.count < 2:
            raise DataError("the data hold 1 sample; a mixture is learned from at least 2")
        size = self.settings["group_size"]
        if self.rows.n_rows % size:
            raise ShapeError(f"{self.rows.n_rows} rows are no multiple of group_size={size}")
        units = self.moments.standardization(
            check_blocks(self.settings["blocks"], len(self.moments.mean)),
            isotropic=self.settings["covariance_type"] == "spherical",
        )
        return units.to(torch.device(self.settings["device"]))

    @cached_property
    def family(self) -> Family:
        """What is admitted, in those units."""
        return Family.regularized(
            self.settings["covariance_type"],
            self.units,
            self.settings["reg_covar"],
            relative=self.settings["regularization"] == "relative",
            dtype=getattr(torch, self.settings["dtype"]),
        )

    def runs(self, checkpoint: Checkpoint | None = None) -> list[Run]:
        """One per start, each at its end; from a checkpoint on where there is one."""
        points = self.points()
        runs, after = None, None
        if checkpoint is not None:
            purpose = Purpose.of(self._shaping(), self.settings["reg_covar"], self.moments)
            runs = checkpoint.resume(purpose, self.processes)
            after = checkpoint.keeper(purpose, self.settings["max_iter"], self.processes)
        if runs is None:
            runs = self.starts()
        source = points.stored() if self.rows.in_memory else points
        ascend(runs, source, self.family, after=after, **self.climbing)
        return runs

    def points(self) -> RowPoints:
        """The rows, standardised."""
        column, first = self.settings["time_feature"], self.units.shifts[0]
        return RowPoints(
            self.rows,
            self.rows.n_rows,
            self.units,
            self.settings["n_components"],
            getattr(torch, self.settings["dtype"]),
            group_size=self.settings["group_size"],
            processes=self.processes,
            time_feature=column if column < len(first) else None,
        )

    def starts(self) -> list[Run]:
        """Where it is learned from, drawn as far as it is not given."""
        count, units, settings = self.settings["n_components"], self.units, self.settings
        widths = tuple(len(shift) for shift in units.shifts)
        given = GivenStart.checked(*self.known, count, widths).standardize(units)
        drawer = StartDrawer(
            settings["init_params"], settings["time_feature"], count, self.rows,
            self.moments.count, units, settings["group_size"], self.processes,
        )  # fmt: skip
        check_distinct(self.rows, self.moments.count, count, self.processes)
        rng = common_random_state(settings["random_state"], self.processes)
        drawn = (
            [Parameters.standard(count, widths, units.shifts[0].device)]
            if given.complete
            else drawer.draw(settings["n_init"], self.family, rng)
        )
        return [
            Run(self.family.admit(given.over(start)), RandomState(rng.randint(2**31 - 1)))
            for start in drawn
        ]

    @property
    def climbing(self) -> dict[str, Any]:
        """The settings of :func:`ascend`."""
        names = ("tol", "max_iter", "group_size", "verbose")
        return {name: self.settings[name] for name in names}

    def _shaping(self) -> dict[str, Any]:
        """The settings that a checkpoint has to share, but the regularisation."""
        names = (
            "n_components", "covariance_type", "tol", "regularization", "n_init", "init_params",
            "time_feature", "group_size", "random_state", "dtype",
        )  # fmt: skip
        return {name: self.settings[name] for name in names} | {
            "blocks": tuple(len(shift) for shift in self.units.shifts),
            "start": [None if part is None else list(part) for part in self.known],
        }


def learn_subsets(
    whole: Learning, parts: Sequence[Learning], members: NDArray[Any]
) -> list[list[Run]]:
    """Learn several mixtures, each from its own rows, in passes over all rows that they share.

    What comes out is what each would learn alone, to rounding: each has its own regularisation
    and its own starts, and only the units are common.

    Parameters
    ----------
    whole : Learning
        Of all rows, in this process alone and in memory.
    parts : sequence of Learning
        Of some of the rows each, with the settings of ``whole`` but for their own
        regularisation and ``group_size``: how many of each group they have.
    members : array of bool, of shape (S, n_rows)
        Which rows those are.

    Returns
    -------
    list of list of Run
        Those of each part, in the units of ``whole``.
    """
    units, source = whole.units, whole.points()
    points, numbers = source.stored(), source.numbers()
    found, families, subsets = [], [], []
    for part, chosen in zip(parts, members, strict=True):
        runs = part.starts()
        for run in runs:
            run.parameters = units.standardize(part.units.restore(run.parameters))
        subset = Subset(points, torch.from_numpy(chosen[numbers]), part.settings["group_size"])
        found.append(runs)
        families += [part.family.rescaled(part.units, units)] * len(runs)
        subsets += [subset] * len(runs)
    together = [run for runs in found for run in runs]
    ascend(together, points, families, subsets=subsets, **whole.climbing)
    return found
