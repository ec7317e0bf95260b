r"""A linear-quadratic tracker: the controls that follow a path as precisely as it is known.

Of all controls of ``x_{t+1} = A x_t + B u_t`` it takes those of least cost

.. math:: \sum_t (x_t - \hat x_t)^T Q_t (x_t - \hat x_t) + u_t^T R\, u_t ,

with the precision of the fused Gaussian as ``Q_t``: errors that demonstrations have as well are
hardly worth a control (minimal intervention). The Riccati recursion goes backwards over the
horizon that the model knows, for a batch of paths at once.

S. Calinon: A Tutorial on Task-Parameterized Movement Learning and Retrieval, Intelligent
Service Robotics 9(1), 2016 (its section on linear-quadratic tracking); D. P. Bertsekas: Dynamic
Programming and Optimal Control, volume I; the stationary equation by doubling: E. K.-W. Chu,
H.-Y. Fan, W.-W. Lin, C.-S. Wang, International Journal of Control 77(8), 2004.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.exceptions import DataError, ShapeError

__all__ = ["LinearDynamics", "TrackingPlan", "stationary_cost"]

#: Doublings: of a horizon of 2^60 steps nothing is missing.
DOUBLINGS = 60


@dataclass(frozen=True, eq=False)
class LinearDynamics:
    """How a state of d numbers goes on under m controls: ``x_{t+1} = A x_t + B u_t``.

    Parameters
    ----------
    transition : Tensor of shape (..., d, d)
        The matrix A.
    control : Tensor of shape (..., d, m)
        The matrix B.

    Raises
    ------
    ShapeError
        If they do not fit each other.
    """

    transition: Tensor
    control: Tensor

    def __post_init__(self) -> None:
        a, b = self.transition, self.control
        if a.ndim < 2 or b.ndim < 2 or not a.shape[-2] == a.shape[-1] == b.shape[-2]:
            raise ShapeError(
                "dynamics have A of shape (..., d, d) and B of shape (..., d, m), got "
                f"{tuple(a.shape)} and {tuple(b.shape)}"
            )

    @classmethod
    def double_integrator(cls, n: int, dt: float, like: Tensor | None = None) -> Self:
        """Positions and velocities of ``n`` joints, accelerated by the controls.

        It is what is left of a robot whose inertia and bias forces are compensated: its torques
        are ``M(q) u`` plus gravity, Coriolis and centrifugal forces.

        Parameters
        ----------
        n : int
        dt : float
            Seconds for which a control is held.
        like : Tensor, optional
            Whose dtype and device the matrices have; else they are of float64.

        Raises
        ------
        DataError
            If ``dt`` is not positive.
        """
        if not 0 < dt < math.inf:
            raise DataError(f"dt is above 0 and finite, got {dt!r}")
        like = torch.empty(0, dtype=torch.float64) if like is None else like
        one = torch.eye(n, dtype=like.dtype, device=like.device)
        a = torch.eye(2 * n, dtype=like.dtype, device=like.device)
        a[:n, n:] = dt * one
        return cls(a, torch.cat((0.5 * dt**2 * one, dt * one)))


def stationary_cost(
    dynamics: LinearDynamics, state_cost: Tensor, control_cost: Tensor
) -> Tensor:
    r"""What it costs to be off a place of rest that lasts for ever, ``x^T P x``.

    The stabilising solution of :math:`P = Q + A^T P (A - B (R + B^T P B)^{-1} B^T P A)`.

    Parameters
    ----------
    dynamics : LinearDynamics
        Stabilisable, and observable through ``state_cost``.
    state_cost : Tensor of shape (..., d, d)
        Q, positive semi-definite.
    control_cost : Tensor of shape (..., m, m)
        R, positive definite.

    Returns
    -------
    Tensor of shape (..., d, d)

    Raises
    ------
    DataError
        If there is none.
    """
    a, b = dynamics.transition, dynamics.control
    g = b @ torch.cholesky_solve(b.mT, gaussians.cholesky(control_cost, "the cost of controls"))
    cost, identity = state_cost, torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
    for _ in range(DOUBLINGS):
        inverse = torch.linalg.inv(identity + g @ cost)
        more = _symmetric(a.mT @ cost @ inverse @ a)
        a, g = a @ inverse @ a, g + _symmetric(a @ inverse @ g @ a.mT)
        cost = cost + more
        if bool((more.abs().amax((-2, -1)) <= 1e-14 * cost.abs().amax((-2, -1))).all()):
            for _ in range(10):  # mends what doubling rounds off where controls are cheap
                cost = state_cost + _ahead(dynamics, cost, control_cost)[2]
            return cost
    raise DataError(
        "there is no stationary cost: the controls cannot bring the state to rest, or its cost "
        "does not notice all of it"
    )


@dataclass(frozen=True, eq=False)
class TrackingPlan:
    """Feedback and feedforward for each tick of a path, for a batch of paths.

    :meth:`along` makes one from a :class:`~tpgmm_torch.Trajectory`, or every now and then from
    the references and covariances that lie ahead of a running skill (those of a copy of its
    controller), which is a receding horizon.

    Parameters
    ----------
    targets : Tensor of shape (..., T, d)
        The states to be followed.
    gains : Tensor of shape (..., T, m, d)
        Of the feedback.
    feedforward : Tensor of shape (..., T, m)
        Controls without an error.
    """

    targets: Tensor
    gains: Tensor
    feedforward: Tensor

    def control(self, step: int, state: Tensor) -> Tensor:
        """``K_t (xhat_t - x) + f_t``, that of the last tick from then on.

        Parameters
        ----------
        step : int
            The tick t, from 0.
        state : Tensor of shape (..., d)
            Where the robots are.

        Returns
        -------
        Tensor of shape (..., m)
        """
        step = min(step, self.gains.shape[-3] - 1)
        error = (self.targets[..., step, :] - state).unsqueeze(-1)
        back = (self.gains[..., step, :, :] @ error).squeeze(-1)
        return back + self.feedforward[..., step, :]

    @classmethod
    def of(
        cls,
        dynamics: LinearDynamics,
        targets: Tensor,
        state_costs: Tensor,
        control_cost: Tensor,
        hold: bool = True,
    ) -> Self:
        """The plan of least cost.

        Parameters
        ----------
        dynamics : LinearDynamics
        targets : Tensor of shape (..., T, d)
        state_costs : Tensor of shape (..., T, d, d)
            Q_t, positive semi-definite.
        control_cost : Tensor of shape (..., m, m)
            R, positive definite.
        hold : bool
            Whether the last target, a place of rest then, lasts for ever; else nothing counts
            after it, and feedback fades out before.

        Raises
        ------
        ShapeError
            If the numbers of states or ticks differ.
        DataError
            If a cost is not definite, or the last target is no place of rest.
        """
        a, b = dynamics.transition, dynamics.control
        length, d = targets.shape[-2:]
        if d != a.shape[-1] or state_costs.shape[-3:] != (length, d, d) or not length:
            raise ShapeError(
                f"for {a.shape[-1]} states, targets have shape (..., T, d) and their costs "
                f"(..., T, d, d), got {tuple(targets.shape)} and {tuple(state_costs.shape)}"
            )
        # of what lies ahead: V(x) = x^T P x - 2 x^T p
        cost, pull = torch.zeros_like(a), torch.zeros_like(targets[..., -1, :, None])
        if hold:
            last = targets[..., -1, :, None]
            if not torch.allclose(a @ last, last, rtol=1e-6, atol=1e-9):
                raise DataError(
                    "the last target is to be held, and does not rest: end in a place of rest, "
                    "or give hold=False"
                )
            cost = stationary_cost(dynamics, state_costs[..., -1, :, :], control_cost)
            pull = cost @ last
        gains, feedforward = [], []
        for t in reversed(range(length)):
            target, here = targets[..., t, :, None], state_costs[..., t, :, :]
            gain, factor, cost = _ahead(dynamics, cost, control_cost)
            free = torch.cholesky_solve(b.mT @ pull, factor) - gain @ target
            gains.append(gain)
            feedforward.append(free.squeeze(-1))
            cost, pull = here + cost, here @ target + (a - b @ gain).mT @ pull
        return cls(targets, torch.stack(gains[::-1], -3), torch.stack(feedforward[::-1], -2))

    @classmethod
    def along(
        cls, joints: Tensor, covariance: Tensor, dt: float, effort: float | Tensor = 10.0
    ) -> Self:
        r"""The plan that follows a path of joints, of a robot that is a double integrator.

        Its states are positions and velocities, its controls accelerations. At the end of the
        path the last posture is held.

        Parameters
        ----------
        joints : Tensor of shape (..., T, n_joints)
            The path [rad].
        covariance : Tensor of shape (..., T, n_joints, n_joints)
            Theirs; its inverse is the cost of errors.
        dt : float
            Seconds between them.
        effort : float or Tensor of shape (n_joints,)
            The acceleration that costs as much as an error of one standard deviation
            [rad/s^2]: ``R = diag(effort)^-2``. In a path without end the stiffness is
            ``effort / sigma``, as that of :class:`~tpgmm_torch.Stiffness`.

        Raises
        ------
        ShapeError
            If there are not as many covariances as joint vectors.
        DataError
            If a covariance is singular, or ``dt`` or the effort is not positive.

        Examples
        --------
        >>> path = torch.linspace(0.0, 1.0, 50, dtype=torch.float64)[:, None]
        >>> variance = torch.full((50, 1, 1), 1e-4, dtype=torch.float64)
        >>> plan = TrackingPlan.along(path, variance, dt=0.02)
        >>> plan.control(0, torch.tensor([0.1, 0.0])).shape
        torch.Size([1])
        """
        n = joints.shape[-1]
        if covariance.shape[-3:] != (*joints.shape[-2:], n):
            raise ShapeError(
                f"a path of joints {tuple(joints.shape)} needs covariances of shape "
                f"{(*joints.shape, n)}, got {tuple(covariance.shape)}"
            )
        dynamics = LinearDynamics.double_integrator(n, dt, like=joints)
        factor = gaussians.cholesky(covariance, "the covariance of the path")
        costs = torch.nn.functional.pad(torch.cholesky_inverse(factor), (0, n, 0, n))
        speeds = torch.zeros_like(joints)
        speeds[..., :-1, :] = joints.diff(dim=-2) / dt
        weight = torch.as_tensor(effort).to(joints).expand(n)
        if not bool(((weight > 0) & weight.isfinite()).all()):
            raise DataError(f"effort is above 0 and finite, got {effort!r}")
        return cls.of(
            dynamics,
            torch.cat((joints, speeds), -1),
            costs,
            weight.square().reciprocal().diag(),
        )


def _ahead(
    dynamics: LinearDynamics, cost: Tensor, control_cost: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """One step of the Riccati recursion from the cost of the next state.

    The gain K, the Cholesky factor of R + B^T P B, and the cost of now without Q.
    """
    a, b = dynamics.transition, dynamics.control
    weighted = b.mT @ cost
    factor = gaussians.cholesky(weighted @ b + control_cost, "the cost of controls")
    gain = torch.cholesky_solve(weighted @ a, factor)
    return gain, factor, _symmetric(a.mT @ cost @ (a - b @ gain))


def _symmetric(matrix: Tensor) -> Tensor:
    """Without what rounding adds."""
    return (matrix + matrix.mT) / 2
