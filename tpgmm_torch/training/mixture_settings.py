"""Settings of the mixture, from the estimator's parameters, demonstrations and a robot."""

from __future__ import annotations

import math
from collections.abc import Sequence
from numbers import Real
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.mixture.row_file import ColumnMoments
from tpgmm_torch.operators import Canonical, Operator, Wrench
from tpgmm_torch.operators.base import leaves, of_joints
from tpgmm_torch.operators.stack import POSE_OPERATORS
from tpgmm_torch.robots.kinematics import JointSpace, Kinematics

#: Of these, equal ones say the same; of a user's own operators nobody knows.
COMPARED = (Canonical, Wrench, *POSE_OPERATORS)


def check_operators(operators: Any) -> tuple[Operator, ...]:
    """Check the operators; ``(Canonical(),)`` where none are given.

    Raises
    ------
    DataError
        If there are none, something else is among them, or one is there twice.
    """
    checked = (Canonical(),) if operators is None else tuple(operators)
    if not checked:
        raise DataError("operators is empty: give at least one, for example [Canonical()]")
    for operator in checked:
        if not isinstance(operator, Operator):
            raise DataError(f"operators holds Operator objects, got {operator!r}")
    _check_forces(checked)
    known = [leaf for leaf in leaves(checked) if type(leaf) in COMPARED]
    for number, leaf in enumerate(known):
        if leaf in known[:number]:
            raise DataError(f"operators has {leaf!r} twice: it would count twice")
    return checked


def _check_forces(checked: tuple[Operator, ...]) -> None:
    """Refuse forces that do not stand behind what says something of the joints."""
    joints = of_joints(checked)
    alone = all(leaf.constrains_joints for leaf in leaves(joints))
    if not joints or checked[: len(joints)] != joints or not alone:
        raise DataError(
            "Wrench() says nothing of the joints: it stands by itself, in no Stack, behind at "
            f"least one operator that does, got {list(checked)}"
        )


def kinematics_for(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    robot: Kinematics | None,
    dtype: str,
    device: str,
) -> Kinematics:
    """Choose the kinematics that the operators act on, and check what they need.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        At least one; they name the joints where there is no robot.
    operators : sequence of Operator
        In whose local coordinates it is seen.
    robot : Kinematics, optional
        Without it the joints alone, a :class:`~tpgmm_torch.robots.kinematics.JointSpace`.
    dtype, device : str
        In what precision and where it shall compute, as the estimator's parameters say.

    Raises
    ------
    DataError, UnknownNameError
        If the operators need links or frames that are not there.
    """
    needed = sorted({link for operator in operators for link in operator.links()})
    precision = getattr(torch, dtype)
    if robot is not None:
        kinematics = robot.to(precision, device)
    elif needed:
        raise DataError(
            f"the operators need the pose of {needed}: pass robot=Robot.from_urdf(...), or "
            "robot=Poses(...) for recorded poses without a robot"
        )
    else:
        default = tuple(f"joint_{index}" for index in range(demonstrations[0].n_joints))
        names = next((d.joint_names for d in demonstrations if d.joint_names), default)
        kinematics = JointSpace(names, precision, device)
    for operator in operators:
        operator.check(kinematics, demonstrations[0].frames)
    return kinematics


def block_widths(operators: Sequence[Operator], kinematics: Kinematics) -> tuple[int, ...]:
    """Compute 1 + D_j of each of the operators on the kinematics: time, and coordinates."""
    return tuple(1 + operator.dimension(kinematics) for operator in operators)


def regularization(
    moments: ColumnMoments,
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    reg_covar: float,
    covariance_type: str,
) -> NDArray[np.float64]:
    """Express ``reg_covar`` and tolerances as shares of each column's variance.

    For coordinates that are deviations from a path, ``reg_covar`` is relative to the variance
    of both: it is the same whether a base moves or stands.

    Parameters
    ----------
    moments : ColumnMoments
        Of the rows that a mixture is learned from.
    operators : sequence of Operator
        In whose local coordinates it is seen.
    kinematics : Kinematics
        On which the operators act.
    reg_covar, covariance_type
        Parameters of :class:`~tpgmm_torch.TaskParameterizedGMM`.

    Returns
    -------
    array of shape (sum of 1 + D_j,)

    Raises
    ------
    DataError
        If a tolerance is no number, negative, or not finite.
    """
    tolerances = [(0.0, *operator.tolerances(kinematics)) for operator in operators]
    for operator, (_, *given) in zip(operators, tolerances, strict=True):
        if not all(isinstance(one, Real) and 0 <= one < math.inf for one in given):
            raise DataError(f"a tolerance is a number of at least 0, {operator!r} has {given}")
    widths = block_widths(operators, kinematics)
    scales = moments.scales(widths, isotropic=covariance_type == "spherical")
    paths = [(0.0, *operator.path_variances(kinematics)) for operator in operators]
    shares = reg_covar * (1 + np.concatenate(paths) / scales**2)
    return shares + (np.concatenate(tolerances) / scales) ** 2
