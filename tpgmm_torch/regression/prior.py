"""Standard deviations of the prior that closes the fusion where operators leave joints free."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.operators import Operator
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.robots.kinematics import Kinematics

#: The default [rad], or in units of the learned positions' size: wider than any joint moves, so
#: that it decides nothing that operators decide.
PRIOR_STD = 10.0


def prior_widths(
    prior_std: Any,
    kinematics: Kinematics,
    operators: Sequence[Operator],
    conditionals: Sequence[Conditionals],
    weights: Tensor,
) -> Tensor:
    """Standard deviations of the prior around q_{t-1}, in the unit of each joint.

    Parameters
    ----------
    prior_std : float, mapping of str to float, or array-like of shape (n_joints,)
        A number counts in radians; for joints that are lengths in units of the learned
        positions' root mean square, so that metres and millimetres make no difference. A
        mapping has joints by name, in their own unit, and leaves the others at the default; an
        array has them all.
    kinematics : Kinematics
    operators : sequence of Operator
    conditionals : sequence of Conditionals
        Of each operator.
    weights : Tensor of shape (K,)
        Mixing coefficients.

    Returns
    -------
    Tensor of shape (n_joints,)

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If a value is not positive, there are more or fewer than joints, or a name is unknown.
    """
    names = kinematics.joint_names
    given = given_widths(prior_std, names)
    number = prior_std if isinstance(prior_std, Real) else PRIOR_STD
    widths = weights.detach().new_full((len(names),), float(number))
    lengths = list(kinematics.lengths)
    if lengths:  # not detached: while a policy learns, it depends on what is learned
        widths[lengths] = widths[lengths] * _size(kinematics, operators, conditionals, weights)
    for name, value in given.items():
        widths[names.index(name)] = value.to(widths)
    _check_positive(widths.tolist())  # what was learned may be NaN
    return widths


def given_widths(prior_std: Any, names: Sequence[str]) -> dict[str, Tensor]:
    """Widths that are given joint by joint, checked; none where one number is for all.

    Parameters
    ----------
    prior_std : float, mapping of str to float, or array-like of shape (n_joints,)
        As for :func:`prior_widths`.
    names : sequence of str
        The joints.

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        As for :func:`prior_widths`.
    """
    if isinstance(prior_std, Real):
        _check_positive([float(prior_std)])
        return {}
    if isinstance(prior_std, Mapping):
        for name in prior_std:
            if name not in names:
                raise UnknownNameError("joint", name, "the model", names)
        widths = {n: as_tensor(v, f"prior_std of {n!r}") for n, v in prior_std.items()}
        for name, width in widths.items():
            if width.ndim:
                raise ShapeError(
                    f"prior_std of {name!r} is one number, got shape {tuple(width.shape)}"
                )
    else:
        array = as_tensor(prior_std, "prior_std")
        if array.shape != (len(names),):
            raise ShapeError(
                f"prior_std has one value for each of the joints {list(names)}, got shape "
                f"{tuple(array.shape)}"
            )
        widths = dict(zip(names, array, strict=True))
    _check_positive([float(width) for width in widths.values()])
    return widths


def _check_positive(widths: Sequence[float]) -> None:
    if not all(width > 0 for width in widths):
        raise DataError(f"prior_std must be positive, got {widths}")


def _size(
    kinematics: Kinematics,
    operators: Sequence[Operator],
    conditionals: Sequence[Conditionals],
    weights: Tensor,
) -> Tensor:
    """Root mean square of the learned positions, in their unit; 1 where there are none."""
    squares = [weights[:0]]
    for operator, one in zip(operators, conditionals, strict=True):
        if not operator.links():
            continue
        turned = torch.zeros(one.mean.shape[-1], dtype=torch.bool)
        for start in operator.quaternion_starts(kinematics):
            turned[start : start + 4] = True
        for start in operator.rotation_vector_starts(kinematics):
            turned[start : start + 3] = True
        squares.append(weights @ one.second_moment[:, ~turned.to(weights.device)])
    together = torch.cat(squares)
    return together.mean().sqrt() if bool(together.any()) else weights.new_ones(())
