"""What operators say of demonstrations that were left out, instant by instant.

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
from tpgmm_torch.robots.held_objects import held_objects
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.training.local_data import local_data
from tpgmm_torch.training.training_rows import typical_time

__all__ = ["Evidence", "Fused", "gather_evidence"]

#: No sensor agrees with itself to less [m or rad]: what never varies stays finite.
RESOLUTION = 1e-3
#: Demonstrations that are left out in turn; of more, so many are taken, evenly.
MOST_LEFT_OUT = 20


@dataclass(frozen=True, eq=False)
class Fused:
    """Product of the Gaussians of some operators, for M demonstrations left out.

    Parameters
    ----------
    precision : Tensor of shape (M, T, n, n)
    vector : Tensor of shape (M, T, n)
        Precision times mean.
    """

    precision: Tensor
    vector: Tensor


@dataclass(frozen=True, eq=False)
class Evidence:
    """What C operators say of M demonstrations left out, at T instants.

    Parameters
    ----------
    time : Tensor of shape (T,)
        Of a typical demonstration [s].
    jacobians : list of Tensor of shape (M, T, m, n)
        One per operator.
    residuals : list of Tensor of shape (M, T, m)
        ``M (mu - X)``: by how much it is wrong itself.
    rows : list of Tensor of shape (M, T, m, n + 1)
        Both side by side, whitened by the Cholesky factor of S.
    nothing : Fused
        What is known without operators: each joint's mean and variance over everything.
    floor : Tensor of shape (n,)
        Variances below which agreement of the joints means nothing.
    degrees : float
        Of freedom of a variance.
    """

    time: Tensor
    jacobians: list[Tensor]
    residuals: list[Tensor]
    rows: list[Tensor]
    nothing: Fused
    floor: Tensor
    degrees: float

    def added(self, fused: Fused, operator: int) -> Fused:
        """The ``fused`` product with the Gaussian of one more ``operator``, by number."""
        rows = self.rows[operator]
        jacobian, residual = rows[..., :-1], rows[..., -1:]
        return Fused(
            fused.precision + jacobian.mT @ jacobian,
            fused.vector + (jacobian.mT @ residual)[..., 0],
        )

    def of(self, operators: Sequence[int]) -> Fused:
        """The product of the Gaussians of some ``operators``, by number."""
        fused = self.nothing
        for operator in operators:
            fused = self.added(fused, operator)
        return fused

    def log_likelihood(self, fused: Fused) -> Tensor:
        """Of the demonstrations left out, given the ``fused`` product, in nats, (M, T)."""
        covariance = torch.linalg.inv(fused.precision)
        step = covariance @ fused.vector[..., None]
        floored, name = covariance + self.floor.diag(), "the covariance of what is expected"
        return gaussians.log_density(step, floored, name, self.degrees)[..., 0]

    def errors(self, operator: int, fused: Fused) -> tuple[Tensor, Tensor]:
        """How far demonstrations left out are from what is expected, root mean square.

        Parameters
        ----------
        operator : int
            Whose coordinates are meant.
        fused : Fused
            The others.

        Returns
        -------
        tuple of Tensor of shape (T,)
            From what the operator expects, and from what the others do, as far as the joints
            can tell: in metres, radians, or numbers of a quaternion.
        """
        step = torch.linalg.solve(fused.precision, fused.vector[..., None])
        others = (self.jacobians[operator] @ step)[..., 0]
        own, other = (
            each.square().sum(-1).mean(0).sqrt() for each in (self.residuals[operator], others)
        )
        return own, other


def gather_evidence(
    demonstrations: Sequence[Demonstration],
    operators: Sequence[Operator],
    kinematics: Kinematics,
    *,
    tolerance: float,
    n_instants: int,
    holds: Sequence[Hold] = (),
    prior_degrees: float = 0.0,
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
    holds : sequence of Hold, default=()
        Objects that the robot held.
    prior_degrees : float, default=0
        Degrees of freedom d0 of a scaled inverse chi-squared prior of each variance, whose
        scale is the variance of all N demonstrations: those that are left have N - 2, and a
        variance is ``((N - 2) s^2 + d0 s0^2) / (N - 2 + d0)``. Of three demonstrations two
        are left, which agree by chance in what the third shows to differ.
    """
    time = typical_time(demonstrations).to(kinematics.lower)
    count = min(n_instants, *map(len, demonstrations))
    phase = torch.linspace(0, 1, count)
    seen = [_at_phase(one, phase) for one in demonstrations]
    # quaternions among the joints on one side, from here on
    joints = torch.stack([row[:, 1:] for row in local_data(seen, [Canonical()], kinematics)])
    names = kinematics.joint_names
    seen = [
        replace(one, joints=own, joint_names=names)
        for one, own in zip(seen, joints, strict=True)
    ]
    data = torch.stack(local_data(seen, operators, kinematics, holds=holds))  # (N, T, ...)
    number = len(seen)
    # s0^2 has a share in each variance, and none where nothing is asked of a prior
    prior, degrees = data.var(0), number - 2.0
    share = prior_degrees / (degrees + prior_degrees) if prior_degrees else 0.0
    left_out = torch.linspace(0, number - 1, min(number, MOST_LEFT_OUT)).round().long()
    shape = (len(left_out), count)
    jacobians: list[list[Tensor]] = [[] for _ in operators]
    residuals: list[list[Tensor]] = [[] for _ in operators]
    rows: list[list[Tensor]] = [[] for _ in operators]
    for index in left_out.tolist():
        demonstration = seen[index]
        state = kinematics.state(joints[index])
        frames = {name: f.to(time) for name, f in demonstration.frames.items()}
        if holds:
            there = demonstration.time.to(time)
            state, frames = held_objects(state, there, frames, holds, attached=True)
        others = [other for other in range(number) if other != index]
        column = 0
        for j, operator in enumerate(operators):
            size = operator.dimension(kinematics)
            local = data[..., column + 1 : column + 1 + size]
            column += 1 + size
            own = local[others].var(0) * number / (number - 1)
            whole = prior[..., column - size : column] * (number + 1) / number
            variance = (1 - share) * own + share * whole + RESOLUTION**2
            gap = local[others].mean(0) - local[index]
            present = operator.coordinates(state, frames)
            for start in operator.quaternion_starts(kinematics):
                block = slice(start, start + 4)  # M is that of the quaternion as it is now
                along = (present[:, block] * local[index, :, block]).sum(-1, keepdim=True)
                gap[:, block] = torch.where(along < 0, -gap[:, block], gap[:, block])
            at = operator.linearize(state, frames)
            if at.matrix is None:
                covariance = variance.diag_embed()
            else:
                gap = (at.matrix @ gap[..., None])[..., 0]
                covariance = at.matrix @ variance.diag_embed() @ at.matrix.mT
            if at.noise is not None:
                covariance = covariance + at.noise.diag_embed()
            jacobian = at.jacobian
            if jacobian is None:
                jacobian = torch.eye(joints.shape[-1]).to(joints)
            jacobian = jacobian.expand(*gap.shape, -1)
            jacobians[j].append(jacobian)
            residuals[j].append(gap)
            factor, both = torch.linalg.cholesky(covariance), (jacobian, gap[..., None])
            white = torch.linalg.solve_triangular(factor, torch.cat(both, -1), upper=False)
            rows[j].append(white)
    floor = torch.tensor(Canonical(tolerance).tolerances(kinematics)).to(time).square()
    spread = joints.flatten(0, 1).var(0) + floor
    gap = joints.mean((0, 1)) - joints[left_out]
    return Evidence(
        time[((len(time) - 1) * phase).round().long()],
        list(map(torch.stack, jacobians)),
        list(map(torch.stack, residuals)),
        list(map(torch.stack, rows)),
        nothing=Fused((1 / spread).diag().expand(*shape, -1, -1), gap / spread),
        floor=floor,
        degrees=max(degrees, 1.0),
    )


def _at_phase(demonstration: Demonstration, phase: Tensor) -> Demonstration:
    """The demonstration at some of its time steps, at equal ``phase`` from 0 to 1."""
    steps = ((len(demonstration) - 1) * phase).round().long()
    return demonstration.at_steps(steps)
