"""Fusion of the operators' Gaussians: projection by eq. (1), and a Kalman update of the joints.

Where the joints have an operator of their own (:class:`Canonical`), its conditional
``N(m, C)`` given time is a prior over the joints that does not depend on the robot, and each
task ``J (q - q_{t-1}) = M x + c`` with ``x ~ N(mu, S)`` is a measurement of it. The product (2)
of the projected Gaussians is then, by the matrix inversion lemma, the Kalman update

    H = M S M^T + J C J^T,   r = M mu + c - J (m - q_{t-1}),   (rows 0 = 0: 1 added to H)
    q = m + C J^T H^-1 r,    C - C J^T H^-1 J C,

with as many dimensions to factorise as the tasks have (12 for two hands) in place of as many as
there are joints, no pseudo-inverse and no epsilon.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.operators import Canonical, Linearization, Operator, Stack
from tpgmm_torch.operators.base import leaves
from tpgmm_torch.operators.stack import POSE_OPERATORS
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.robots.kinematics import Kinematics, RobotState


@dataclass(frozen=True, eq=False)
class Projection:
    """Components that say ``J (q - q_{t-1}) ~ N(targets, covariance)``.

    Parameters
    ----------
    jacobian : Tensor of shape (..., 1, m, n), or None
        None is the identity.
    targets : Tensor of shape (..., K, m, r)
        Columns: the mean and, for the product activation, its time derivative.
    covariance : Tensor of shape (..., K, m, m)
    """

    jacobian: Tensor | None
    targets: Tensor
    covariance: Tensor

    @classmethod
    def of(cls, at: Linearization, columns: Tensor, covariance: Tensor) -> Projection:
        """``M mu + c``, its derivatives, and ``M Sigma M^T``.

        Parameters
        ----------
        at : Linearization
        columns : Tensor of shape (..., K, D, r)
            Local means and, for the product activation, their time derivatives.
        covariance : Tensor of shape (..., K, D, D)
        """
        if at.matrix is not None:
            matrix = at.matrix[..., None, :, :]
            columns, covariance = matrix @ columns, matrix @ covariance @ matrix.mT
        if at.noise is not None:
            covariance = covariance + at.noise.diag_embed()[..., None, :, :]
        mean = columns[..., :1] + at.displacement[..., None, :, None]
        rates = columns[..., 1:].expand(*mean.shape[:-1], -1)
        jacobian = None if at.jacobian is None else at.jacobian[..., None, :, :]
        return cls(jacobian, torch.cat((mean, rates), -1), covariance)

    def in_joint_space(self, epsilon: float = 0.0) -> Projection:
        """Eq. (1): ``A mu + b - q_{t-1}`` and ``A Sigma A^T + epsilon I``."""
        targets, covariance = self.targets, self.covariance
        if self.jacobian is not None:
            inverse = gaussians.pseudo_inverse(self.jacobian)
            targets, covariance = inverse @ targets, inverse @ covariance @ inverse.mT
        if epsilon:
            size = covariance.shape[-1]
            identity = torch.eye(size, dtype=covariance.dtype, device=covariance.device)
            covariance = covariance + epsilon * identity
        return Projection(None, targets, covariance)


class KalmanUpdate:
    """The update of the joints' operator by all others.

    Parameters
    ----------
    kinematics : Kinematics
    operators : sequence of Operator
        At least one of them is :class:`Canonical` with all joints.
    conditionals : sequence of Conditionals
        One per operator.

    Attributes
    ----------
    task : Stack or None
        All operators but those of the joints.
    conditionals : Conditionals
        Of the tasks' D coordinates and, behind them, the n joints.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        operators: Sequence[Operator],
        conditionals: Sequence[Conditionals],
    ) -> None:
        for one in conditionals:
            name = "the covariance of a projected component"
            gaussians.cholesky(one.covariance.double(), name)
        pairs = list(zip(operators, conditionals, strict=True))
        tasks = [operator for operator, _ in pairs if not _whole(operator)]
        local = [one for operator, one in pairs if not _whole(operator)]
        priors = [one for operator, one in pairs if _whole(operator)]
        self.task = Stack(*tasks) if tasks else None
        self.conditionals = Conditionals.stack([*local, Conditionals.product(priors)])
        self._starts = self.task.quaternion_starts(kinematics) if self.task is not None else ()

    @staticmethod
    def serves(operators: Sequence[Operator], kinematics: Kinematics) -> bool:
        """Check that these operators can be fused in this way.

        Parameters
        ----------
        operators : sequence of Operator
        kinematics : Kinematics
            Where the joint vector holds quaternions, what the joints' operator says depends on
            the present state.
        """
        if kinematics.quaternion_starts or not any(map(_whole, operators)):
            return False
        tasks = [operator for operator in operators if not _whole(operator)]
        return all(type(leaf) in POSE_OPERATORS for leaf in leaves(tasks))

    def __call__(
        self, conditionals: Conditionals, time: Tensor, state: RobotState, frames: Frames
    ) -> tuple[Tensor, Tensor]:
        """Fused estimates of the joints by A components, in terms of the step ``q - q_{t-1}``.

        Parameters
        ----------
        conditionals : Conditionals
            Some of :attr:`conditionals`, or all.
        time : Tensor of shape () or (...)
        state : RobotState
        frames : mapping of str to Frame

        Returns
        -------
        steps : Tensor of shape (..., A, n)
        covariances : Tensor of shape (..., A, n, n)
        """
        if self.task is None:
            steps = conditionals.at(time) - state.joints.unsqueeze(-2)
            return steps, conditionals.covariance
        task = self.task.at(time)
        at = task.linearize(state, frames)
        assert at.jacobian is not None and at.matrix is not None
        batch = gaussians.common_shape(
            at.jacobian.shape[:-2],
            at.matrix.shape[:-2],
            at.displacement.shape[:-1],
            time.shape or state.joints.shape[:-1],
        )
        # components stand in front of the batch: of each, all robots enter one product
        ones, n = [1] * len(batch), state.joints.shape[-1]
        if batch:
            time = time.expand(batch) if time.ndim else time.view(ones)
        mean, covariance = conditionals.at(time).movedim(-2, 0), conditionals.covariance
        shape, width = (mean.shape[0], *batch, -1, -1), mean.shape[-1] - n
        matrix = at.matrix
        if self._starts:
            present = at.present
            if present is None:
                present = task.coordinates(state, frames)
            # of q and -q, which are one rotation, the mean is the one that is nearer
            local = mean.narrow(-1, 0, width)
            signs = quaternions.hemisphere_signs(local, present, self._starts)
            matrix = matrix * signs.unsqueeze(-2)
        # tasks and joints are one vector z = (x, q - q_{t-1}), with r = [M, -J] z + c
        mean = mean - torch.constant_pad_nd(state.joints, (width, 0))
        jacobian = -at.jacobian.contiguous()  # many robots' may be stored number by number
        rows = torch.cat((matrix.expand(shape), jacobian.expand(shape)), -1)
        residual = rows @ mean.unsqueeze(-1) + at.displacement.unsqueeze(-1)
        cross = (rows.flatten(1, -2) @ covariance).view_as(rows)
        right = torch.cat((cross.narrow(-1, width, n), residual), -1)
        square = cross @ rows.mT
        if at.noise is not None:
            square = square + at.noise.diag_embed()
        white = gaussians.whiten(square, right, "the covariance of the tasks")
        update = white.narrow(-1, 0, n).mT @ white
        steps = mean.narrow(-1, width, n) - update[..., n]
        prior = covariance.narrow(1, width, n).narrow(2, width, n)
        if not batch:
            return steps, prior - update.narrow(-1, 0, n)
        covariances = prior.view(-1, *ones, n, n) - update.narrow(-1, 0, n)
        return steps.movedim(0, -2), covariances.movedim(0, -3)


def _whole(operator: Operator) -> bool:
    """Check that an operator is all of the joints."""
    return type(operator) is Canonical and operator.determines_joints
