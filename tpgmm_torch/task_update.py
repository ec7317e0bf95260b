"""The control tick in few operations: joints known by a Gaussian, corrected by tasks.

Where the joints have an operator of their own (:class:`Canonical`), its conditional
``N(m, C)`` given time is a prior over the joints that does not depend on the robot, and each
task ``J (q - q_{t-1}) ~ N(y, S)`` is a measurement of it. The product (2) of the projected
Gaussians is then the Kalman update

    H = S + J C J^T,   q = m + C J^T H^-1 (y - J (m - q_{t-1})),   C - C J^T H^-1 J C,

the information form by the matrix inversion lemma: as many dimensions as the
tasks have (12 for two hands) in place of as many as there are joints, no pseudo-inverse and no
epsilon. Inside, the A components stand in the first dimension and B robots in the second, so
that what all robots share enters one matrix product per component.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.component_tables import Tables
from tpgmm_torch.frames import Frame
from tpgmm_torch.kinematics import Kinematics, RobotState
from tpgmm_torch.local_mixtures import LocalMixture
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
        self._width = 0 if self.task is None else self.task.dimension(kinematics)
        starts = () if self.task is None else self.task.quaternion_starts(kinematics)
        self._blocks: Tensor | None = None
        if starts:
            self._blocks = like.new_zeros(self._width, like.shape[-2])
            for start in starts:
                self._blocks[start : start + 4, start : start + 4] = 1.0
        self._one = like.new_ones(())
        # tasks make the covariance smaller, what keeps the components apart makes it larger
        height = 3 * len(self.task.leaves) if self.task else 0
        self._signature = torch.cat((-like.new_ones(height), like.new_ones(1)))

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
        row, shift = self.measurement(at, joints, batch)
        present = at.present
        if present is None and self.task is not None:
            present = self.task.coordinates(state, frames)
        flat = [row, shift] if present is None else [row, shift, _flat(present, batch, 1)]
        if time.ndim:
            time = _flat(time, batch, 0)
        joints, covariance, activation = self.part(choose(time), time, *flat)
        if len(batch) == 1:
            return joints, covariance, activation
        return (
            joints.reshape(*batch, -1),
            covariance.reshape(*batch, *covariance.shape[-2:]),
            activation.reshape(*batch, -1) if time.ndim else activation,
        )

    @staticmethod
    def measurement(
        at: Linearization, joints: Tensor, batch: torch.Size
    ) -> tuple[Tensor, Tensor]:
        """``y - J (m - q_{t-1}) = [M, J] (mu; -m) + c + J q_{t-1}``, for :meth:`part`.

        Parameters
        ----------
        at : Linearization
            With Jacobian and matrix.
        joints : Tensor of shape (..., n)
            The joints q_{t-1}.
        batch : torch.Size
            Of B robots.

        Returns
        -------
        row : Tensor of shape (B, m, D + n)
        shift : Tensor of shape (B, m, 1)
        """
        jacobian, matrix = at.jacobian, at.matrix
        assert jacobian is not None and matrix is not None
        shift = at.displacement.unsqueeze(-1) + jacobian @ joints.unsqueeze(-1)
        if jacobian.shape[:-2] != matrix.shape[:-2]:
            jacobian, matrix = (x.expand(*batch, -1, -1) for x in (jacobian, matrix))
        return _flat(torch.cat((matrix, jacobian), -1), batch), _flat(shift, batch)

    def part(
        self,
        tables: Tables,
        time: Tensor,
        row: Tensor,
        shift: Tensor,
        present: Tensor | None = None,
    ) -> tuple[Tensor, Tensor, Tensor]:
        """The same for B robots that have been linearised.

        Parameters
        ----------
        tables : Tables
        time : Tensor of shape () or (B,)
        row : Tensor of shape (B, m, D + n)
            ``[M, J]``.
        shift : Tensor of shape (B, m, 1)
            ``c + J q_{t-1}``.
        present : Tensor of shape (B, D), optional
            The present quaternions.

        Returns
        -------
        joints : Tensor of shape (B, n)
        covariance : Tensor of shape (B, n, n)
        activation : Tensor of shape (K,) or (B, K)
        """
        apart = (time.unsqueeze(-1) if time.ndim else time) - tables.time_mean
        log_h = torch.addcmul(
            tables.log_weights, tables.time_precision, apart * apart, value=-0.5
        )
        weights = torch.softmax(log_h, -1)  # (A,), or (B, A)
        mean = torch.addcmul(tables.mean, tables.gain, apart.unsqueeze(-1).unsqueeze(-1))
        # (A, B or 1, D + n, 1)
        mean = mean.transpose(0, 1) if time.ndim else mean.unsqueeze(1)
        if present is not None and self._blocks is not None:
            signs = self._signs(mean, present)
            # nearly always all components are on one side; a graph cannot depend on that
            alike = not torch.compiler.is_compiling() and torch.equal(
                signs, signs[:1].expand_as(signs)
            )
            row = row * (signs[0] if alike else signs)
        measured = self._shared if row.ndim == 3 else self._own
        h, right = measured(tables.covariance, mean, row, shift)
        joints, covariance = self._corrected(tables.prior, weights, mean, h, right)
        return joints, covariance, weights @ tables.places

    def _shared(
        self, covariance: Tensor, mean: Tensor, row: Tensor, shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """H, and beside each other J C and the innovation: rows that all components share.

        Parameters
        ----------
        covariance : Tensor of shape (A, D + n, D + n)
        mean : Tensor of shape (A, B or 1, D + n, 1)
            ``(mu; -m)``.
        row : Tensor of shape (B, m, D + n)
            ``[M, J]``.
        shift : Tensor of shape (B, m, 1)
            ``c + J q_{t-1}``.

        Returns
        -------
        h : Tensor of shape (A B, m, m)
        right : Tensor of shape (A B, m, n + 1)
        """
        a, (b, m, size) = len(covariance), row.shape
        wide = covariance.transpose(0, 1).reshape(size, a * size)
        cross = (row.reshape(b * m, size) @ wide).reshape(b, m * a, size)
        h = torch.bmm(cross, row.mT).reshape(b, m, a, m).permute(2, 0, 1, 3)
        cross = cross.reshape(b, m, a, size).permute(2, 0, 1, 3)
        means = mean.squeeze(-1).permute(1, 2, 0)  # (B or 1, D + n, A)
        innovation = row @ (means[0] if len(means) == 1 else means) + shift  # (B, m, A)
        innovation = innovation.permute(2, 0, 1).unsqueeze(-1)
        n = size - self._width
        right = torch.cat((cross.narrow(-1, self._width, n), innovation), -1)
        return h.reshape(a * b, m, m), right.reshape(a * b, m, n + 1)

    def _own(
        self, covariance: Tensor, mean: Tensor, row: Tensor, shift: Tensor
    ) -> tuple[Tensor, Tensor]:
        """The same where each component has its own rows (A, B, m, D + n)."""
        a, b, m, size = row.shape
        rows = row.reshape(a, b * m, size)
        cross = torch.bmm(rows, covariance).reshape(a * b, m, size)
        row = rows.reshape(a * b, m, size)
        h = torch.bmm(cross, row.mT)
        if mean.shape[1] == b:
            shift = shift.expand(a, b, m, 1).reshape(a * b, m, 1)
            innovation = torch.baddbmm(shift, row, mean.reshape(a * b, size, 1))
        else:  # one time for all: one product per component
            innovation = torch.baddbmm(shift.reshape(1, b * m, 1), rows, mean.squeeze(1))
            innovation = innovation.reshape(a * b, m, 1)
        joints = cross.narrow(-1, self._width, size - self._width)
        return h, torch.cat((joints, innovation), -1)

    def _corrected(
        self, prior: Tensor, weights: Tensor, mean: Tensor, h: Tensor, right: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Mean (B, n) and covariance (B, n, n) of the mixture of the updated components.

        Parameters
        ----------
        prior : Tensor of shape (A, n * n)
            C of each component.
        weights : Tensor of shape (A,) or (B, A)
        mean : Tensor of shape (A, B or 1, D + n, 1)
        h, right : Tensor
            See :meth:`_shared`.
        """
        m, n, a = h.shape[-1], right.shape[-1] - 1, len(mean)
        b = len(h) // a
        factor = gaussians.cholesky(h, "the covariance of the tasks")
        white = torch.linalg.solve_triangular(factor, right, upper=False)  # (A B, m, n + 1)
        gain, innovation = white.narrow(-1, 0, n), white.narrow(-1, n, 1)
        negative = mean.narrow(-2, self._width, n).expand(a, b, n, 1).reshape(a * b, n, 1)
        each = torch.baddbmm(negative, gain.mT, innovation, beta=-1).reshape(a, b, n)
        by_component = (weights.T if weights.ndim == 2 else weights.unsqueeze(-1)).unsqueeze(-1)
        joints = (by_component * each).sum(0)
        # within the components C - G^T G, and between them: the law of total variance
        apart = (each - joints).reshape(a, b, 1, n)
        spread = torch.cat((gain.reshape(a, b, m, n), apart), -2)
        weighted = spread * (by_component * self._signature).unsqueeze(-1)
        if b == 1:
            spread, weighted = (x.reshape(1, a * (m + 1), n) for x in (spread, weighted))
        else:
            spread, weighted = (
                x.transpose(0, 1).reshape(b, a * (m + 1), n) for x in (spread, weighted)
            )
        within = (weights @ prior).reshape(-1, n, n)
        return joints, torch.baddbmm(within, spread.mT, weighted)

    def _linearize(self, state: RobotState, frames: Mapping[str, Frame]) -> Linearization:
        joints = state.joints
        if self.task is None:
            batch, n = joints.shape[:-1], joints.shape[-1]
            nothing = joints.new_zeros(*batch, 0)
            return Linearization(
                joints.new_zeros(*batch, 0, n), joints.new_zeros(*batch, 0, 0), nothing
            )
        return self.task.linearize(state, frames)

    def _signs(self, mean: Tensor, present: Tensor) -> Tensor:
        """Signs (A, B, 1, D + n) that bring each mean quaternion to the present one's side."""
        assert self._blocks is not None
        inner = (mean.narrow(-2, 0, self._width).squeeze(-1) * present) @ self._blocks
        # where no quaternion stands, inner is zero of either sign
        return torch.copysign(self._one, inner + 1e-30).unsqueeze(-2)


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
