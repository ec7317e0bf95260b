"""Demonstrations without those that are unlike the others, as the operators see them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tpgmm_datasets.checks.check import PACKAGE
from tpgmm_torch.checks.report import Report
from tpgmm_torch.data.demonstrations import Demonstration, check_demonstrations
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.operators import Operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.mean_orientations import with_mean_orientations
from tpgmm_torch.training.mixture_settings import check_operators, kinematics_for
from tpgmm_torch.training.outlying_demonstrations import left_out, outlying_demonstrations

__all__ = ["drop_outliers"]


def drop_outliers(
    demonstrations: Iterable[Demonstration],
    operators: Sequence[Operator],
    robot: Kinematics | None = None,
    holds: Sequence[Hold] = (),
) -> list[Demonstration]:
    """Leave out demonstrations that are far from the median where all others agree.

    A frame that was seen in a wrong place, or at a wrong time, widens the covariances of those
    very instants that the skill is about. See
    :func:`~tpgmm_torch.training.outlying_demonstrations.outlying_demonstrations` for the rule.

    Parameters
    ----------
    demonstrations : iterable of Demonstration
        Aligned. Of fewer than five none is left out, nor where it would be more than a third.
    operators : sequence of Operator
        What is learned.
    robot : Kinematics, optional
        As of the estimator.
    holds : sequence of Hold, default=()
        Objects that the robot held.

    Returns
    -------
    list of Demonstration
        The others, in their order.

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If demonstrations do not fit together, or with operators and robot.

    Warns
    -----
    PlausibilityWarning
        Once, with those that are left out, and where they are unlike the others.
    """
    known = check_demonstrations(demonstrations)
    checked = check_operators(operators)
    kinematics = kinematics_for(known, checked, robot, "float64", "cpu")
    based = with_mean_orientations(checked, known, kinematics, holds)
    outlying = outlying_demonstrations(known, based, kinematics, holds)
    if outlying:
        finding = left_out(outlying, len(known))
        Report.of([finding], f"{len(known)} demonstrations").act(packages=(PACKAGE,))
    odd = {one.episode for one in outlying}
    return [one for index, one in enumerate(known) if index not in odd]
