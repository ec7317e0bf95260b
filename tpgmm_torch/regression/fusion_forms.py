"""Form and settings of the product of Gaussians (2): a value of the estimator's ``fusion``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from numbers import Integral, Real
from typing import ClassVar

from tpgmm_torch.constraints import Interval, Options
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import carried_objects, leaves
from tpgmm_torch.regression.prior import PRIOR_STD, given_widths
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["CovarianceFusion", "InformationFusion"]


@dataclass(frozen=True)
class InformationFusion:
    """The product in information form, ``sum_j J_j^T S_j^-1 J_j``: exact at any posture.

    Parameters
    ----------
    prior_std : float, mapping of str to float, or array-like of shape (n_joints,), default=10.0
        Standard deviation of the prior around q_{t-1} where no operator determines every
        joint: for all joints [rad], for those that are lengths in units of the root mean square
        of the learned positions; or joint by joint, each in its own unit.
    priorities : sequence of int, optional
        One per operator. Those of a higher number are fulfilled as if those of lower ones were
        not there, which act in the null space, damped; those of one number compromise as their
        covariances say, as all do by default.
    negligible : float, default=1e-9
        Components with a smaller share of the largest weight are left out, from 0 to 1.

    Raises
    ------
    DataError
        If ``negligible`` or ``priorities`` are of the wrong kind.

    Examples
    --------
    >>> from tpgmm_torch import TaskParameterizedGMM
    >>> from tpgmm_torch.regression.fusion_forms import InformationFusion
    >>> TaskParameterizedGMM(10, fusion=InformationFusion(negligible=0.0)).fusion.negligible
    0.0
    """

    prior_std: float | Mapping[str, float] | Sequence[float] = PRIOR_STD
    priorities: Sequence[int] | None = None
    negligible: float = 1e-9
    activation: ClassVar[str] = "time"

    def __post_init__(self) -> None:
        if self.negligible not in Interval(Real, 0, 1, closed="left"):
            raise DataError(f"negligible is a number in [0, 1), got {self.negligible!r}")
        if self.priorities is None:
            return
        if isinstance(self.priorities, str) or not isinstance(self.priorities, Sequence):
            raise DataError(f"priorities holds one integer per operator: {self.priorities!r}")
        for one in self.priorities:
            if not isinstance(one, Integral) or isinstance(one, bool):
                raise DataError(f"priorities holds integers, got {one!r}")
        object.__setattr__(self, "priorities", tuple(map(int, self.priorities)))

    def check(self, operators: Sequence[Operator], kinematics: Kinematics) -> None:
        """Refuse settings that do not fit the operators or the robot.

        Parameters
        ----------
        operators : sequence of Operator
        kinematics : Kinematics

        Raises
        ------
        DataError, ShapeError, UnknownNameError
            If ``prior_std`` names other joints, or ``priorities`` are not one per operator.
        """
        given_widths(self.prior_std, kinematics.joint_names)
        if self.priorities is not None and len(self.priorities) != len(operators):
            raise DataError(
                f"there are {len(self.priorities)} priorities, {list(self.priorities)}, for "
                f"{len(operators)} operators: give each one, equal ones compromise"
            )


@dataclass(frozen=True)
class CovarianceFusion:
    """The product as printed in eqs (1) and (2), of covariances in joint space.

    Parameters
    ----------
    epsilon : float, default=1e-4
        Added to the diagonal of every projected covariance [rad^2].
    activation : {"time", "product"}, default="time"
        Where the mixing weights come from: the time marginal of the mixture, or that of the
        product, as in eq. (2).

    Raises
    ------
    DataError
        If a value is of the wrong kind.
    """

    epsilon: float = 1e-4
    activation: str = "time"
    negligible: ClassVar[float] = 1e-9
    priorities: ClassVar[None] = None
    prior_std: ClassVar[float] = PRIOR_STD

    def __post_init__(self) -> None:
        if self.epsilon not in Interval(Real, 0, None, closed="left"):
            raise DataError(f"epsilon is a number of at least 0, got {self.epsilon!r}")
        if self.activation not in Options("time", "product"):
            raise DataError(f"activation is 'time' or 'product', got {self.activation!r}")

    def check(self, operators: Sequence[Operator], kinematics: Kinematics) -> None:
        """Refuse operators that this form does not serve.

        Parameters
        ----------
        operators : sequence of Operator
        kinematics : Kinematics

        Raises
        ------
        DataError
            If operators refer to carried objects, or ``activation="product"`` meets
            coordinates whose base moves with time.
        """
        if carried := carried_objects(operators, kinematics):
            raise DataError(
                f"operators refer to {list(carried)}, which the robot may carry: while it "
                "does, they leave the joints free, which CovarianceFusion() takes for a wish "
                "to stand still. Use InformationFusion()"
            )
        tangent = [one for one in leaves(operators) if one.rotation_vector_starts(kinematics)]
        if tangent and self.activation == "product":
            raise DataError(
                f"activation='product' needs coordinates whose base does not move, {tangent} "
                "have one that does: use activation='time' or geometry='quaternion'"
            )


Fusion = InformationFusion | CovarianceFusion
