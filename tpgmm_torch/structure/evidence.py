"""Likelihood of left-out demonstrations under each operator, instant by instant.

At its cheapest a model has one Gaussian per operator and instant: mean and variances of the
local coordinates of all demonstrations but one. At the posture q of the one left out, whose
local coordinates are X, an operator asks for the displacement ``J dq = M (mu - X)``, with the
covariance ``S = M Sigma M^T``; the product of several is one Gaussian over dq, as in section
II, and the demonstration is the more likely the narrower that is around dq = 0. So sets of
operators are compared by one number in the units of the joints, whatever their coordinates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.holds import Hold
from tpgmm_torch.operators import Canonical, Operator
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.local_data import Motion, local_data
from tpgmm_torch.training.training_rows import typical

#: No sensor agrees with itself to less [m or rad]: what never varies stays finite.
RESOLUTION = 1e-3


@dataclass(frozen=True, eq=False)
class Evidence:
    """Gaussians of C operators over the joints of M demonstrations left out, at T instants.

    Parameters
    ----------
    time : Tensor of shape (T,)
        Of a typical demonstration [s].
    jacobians, residuals : tuple of Tensor of shape (M, T, m, n), (M, T, m)
        J, and ``M (mu - X)``, by how much an operator is wrong itself; one per operator.
    precisions, vectors : tuple of Tensor of shape (M, T, n, n), (M, T, n)
        ``J^T S^-1 J`` and ``J^T S^-1 M (mu - X)``; one per operator.
    nothing : tuple of Tensor
        The same without operators: each joint's mean and variance over everything.
    floor : Tensor of shape (n,)
        Variances below which agreement of the joints means nothing.
    degrees : float
        Of freedom of a variance.
    """

    time: Tensor
    jacobians: tuple[Tensor, ...]
    residuals: tuple[Tensor, ...]
    precisions: tuple[Tensor, ...]
    vectors: tuple[Tensor, ...]
    nothing: tuple[Tensor, Tensor]
    floor: Tensor
    degrees: float

    def _fuse(self, operators: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Covariance and mean (..., n, 1) of the product of some operators' Gaussians."""
        precision, vector = self.nothing
        for operator in operators:
            precision = precision + self.precisions[operator]
            vector = vector + self.vectors[operator]
        covariance = torch.linalg.inv(precision)
        return covariance, covariance @ vector[..., None]

    def log_likelihood(self, operators: Sequence[int]) -> Tensor:
        """Compute that of those left out, given some operators by number, (M, T) [nats]."""
        covariance, step = self._fuse(operators)
        floored, name = covariance + self.floor.diag(), "the covariance of what is expected"
        return gaussians.log_density(step, floored, name, self.degrees)[..., 0]

    def errors(self, operator: int, others: Sequence[int]) -> tuple[Tensor, Tensor]:
        """Measure how far those left out are from what is expected, root mean square.

        Parameters
        ----------
        operator : int
            Whose coordinates are meant.
        others : sequence of int

        Returns
        -------
        tuple of Tensor of shape (T,)
            From what the operator expects, and from what the others do, as far as the joints
            can tell: in metres, radians, or numbers of a quaternion.
        """
        _, step = self._fuse(others)
        of_others = (self.jacobians[operator] @ step)[..., 0]
        own, other = (x.square().sum(-1).mean(0) for x in (self.residuals[operator], of_others))
        return own.sqrt(), other.sqrt()


