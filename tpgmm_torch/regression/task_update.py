"""The control tick in few operations: joints known by a Gaussian, corrected by tasks.

Where the joints have an operator of their own (:class:`Canonical`), its conditional
``N(m, C)`` given time is a prior over the joints that does not depend on the robot, and each
task ``J (q - q_{t-1}) ~ N(y, S)`` is a measurement of it. The product (2) of the projected
Gaussians is then the Kalman update

    H = S + J C J^T,   q = m + C J^T H^-1 (y - J (m - q_{t-1})),   C - C J^T H^-1 J C,

the information form by the matrix inversion lemma: as many dimensions as the
tasks have (12 for two hands) in place of as many as there are joints, no pseudo-inverse and no
epsilon. Inside, B robots stand in the first dimension. What they share, the covariances of all
A components side by side, enters one matrix product; then each has its components beside each
other, so that sums over them are products too.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators import (
    AbsoluteOrientation,
    AbsolutePosition,
    Canonical,
    Linearization,
    Operator,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.regression.component_tables import Tables
from tpgmm_torch.regression.corrections import corrections
from tpgmm_torch.regression.local_mixtures import LocalMixture
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["TaskUpdate"]

#: Operators whose M has full row rank at every state, so that S is as definite as what was
#: learned. An operator of another kind may claim to know a direction exactly by mistake, which
#: the sum of precisions refuses and this form would not notice.
TASKS = (AbsolutePosition, RelativePosition, AbsoluteOrientation, RelativeOrientation)


class TaskUpdate:
    """The update of the joints' operator by all others.

    Parameters
    ----------
    kinematics : Kinematics
    operators : sequence of Operator
        At least one of them is :class:`Canonical`.
    mixtures : sequence of LocalMixture
        One per operator.
    log_weights : Tensor of shape (K,)

    Attributes
    ----------
    task : Stack or None
        All operators but those of the joints.
    tables : Tables
        Of all components.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        operators: Sequence[Operator],
        mixtures: Sequence[LocalMixture],
        log_weights: Tensor,
    ) -> None:
        tasks, local, priors = [], [], []
        for operator, mixture in zip(operators, mixtures, strict=True):
            if type(operator) is Canonical:
                priors.append(mixture)
            else:
                tasks.append(operator)
                local.append(mixture)
        self.task = Stack(*tasks) if tasks else None
        self.tables = Tables.prepared(mixtures[0], local, priors, log_weights)
        like = self.tables.mean
        #: Which coordinates (D) are the quaternion that a row (m) is about, if any.
        self.sides: Tensor | None = None
        if self.task is not None and self.task.quaternion_starts(kinematics):
            self.sides = _sides(self.task, kinematics).to(like)

    @staticmethod
    def serves(operators: Sequence[Operator], kinematics: Kinematics) -> bool:
        """Whether these operators can be fused in this way.

        Parameters
        ----------
        operators : sequence of Operator
        kinematics : Kinematics
            Where the joint vector holds quaternions, what the joints' operator says depends on
            the present state.
        """
        if kinematics.quaternion_starts or not any(type(o) is Canonical for o in operators):
            return False
        tasks = [operator for operator in operators if type(operator) is not Canonical]
        leaves = Stack(*tasks).leaves if tasks else ()
        return all(type(leaf) in TASKS for leaf in leaves)

    def __call__(
        self,
        choose: Callable[[Tensor], Tables],
        time: Tensor,
        state: RobotState,
        frames: Mapping[str, Frame],
    ) -> tuple[Tensor, Tensor, Tensor]:
        """References at ``time`` (scalar or of the batch's shape) from the state q_{t-1}.

        Parameters
        ----------
        choose : callable
            Gives the tables of the components that count at some times.
        time : Tensor
        state : RobotState
        frames : mapping of str to Frame

        Returns
        -------
        joints : Tensor of shape (..., n)
        covariance : Tensor of shape (..., n, n)
        activation : Tensor of shape (..., K)
        """
        at = self._linearize(state, frames)
        assert at.jacobian is not None and at.matrix is not None
        joints = state.joints
        batch = gaussians.common_shape(
            at.jacobian.shape[:-2],
            at.matrix.shape[:-2],
            at.displacement.shape[:-1],
            time.shape or joints.shape[:-1],
        )
        present = at.present
        if present is None and self.sides is not None:
            assert self.task is not None
            present = self.task.coordinates(state, frames)
        jacobian, matrix = _flat(at.jacobian, batch), _flat(at.matrix, batch)
        if batch.numel() > 1:  # robot by robot, as libraries want matrices
            jacobian, matrix = jacobian.contiguous(), matrix.contiguous()
        shift, joints = _flat(at.displacement, batch, 1), _flat(joints, batch, 1)
        if present is not None:
            present = _flat(present, batch, 1)
        if time.ndim:
            time = _flat(time, batch, 0)
        mean, covariance, activation = self._corrected(
            choose(time), time, joints, jacobian, matrix, shift, present
        )
        if len(batch) == 1:
            return mean, covariance, activation
        return (
            mean.reshape(*batch, -1),
            covariance.reshape(*batch, *covariance.shape[-2:]),
            activation.reshape(*batch, -1) if time.ndim else activation,
        )

    def _corrected(
        self,
        tables: Tables,
        time: Tensor,
        joints: Tensor,
        jacobian: Tensor,
        matrix: Tensor,
        shift: Tensor,
        present: Tensor | None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same for B robots that have been linearised.

        Parameters
        ----------
        tables : Tables
        time : Tensor of shape () or (B,)
        joints : Tensor of shape (B, n)
            The joints q_{t-1}.
        jacobian : Tensor of shape (B, m, n)
        matrix : Tensor of shape (B, m, D)
        shift : Tensor of shape (B, m)
            The displacement c.
        present : Tensor of shape (B, D), optional
            The present quaternions.
        """
        (b, m, n), a = jacobian.shape, len(tables.places)
        apart = (time.unsqueeze(-1) if time.ndim else time) - tables.time_mean
        log_h = torch.addcmul(
            tables.log_weights, tables.time_precision, apart * apart, value=-0.5
        )
        weights = torch.softmax(log_h, -1)  # (A,), or (B, A)
        # (mu; -m), (A, D + n) or (B, A, D + n)
        mean = torch.addcmul(tables.mean, tables.gain, apart.unsqueeze(-1))
        width = matrix.shape[-1]
        task, negative = mean.narrow(-1, 0, width), mean.narrow(-1, width, n)
        matrix, other = self._sided(matrix, task, present)

        # J C and M S of all components; H, and the innovation y - J (m - q_{t-1})
        crossed = (jacobian @ tables.joints).view(b, m * a, n)
        h = torch.bmm((matrix @ tables.tasks).view(b, m * a, width), matrix.mT)  # (B, m A, m)
        expected = matrix @ task.mT  # (B, m, A)
        if other is not None:
            h = h.view(b, m, a, m) * other.mT.unsqueeze(-1) * other.unsqueeze(1)
            h, expected = h.view(b, m * a, m), expected * other.mT
        h.baddbmm_(crossed, jacobian.mT)
        away = joints.unsqueeze(-1) + negative.mT  # (B, n, A)
        innovation = torch.baddbmm(shift.unsqueeze(-1), jacobian, away).add_(expected)

        prior = (weights @ tables.priors).view(-1, n, n)
        moves, covariance = corrections(h, crossed, innovation, weights, prior)
        each = moves - negative
        joints = torch.bmm(weights.view(-1, 1, a).expand(b, 1, a), each).squeeze(1)
        # within the components, and between them: the law of total variance
        apart = each - joints.unsqueeze(1)
        covariance.baddbmm_((apart * weights.unsqueeze(-1)).mT, apart)
        return joints, covariance, weights @ tables.places

    def _linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        joints = state.joints
        if self.task is None:
            batch, n = joints.shape[:-1], joints.shape[-1]
            nothing = joints.new_zeros(*batch, 0)
            return Linearization(
                joints.new_zeros(*batch, 0, n), joints.new_zeros(*batch, 0, 0), nothing
            )
        return self.task.linearize(state, frames)

    def _sided(
        self, matrix: Tensor, task: Tensor, present: Tensor | None
    ) -> tuple[Tensor, Tensor | None]:
        """M for mean quaternions on the present one's side of the sphere.

        A mean on the other side is minus itself, as are its rows. Where that differs between
        components, there are signs (B, A, m) by which theirs differ from the first one's.
        """
        if present is None or self.sides is None:
            return matrix, None
        # where no quaternion stands, inner is zero
        inner = (task * present.unsqueeze(1)) @ self.sides.mT
        if inner.numel() == 0 or inner.min().item() >= 0:  # often all are there
            return matrix, None
        signs = torch.where(inner < 0, -1.0, 1.0).to(inner)
        first = signs.narrow(1, 0, 1)
        matrix = matrix * first.mT
        # nearly always all components are on one side
        return matrix, None if torch.equal(signs, first.expand_as(signs)) else signs * first


def _sides(task: Stack, kinematics: Kinematics) -> Tensor:
    """1 where a row (m) is about a quaternion's coordinates (D); each leaf has three rows."""
    sides = torch.zeros(3 * len(task.leaves), task.dimension(kinematics), dtype=torch.float64)
    column = 0
    for index, leaf in enumerate(task.leaves):
        for start in leaf.quaternion_starts(kinematics):
            sides[3 * index : 3 * index + 3, column + start : column + start + 4] = 1.0
        column += leaf.dimension(kinematics)
    return sides


def _flat(tensor: Tensor, batch: torch.Size, own: int = 2) -> Tensor:
    """The batch's dimensions as one, before ``own`` dimensions of the tensor's own."""
    before = tensor.ndim - own
    if tensor.shape[:before] != batch:
        tensor = tensor.expand(*batch, *tensor.shape[before:])
    return (
        tensor
        if len(batch) == 1
        else tensor.reshape(batch.numel(), *tensor.shape[len(batch) :])
    )
