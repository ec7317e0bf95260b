r"""A linear-quadratic tracker: the controls that follow a path as precisely as it is known.

A robot whose inertia and bias torques are compensated is a double integrator,
``x_{t+1} = A x_t + B u_t`` with positions and velocities ``x`` and accelerations ``u``. Of
all controls the tracker takes those of least cost

    sum_t (x_t - x^_t)' Q_t (x_t - x^_t) + u_t' R u_t

with the precision of the fused Gaussian as ``Q_t``: errors that demonstrations have as well are
hardly worth a control (minimal intervention). The Riccati recursion goes backwards,

    K_t = (R + B' P_{t+1} B)^-1 B' P_{t+1} A,  P_t = Q_t + A' P_{t+1} (A - B K_t),
    u_t = (R + B' P_{t+1} B)^-1 B' p_{t+1} - K_t x_t,  p_t = Q_t x^_t + (A - B K_t)' p_{t+1},

from the stationary cost of holding the last posture for ever.

S. Calinon: A Tutorial on Task-Parameterized Movement Learning and Retrieval, Intelligent
Service Robotics 9(1), 2016; D. P. Bertsekas: Dynamic Programming and Optimal Control, volume I.

    python examples/linear_quadratic_tracking.py

prints how far a robot that begins 0.05 rad off is from the path of a bottle that is shaken, and
the controls that it takes, with the covariance of the model and with a hundredth of it.
"""

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are

from tpgmm_datasets.bottle.skill import BottleShaking, bottle_operators
from tpgmm_torch import Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping

Floats = NDArray[np.float64]


def double_integrator(n: int, dt: float) -> tuple[Floats, Floats]:
    """A (2n, 2n) and B (2n, n) of n joints whose accelerations are held for ``dt`` seconds."""
    one, zero = np.eye(n), np.zeros((n, n))
    a = np.block([[one, dt * one], [zero, one]])
    return a, np.concatenate((dt**2 / 2 * one, dt * one))


def track(
    joints: Floats, covariance: Floats, dt: float, effort: float = 10.0
) -> tuple[Floats, Floats]:
    """Gains K (T, n, 2n) and feedforward k (T, n): the control is ``k_t - K_t x_t``.

    Parameters
    ----------
    joints : ndarray of shape (T, n)
        The path [rad].
    covariance : ndarray of shape (T, n, n)
        Its covariance; the inverse is the cost of errors.
    dt : float
        Seconds between them.
    effort : float
        The acceleration that costs as much as an error of one standard deviation [rad/s^2].
    """
    length, n = joints.shape
    a, b = double_integrator(n, dt)
    r = np.eye(n) / effort**2
    q = np.zeros((length, 2 * n, 2 * n))
    q[:, :n, :n] = np.linalg.inv(covariance)
    speeds = np.diff(joints, axis=0, append=joints[-1:]) / dt
    targets = np.concatenate((joints, speeds), axis=1)
    cost = solve_discrete_are(a, b, q[-1], r)
    pull = cost @ targets[-1]
    gains, feedforward = np.empty((length, n, 2 * n)), np.empty((length, n))
    for t in reversed(range(length)):
        factor = r + b.T @ cost @ b
        gains[t] = np.linalg.solve(factor, b.T @ cost @ a)
        feedforward[t] = np.linalg.solve(factor, b.T @ pull)
        closed = a - b @ gains[t]
        pull = q[t] @ targets[t] + closed.T @ pull
        cost = q[t] + a.T @ cost @ closed
        cost = (cost + cost.T) / 2  # without rounding
    return gains, feedforward


def follow(
    joints: Floats, covariance: Floats, dt: float, offset: float = 0.05
) -> tuple[Floats, Floats]:
    """Joints (T, n) and controls (T, n) of a double integrator that begins off the path."""
    gains, feedforward = track(joints, covariance, dt)
    a, b = double_integrator(joints.shape[1], dt)
    state = np.concatenate((joints[0] + offset, np.zeros_like(joints[0])))
    states, controls = [], []
    for gain, constant in zip(gains, feedforward, strict=True):
        states.append(state)
        controls.append(constant - gain @ state)
        state = a @ state + b @ controls[-1]
    return np.array(states)[:, : joints.shape[1]], np.array(controls)


if __name__ == "__main__":
    skill = BottleShaking(rate=25)
    demonstrations = skill.demonstrations(6, seed=0)
    aligned = DynamicTimeWarping(features=["directions"]).fit_transform(demonstrations[:5])
    model = TaskParameterizedGMM(15, bottle_operators(), skill.robot).fit(aligned)
    [path] = model.predict([Situation.of(demonstrations[5])])
    step = float(path.time[1] - path.time[0])
    for name, share in (("the model's covariance", 1.0), ("a hundredth of it", 0.01)):
        found, controls = follow(path.joints.numpy(), share * path.covariance.numpy(), step)
        off = np.abs(found - path.joints.numpy()).max(1)
        print(
            f"{name:23} off by {off[0]:.3f} rad, after 1 s {off[round(1 / step)]:.4f} rad; "
            f"accelerations {np.sqrt(np.mean(controls**2)):.2f} rad/s^2 (root mean square)"
        )