def gather_evidence(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    tolerance: float,
    n_instants: int,
    n_left_out: int = 20,
    holds: Sequence[Hold] = (),
) -> Evidence:
    """Leave each demonstration out, and ask operators about it.

    Parameters
    ----------
    demonstrations : sequence of Demonstration
        At least three, aligned; what has other time grids is compared at equal phase.
    operators : sequence of Operator
    kinematics : Kinematics
    tolerance : float
        Agreement below it means nothing [rad or m].
    n_instants : int
        T, at most: evenly spread.
    n_left_out : int, default=20
        M, at most: evenly chosen.
    holds : sequence of Hold, default=()
        Objects that the robot held.
    """
    begins = [float(one.time[0]) for one in demonstrations]
    durations = [one.duration for one in demonstrations]
    time = demonstrations[typical(begins, durations)].time.to(kinematics.lower)
    phase = torch.linspace(0, 1, min(n_instants, *map(len, demonstrations)))
    seen = [one.at_steps(((len(one) - 1) * phase).round().long()) for one in demonstrations]
    # quaternions among the joints on one side, from here on
    joints = torch.stack(local_data(seen, [Canonical()], kinematics))[..., 1:]
    names, number = kinematics.joint_names, len(seen)
    seen = [replace(d, joints=q, joint_names=names) for d, q in zip(seen, joints, strict=True)]
    data = torch.stack(local_data(seen, operators, kinematics, holds=holds))  # (N, T, ...)
    widths = [1 + operator.dimension(kinematics) for operator in operators]
    blocks = [block[..., 1:] for block in data.split(widths, -1)]
    left_out = torch.linspace(0, number - 1, min(number, n_left_out)).round().long()
    terms = []
    for index in left_out.tolist():
        known = Motion.of(seen[index], kinematics, holds, attached=True)
        for operator, local in zip(operators, blocks, strict=True):
            terms.append(_term(operator, local, index, kinematics, known))
    count = len(operators)
    stacked = [
        tuple(map(torch.stack, zip(*terms[j::count], strict=True))) for j in range(count)
    ]
    jacobians, residuals, precisions, vectors = zip(*stacked, strict=True)
    floor = torch.tensor(Canonical(tolerance).tolerances(kinematics)).to(time).square()
    spread = joints.flatten(0, 1).var(0) + floor
    gap = joints.mean((0, 1)) - joints[left_out]
    prior = (1 / spread).diag().expand(*gap.shape, -1), gap / spread
    instants = time[((len(time) - 1) * phase).round().long()]
    freedom = max(number - 2.0, 1.0)
    return Evidence(instants, jacobians, residuals, precisions, vectors, prior, floor, freedom)


def _term(
    operator: Operator, local: Tensor, index: int, kinematics: Kinematics, motion: Motion
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Jacobian, residual, precision and vector of an operator, one demonstration left out."""
    number, state, frames = len(local), motion.state, motion.frames
    others, degrees = torch.arange(number) != index, number - 2.0
    # two that are left of three agree by chance: a prior with the variance of all
    # demonstrations counts as much as one degree of freedom
    share = 1 / (degrees + 1)
    own = local[others].var(0) * number / (number - 1)
    whole = local.var(0) * (number + 1) / number
    covariance = ((1 - share) * own + share * whole + RESOLUTION**2).diag_embed()
    gap = local[others].mean(0) - local[index]
    present = operator.coordinates(state, frames)
    for start in operator.quaternion_starts(kinematics):
        block = slice(start, start + 4)  # M is that of the quaternion as it is now
        along = (present[:, block] * local[index, :, block]).sum(-1, keepdim=True)
        gap[:, block] = torch.where(along < 0, -gap[:, block], gap[:, block])
    at = operator.linearize(state, frames)
    if at.matrix is not None:
        gap = (at.matrix @ gap[..., None])[..., 0]
        covariance = at.matrix @ covariance @ at.matrix.mT
    if at.noise is not None:
        covariance = covariance + at.noise.diag_embed()
    joints = state.joints
    jacobian = torch.eye(joints.shape[-1]).to(joints) if at.jacobian is None else at.jacobian
    jacobian = jacobian.expand(*gap.shape, -1)
    both = jacobian, gap[..., None]
    factor = gaussians.cholesky(covariance, "the covariance of an operator")
    white = torch.linalg.solve_triangular(factor, torch.cat(both, -1), upper=False)
    rows, residual = white[..., :-1], white[..., -1:]
    return jacobian, gap, rows.mT @ rows, (rows.mT @ residual)[..., 0]
