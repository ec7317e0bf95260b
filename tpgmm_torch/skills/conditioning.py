"""The reproduction, given via-points: conditioning without learning again.

A mixture says what the joints are at each instant, ``N(m_t, P_t)``, and not how what they
are at one instant goes with what they are at another. To condition it on a via-point takes
such a covariance. It is that of the Gaussian process

    q_t = m_t + e_t,   E[e_s e_t^T] = k(s, t) C(P_s, P_t),

whose law at each instant is the mixture's: ``k`` is Wendland's function, 1 at equal times and 0
from ``fade`` seconds on, and ``C(A, B)``, with ``C(A, A) = A``, solves

    A^-1 C + C B^-1 = 2 I,

the harmonic mean of variances where A and B have the same axes. Both are positive definite, so
that is their product. At a via-point
at t_a the operators and what it asks for are fused, and linearised where that leads; with its
Jacobian J and variances R,

    e_t = X_t P_a^-1 e_a,   P_t - X_t J^T S^-1 J X_t^T,
    X_t = k(t, t_a) C(P_t, P_a),   S = J P_a J^T + R.

Nowhere is the reproduction moved by more than ``k(t, t_a)`` times as many standard deviations
as at the via-point, and from ``fade`` on it is as it was. Via-points less than ``fade`` apart
are conditioned on together.

References
----------
Paraschos, Daniel, Peters, Neumann: Using probabilistic movement primitives in robotics,
Autonomous Robots 42 (2018), whose weights have such a covariance, and which are conditioned so.
Huang, Rozo, Silvério, Caldwell: Kernelized movement primitives, IJRR 38 (2019): a kernel over
time makes one of a mixture. Wendland: Piecewise polynomial, positive definite and compactly
supported radial functions of minimal degree, Advances in Computational Mathematics 4 (1995).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.posture import Residual
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.skills.via_point import ViaPoint

__all__ = ["Conditioning", "covariance_between", "wendland"]

#: Linearisations at a tick: where there was none before, and where there was one.
FIRST, LATER = 8, 1
#: Joints move by no more at a linearisation than this [rad or m].
LARGEST = 0.2
#: What is asked for without a tolerance leaves this share of the variance that was there.
EXACT = 1e-8
#: What is further away than this, and than three times the tolerance, is missed [m, rad].
MISSED = 1e-3


def wendland(distance: Tensor) -> Tensor:
    """A correlation that is 1 at 0, 0 from 1 on, and four times differentiable.

    ``(1 - r)^5 (8 r^2 + 5 r + 1)``, positive definite over a line.

    Parameters
    ----------
    distance : Tensor of shape (...)
        Not negative: r.
    """
    left = (1 - distance).clamp(min=0.0)
    return left**5 * (8 * distance**2 + 5 * distance + 1)


def covariance_between(one: Tensor, other: Tensor) -> Tensor:
    """The solution C of ``A^-1 C + C B^-1 = 2 I`` for covariances A, B of shape (..., n, n).

    In their eigenvectors it has the harmonic means of their eigenvalues: however unlike they
    are, what is moved by the one is moved by at most about twice as much by the other.

    Parameters
    ----------
    one, other : Tensor of shape (..., n, n)
    """
    (a, left), (b, right) = torch.linalg.eigh(one), torch.linalg.eigh(other)
    a, b = a.clamp(min=0.0)[..., :, None], b.clamp(min=0.0)[..., None, :]
    mean = 2 * a * b / (a + b).clamp(min=torch.finfo(a.dtype).tiny)
    return left @ ((left.mT @ right) * mean) @ right.mT


@dataclass(frozen=True, eq=False)
class _Asked:
    """Request of one via-point."""

    term: Residual
    coordinates: Tensor
    rows: Tensor  # displacements that are asked for, by their indices
    variances: Tensor

    @classmethod
    def of(cls, point: ViaPoint, kinematics: Kinematics) -> Self:
        wanted = point.coordinates(kinematics)
        term = Residual.of(point.operator, kinematics)
        like = kinematics.lower
        anywhere = dict.fromkeys(point.operator.references(), Frame(like.new_zeros(3)))
        posture = torch.zeros_like(like)
        posture[list(kinematics.quaternion_starts)] = 1.0
        state = kinematics.state(posture)
        size = point.operator.linearize(state, anywhere).displacement.shape[-1]
        rows = torch.arange(size, device=like.device)
        if bool((unknown := wanted.isnan()).any()):  # joints
            rows, wanted = rows[~unknown], wanted.nan_to_num(0.0)
        variances = like.new_tensor(point.variances(size))[rows]
        return cls(term, wanted, rows, variances)

    def displacement(
        self, state: RobotState, frames: Mapping[str, Frame]
    ) -> tuple[Tensor, Tensor]:
        """``r`` (..., m) and minus its derivative (..., m, n) at a state."""
        _, residual, jacobian, _ = self.term(self.coordinates, state, frames)
        n = state.joints.shape[-1]
        if jacobian is None:
            jacobian = torch.eye(n, dtype=residual.dtype, device=residual.device)
        batch = gaussians.common_shape(residual.shape[:-1], jacobian.shape[:-2])
        residual = residual.expand(*batch, -1)[..., self.rows]
        return residual, jacobian.expand(*batch, -1, n)[..., self.rows, :]


@dataclass(frozen=True, eq=False)
class Conditioning:
    """A reproduction that passes through via-points, tick by tick; immutable.

    Parameters
    ----------
    regression : Regression
        What is conditioned.
    points : sequence of ViaPoint
        Those of one time count together.
    fade : float
        How long before and after a via-point the reproduction is another [s].
    shift : Tensor of shape (..., n_joints), optional
        ``e_t`` of the last tick; None where nothing was moved.
    clusters : tuple
        What is asked for, by times; made by :meth:`of`.
    moved : tuple of Tensor of shape (..., A n_joints), optional
        ``e_a`` of each cluster at the last tick, to go on from.

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If a via-point does not fit the robot.
    """

    regression: Regression
    points: Sequence[ViaPoint]
    fade: float
    shift: Tensor | None = None
    clusters: tuple[_Cluster, ...] = ()
    moved: tuple[Tensor | None, ...] = ()

    @classmethod
    def of(cls, regression: Regression, points: Sequence[ViaPoint], fade: float) -> Self:
        """Of a ``regression`` on ``points``, none of which counts for longer than ``fade``."""
        if not fade > 0:
            raise DataError(f"via-points fade over a positive time, got {fade} s")
        clusters: list[_Cluster] = []
        for time, same in groupby(sorted(points, key=lambda p: p.time), lambda p: p.time):
            asked = [_Asked.of(point, regression.kinematics) for point in same]
            if clusters and time - clusters[-1].times[-1] < fade:
                clusters[-1] = clusters[-1].also(time, asked)
            else:
                clusters.append(_Cluster((time,), (tuple(asked),)))
        nothing = (None,) * len(clusters)
        return cls(regression, tuple(points), fade, None, tuple(clusters), nothing)

    def of_robots(self, regression: Regression, robots: Tensor) -> Self:
        """The same of some ``robots`` of the batch, with their ``regression``."""
        if self.shift is None or self.shift.ndim == 1:
            return replace(self, regression=regression)
        moved = tuple(None if one is None else one[robots] for one in self.moved)
        return replace(self, regression=regression, shift=self.shift[robots], moved=moved)

    def advance(
        self,
        time: Tensor,
        estimate: Estimate,
        frames: Mapping[str, Frame],
        bounds: tuple[Tensor, Tensor] | None = None,
        attach: Callable[[RobotState], RobotState] | None = None,
    ) -> tuple[Estimate, Self]:
        """Estimate of the joints at ``time``, given the via-points.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            In the time of the skill [s].
        estimate : Estimate
            Of the regression, then.
        frames : mapping of str to Frame
        bounds : tuple of two Tensor of shape (..., n_joints), optional
            The lowest and the highest joints allowed.
        attach : callable, optional
            Adds what robots carry to their state.

        Returns
        -------
        estimate : Estimate
        conditioning : Conditioning
            For the next tick.
        """
        if not any(cluster.counts(time, self.fade) for cluster in self.clusters):
            if self.shift is None:
                return estimate, self
            return estimate, replace(self, shift=None, moved=(None,) * len(self.clusters))
        if not bool(estimate.joints.isfinite().all()):  # of whom it cannot be told: as it was
            kept = estimate.joints if self.shift is None else estimate.joints + self.shift
            return replace(estimate, joints=kept), self
        look = _Look(self.regression, frames, attach)
        here, moved_by = look(time, estimate.joints), []
        shift, covariance = torch.zeros_like(here.joints), here.covariance
        for cluster, last in zip(self.clusters, self.moved, strict=True):
            there = None
            if cluster.counts(time, self.fade):
                moved, narrowed, there = cluster.condition(time, self.fade, here, look, last)
                shift, covariance = shift + moved, covariance - narrowed
            moved_by.append(there)
        given = replace(estimate, joints=here.joints + shift, covariance=covariance)
        conditioned = Regression.bounded(given, bounds)
        return conditioned, replace(self, shift=shift, moved=tuple(moved_by))

    def missed(
        self, time: Tensor, joints: Tensor, frames: Mapping[str, Frame]
    ) -> list[tuple[ViaPoint, float]]:
        """Via-points that references do not pass through, and by how much [m, rad].

        Parameters
        ----------
        time : Tensor of shape (T,)
            In the time of the skill [s]; via-points between two steps are not looked at.
        joints : Tensor of shape (T, n_joints)
        frames : mapping of str to Frame
            Of shape () or (T,).
        """
        found = []
        for point in self.points:
            step = int((time - point.time).abs().argmin())
            if not torch.isclose(time[step], time.new_tensor(point.time)):
                continue
            here = {n: f[step] if f.batch_shape else f for n, f in frames.items()}
            state = self.regression.kinematics.state(joints[step])
            asked = _Asked.of(point, self.regression.kinematics)
            residual, _ = asked.displacement(state, here)
            beyond = residual.abs() - 3 * asked.variances.sqrt()
            if float(beyond.max()) > MISSED:
                found.append((point, float(residual.norm())))
        return found


@dataclass(frozen=True, eq=False)
class _Look:
    """Regression at another time, of robots as they are."""

    regression: Regression
    frames: Mapping[str, Frame]
    attach: Callable[[RobotState], RobotState] | None

    def state(self, joints: Tensor) -> RobotState:
        state = self.regression.kinematics.state(joints)
        return state if self.attach is None else self.attach(state)

    def __call__(self, time: Tensor, joints: Tensor) -> Estimate:
        """At ``time``, linearised at ``joints``."""
        given = joints if self.attach is None else self.state(joints)
        return self.regression.estimate(time, given, self.frames)


@dataclass(frozen=True, eq=False)
class _Cluster:
    """Via-points so near to each other in time that they are conditioned on together.

    Parameters
    ----------
    times : tuple of float
        Ascending [s].
    asked : tuple of tuple of _Asked
        What is asked for at each.
    """

    times: tuple[float, ...]
    asked: tuple[tuple[_Asked, ...], ...]

    def also(self, time: float, asked: Sequence[_Asked]) -> Self:
        """With a later time."""
        return replace(self, times=(*self.times, time), asked=(*self.asked, tuple(asked)))

    def counts(self, time: Tensor, fade: float) -> bool:
        """Whether it moves anything at one of the times."""
        return any(bool(((time - at).abs() < fade).any()) for at in self.times)

    def condition(
        self, time: Tensor, fade: float, here: Estimate, look: _Look, moved: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """``e_t``, by how much the covariance becomes less, and ``e_a`` (..., A n)."""
        n, rounds = here.joints.shape[-1], FIRST if moved is None else LATER
        there = [look(time.new_tensor(at), here.joints) for at in self.times]
        free = torch.cat([one.joints for one in there], -1)
        postures = free if moved is None else free + moved
        for _ in range(rounds):
            postures = self._nearer(postures, n, fade, look)
        moved = postures - free
        spreads = [one.covariance.double() for one in there]
        prior = self._prior(spreads, fade)
        near = torch.stack(
            [self._correlation(time, at, fade) for at in self.times], -1
        ).double()
        between = [covariance_between(here.covariance.double(), one) for one in spreads]
        cross = torch.cat(
            [near[..., j, None, None].double() * c for j, c in enumerate(between)], -1
        )
        factor = gaussians.cholesky(prior, "the covariance between via-points")
        shift = cross @ torch.cholesky_solve(moved.double().unsqueeze(-1), factor)
        _, jacobian, noise = (x.double() for x in self._asks(postures, n, look))
        known = jacobian @ cross.mT
        square = _measured(jacobian, prior, noise)
        white = gaussians.whiten(square, known, "the covariance of via-points")
        like = here.joints
        return shift[..., 0].to(like), (white.mT @ white).to(like), moved

    def _nearer(self, postures: Tensor, n: int, fade: float, look: _Look) -> Tensor:
        """One linearisation of operators and via-points at postures (..., A n)."""
        parts = postures.split(n, -1)
        times = [postures.new_tensor(at) for at in self.times]
        there = [look(at, part) for at, part in zip(times, parts, strict=True)]
        prior = self._prior([one.covariance.double() for one in there], fade)
        mean = torch.cat([one.joints for one in there], -1)
        residual, jacobian, noise = (x.double() for x in self._asks(postures, n, look))
        square = _measured(jacobian, prior, noise)
        factor = gaussians.cholesky(square, "the covariance of via-points")
        away = (postures - mean).double()
        target = residual.unsqueeze(-1) + jacobian @ away.unsqueeze(-1)
        gain = prior @ jacobian.mT @ torch.cholesky_solve(target, factor)
        step = gain[..., 0] - away
        largest = step.abs().amax(-1, keepdim=True)
        step = step * (LARGEST / largest.clamp(min=LARGEST))
        moved = (postures + step.to(postures)).unflatten(-1, (-1, n))
        return look.regression.kinematics.retract(moved).flatten(-2)

    def _prior(self, spreads: Sequence[Tensor], fade: float) -> Tensor:
        """The covariance of the joints at all times, (..., A n, A n)."""
        rows = []
        for at, one in zip(self.times, spreads, strict=True):
            k = [self._correlation(one.new_tensor(at), other, fade) for other in self.times]
            parts = zip(k, spreads, strict=True)
            rows.append(torch.cat([x * covariance_between(one, two) for x, two in parts], -1))
        return torch.cat(rows, -2)

    @staticmethod
    def _correlation(time: Tensor, at: float, fade: float) -> Tensor:
        return wendland((time - at).abs() / fade)

    def _asks(self, postures: Tensor, n: int, look: _Look) -> tuple[Tensor, Tensor, Tensor]:
        """Displacements, Jacobians on a diagonal, and variances at postures (..., A n)."""
        residuals, jacobians, variances = [], [], []
        count = len(self.times)
        for i, asked in enumerate(self.asked):
            state = look.state(postures[..., i * n : (i + 1) * n])
            for one in asked:
                residual, jacobian = one.displacement(state, look.frames)
                residuals.append(residual)
                jacobians.append(
                    torch.nn.functional.pad(jacobian, (i * n, (count - 1 - i) * n))
                )
                variances.append(one.variances)
        return torch.cat(residuals, -1), torch.cat(jacobians, -2), torch.cat(variances)


def _measured(jacobian: Tensor, prior: Tensor, noise: Tensor) -> Tensor:
    """``J P J^T + R``, of which what is asked for exactly has a small share for R."""
    square = jacobian @ prior @ jacobian.mT
    least = EXACT * square.diagonal(dim1=-2, dim2=-1)
    return square + torch.maximum(noise, least).diag_embed()
