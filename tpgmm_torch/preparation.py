"""What comes before and after EM in fitting an estimator: its parameters become a mixture's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Self

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.likelihood import Likelihood
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.operators import Canonical, Operator
from tpgmm_torch.operators.base import frame_names
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["Preparation"]

MIXTURE_PARAMETERS = (
    "n_components", "covariance_type", "reg_covar", "tol", "max_iter", "n_init", "init_params",
    "random_state", "warm_start", "verbose", "dtype", "device",
)  # fmt: skip


class Preparation(Likelihood):
    """The half of :class:`~tpgmm_torch.TaskParameterizedGMM` that needs only its parameters."""

    operators: Sequence[Operator] | None
    robot: Kinematics | None
    covariance_type: str
    reg_covar: float
    warm_start: bool
    dtype: str
    device: str

    def _checked_operators(self) -> tuple[Operator, ...]:
        """The operators, once they are known to be some."""
        operators = (Canonical(),) if self.operators is None else tuple(self.operators)
        if not operators:
            raise DataError("operators is empty: give at least one, for example [Canonical()]")
        for operator in operators:
            if not isinstance(operator, Operator):
                raise DataError(f"operators holds Operator objects, got {operator!r}")
        return operators

    def _kinematics_for(
        self, demonstrations: Sequence[Demonstration], operators: Sequence[Operator]
    ) -> Kinematics:
        """What the operators act on, once it is known to have what they need."""
        kinematics = self._kinematics(demonstrations, operators)
        for operator in operators:
            operator.check(kinematics, demonstrations[0].frames)
        return kinematics

    def _kinematics(
        self, demonstrations: Sequence[Demonstration], operators: Sequence[Operator]
    ) -> Kinematics:
        dtype = getattr(torch, self.dtype)
        if self.robot is not None:
            return self.robot.to(dtype, self.device)
        needed = sorted({link for operator in operators for link in operator.links()})
        if needed:
            raise DataError(
                f"the operators need the pose of {needed}: pass robot=Robot.from_urdf(...), or "
                "robot=Poses(...) for recorded poses without a robot"
            )
        default = tuple(f"joint_{index}" for index in range(demonstrations[0].n_joints))
        names = next((d.joint_names for d in demonstrations if d.joint_names), default)
        return JointSpace(names, dtype, self.device)

    def _regularization(
        self,
        moments: ColumnMoments,
        operators: Sequence[Operator],
        kinematics: Kinematics,
    ) -> NDArray[np.float64]:
        """``reg_covar`` and the operators' tolerances, as shares of each column's variance."""
        widths = [1 + operator.dimension(kinematics) for operator in operators]
        isotropic = self.covariance_type == "spherical"
        scales = torch.cat(moments.standardization(widths, isotropic=isotropic).scales)
        tolerances = [(0.0, *operator.tolerances(kinematics)) for operator in operators]
        return self.reg_covar + (np.concatenate(tolerances) / scales.numpy()) ** 2

    def _mixture_parameters(
        self, operators: Sequence[Operator], kinematics: Kinematics
    ) -> dict[str, Any]:
        blocks = tuple(1 + operator.dimension(kinematics) for operator in operators)
        return {"blocks": blocks} | {name: getattr(self, name) for name in MIXTURE_PARAMETERS}

    def _mixture(
        self,
        moments: ColumnMoments,
        group_size: int,
        operators: Sequence[Operator],
        kinematics: Kinematics,
    ) -> BlockGaussianMixture:
        """What is to be fitted to rows of such moments."""
        settings = self._mixture_parameters(operators, kinematics)
        settings["group_size"] = group_size
        settings["reg_covar"] = self._regularization(moments, operators, kinematics)
        if self.warm_start and hasattr(self, "mixture_"):
            return self.mixture_.set_params(**settings)
        return BlockGaussianMixture(**settings)

    def _take(
        self,
        mixture: BlockGaussianMixture,
        operators: tuple[Operator, ...],
        kinematics: Kinematics,
        time: Tensor,
    ) -> Self:
        """Take over what a mixture learned."""
        self.mixture_, self.operators_, self.kinematics_ = mixture, operators, kinematics
        self.frame_names_, self.time_ = frame_names(operators, kinematics), time
        self.weights_, self.means_ = mixture.weights_, mixture.means_
        self.covariances_ = mixture.covariances_
        self.n_iter_, self.converged_ = mixture.n_iter_, mixture.converged_
        self.lower_bound_ = mixture.lower_bound_
        return self
