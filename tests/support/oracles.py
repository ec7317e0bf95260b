"""Dense float64 oracles in numpy, written from the paper and from nothing of ours.

One configuration at a time, loops over components and operators, explicit inverses. What they
share with the code under test is the state of the robot, whose poses and Jacobians have tests
of their own.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Pose = tuple[Array, Array]


@dataclass(frozen=True)
class At:
    """A robot at q_{t-1} and the objects around it."""

    joints: Array
    links: dict[str, Pose]
    jacobians: dict[str, Array]
    frames: dict[str, Pose]
    #: columns of the quaternions in the joint vector, where the poses themselves are the space
    quaternion_columns: dict[str, slice]


@dataclass(frozen=True)
class Row:
    """``J (q - q_{t-1}) = M mu + c``, a row of Table I."""

    jacobian: Array
    matrix: Array
    displacement: Array

    def linear_and_offset(self, joints: Array) -> tuple[Array, Array]:
        inverse = np.linalg.pinv(self.jacobian)
        return inverse @ self.matrix, inverse @ self.displacement + joints


def hamilton(a: Array, b: Array) -> Array:
    """Eq. (18)."""
    real = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate(([real], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])))


def conjugate(a: Array) -> Array:
    return a * np.array([1, -1, -1, -1])


def h_plus(a: Array) -> Array:
    """Eq. (20), left: ``a * b`` as a matrix times ``b``."""
    return np.stack([hamilton(a, unit) for unit in np.eye(4)], axis=1)


def h_bar_star(a: Array) -> Array:
    """Eq. (20), right, its lower three rows: ``vec(b * a)`` as a matrix times ``b``."""
    return np.stack([hamilton(unit, a) for unit in np.eye(4)], axis=1)[1:]


def rotation(a: Array) -> Array:
    return Rotation.from_quat(a, scalar_first=True).as_matrix()


def skew(a: Array) -> Array:
    return np.cross(a, np.eye(3)).T


def canonical(at: At) -> Row:
    n = len(at.joints)
    return Row(np.eye(n), np.eye(n), -at.joints)


def canonical_of(at: At, columns: Sequence[int]) -> Row:
    rows = np.eye(len(at.joints))[list(columns)]
    return Row(rows, np.eye(len(columns)), -at.joints[list(columns)])


def absolute_position(at: At, link: str) -> Row:
    return Row(at.jacobians[link][:3], np.eye(3), -at.links[link][0])


def relative_position(at: At, link: str, frame: str) -> Row:
    position, jacobian = at.links[link][0], at.jacobians[link][:3]
    if frame in at.frames:
        origin, orientation = at.frames[frame]
    else:
        origin, orientation = at.links[frame]
        moving = at.jacobians[frame]
        jacobian = jacobian - moving[:3] + skew(position - origin) @ moving[3:]
    return Row(jacobian, rotation(orientation), origin - position)


def absolute_orientation(at: At, link: str, gain: float = 2.0) -> Row:
    return _orientation(at, link, np.eye(4), gain)


def relative_orientation(at: At, link: str, frame: str, gain: float = 2.0) -> Row:
    if frame in at.frames:
        return _orientation(at, link, h_plus(at.frames[frame][1]), gain)
    jacobian = at.jacobians[link][3:] - at.jacobians[frame][3:]
    matrix = h_bar_star(conjugate(at.links[link][1])) @ h_plus(at.links[frame][1])
    return Row(jacobian, gain * matrix, np.zeros(3))


def _orientation(at: At, link: str, turn: Array, gain: float) -> Row:
    if link in at.quaternion_columns:
        columns = at.quaternion_columns[link]
        return Row(np.eye(len(at.joints))[columns], turn, -at.joints[columns])
    matrix = gain * h_bar_star(conjugate(at.links[link][1])) @ turn
    return Row(at.jacobians[link][3:], matrix, np.zeros(3))


def stack(*rows: Row) -> Row:
    """Side by side before the pseudo-inverse, as eqs (16), (17)."""
    matrix = np.zeros((sum(len(r.matrix) for r in rows), sum(r.matrix.shape[1] for r in rows)))
    at = np.zeros(2, dtype=int)
    for row in rows:
        end = at + row.matrix.shape
        matrix[at[0] : end[0], at[1] : end[1]] = row.matrix
        at = end
    return Row(
        np.concatenate([row.jacobian for row in rows]),
        matrix,
        np.concatenate([row.displacement for row in rows]),
    )


def equations_16_17(at: At, left: str, right: str, bottle: str) -> tuple[Array, Array]:
    """``A`` and ``b`` as printed, with the factor 2 of the orientations; a robot's only."""
    p, orientation = at.frames[bottle]
    (x_left, eps_left), (x_right, eps_right) = at.links[left], at.links[right]
    turn, h = rotation(orientation), h_plus(orientation)
    zero, narrow = np.zeros((3, 4)), np.zeros((3, 3))
    blocks = [
        [turn, zero, narrow, zero],
        [narrow, 2 * h_bar_star(conjugate(eps_left)) @ h, narrow, zero],
        [narrow, zero, turn, zero],
        [narrow, zero, narrow, 2 * h_bar_star(conjugate(eps_right)) @ h],
    ]
    j_up = np.linalg.pinv(np.vstack([at.jacobians[left], at.jacobians[right]]))
    target = np.concatenate([p - x_left, np.zeros(3), p - x_right, np.zeros(3)])
    return j_up @ np.block(blocks), j_up @ target + at.joints


@dataclass(frozen=True)
class Local:
    """The Gaussians of one operator over time and local coordinates."""

    means: Array  # (K, 1 + D)
    covariances: Array  # (K, 1 + D, 1 + D)


@dataclass(frozen=True)
class Answer:
    """What Gaussian mixture regression gives, and what it was mixed from."""

    mean: Array
    covariance: Array
    activation: Array
    component_means: Array


def with_wider_rest(local: Local, scales: Array) -> Local:
    """The covariance given time times ``sqrt(s_a s_b)``; what time explains stays."""
    widths = np.sqrt(scales)
    covariances = []
    for covariance in local.covariances:
        slope = covariance[1:, 0] / covariance[0, 0]
        explained = covariance[0, 0] * np.outer(slope, slope)
        wider = covariance.copy()
        wider[1:, 1:] = explained + np.outer(widths, widths) * (covariance[1:, 1:] - explained)
        covariances.append(wider)
    return Local(local.means, np.stack(covariances))


def mix(weights: Array, means: Array, covariances: Array) -> tuple[Array, Array]:
    """Mean and covariance of a mixture, from its second moment about zero."""
    mean = weights @ means
    second = sum(
        w * (c + np.outer(m, m)) for w, m, c in zip(weights, means, covariances, strict=True)
    )
    return mean, second - np.outer(mean, mean)


def normal(x: float, mean: float, variance: float) -> float:
    return float(np.exp(-0.5 * (x - mean) ** 2 / variance) / np.sqrt(2 * np.pi * variance))


def regress(
    time: float,
    joints: Array,
    rows: list[Row],
    mixtures: list[Local],
    weights: Array,
    *,
    activation: str,
    epsilon: float | None = None,
    prior_std: float | None = None,
) -> Answer:
    """Eqs (1), (2) over time *and* joints, and only then conditioning on time.

    With ``epsilon`` the projected Gaussians are multiplied as printed, ``epsilon I`` added to
    their joints; without it their information about (t, q) is summed, and ``prior_std`` closes
    the sum.
    """
    n = len(joints)
    h, means, covariances = [], [], []
    for k in range(len(weights)):
        precision = np.zeros((1 + n, 1 + n))
        vector = np.zeros(1 + n)
        for row, local in zip(rows, mixtures, strict=True):
            mean, covariance = local.means[k], local.covariances[k]
            if epsilon is not None:
                linear, offset = row.linear_and_offset(joints)
                grow = _beside_time(linear)
                mean = grow @ mean + np.concatenate(([0], offset))
                covariance = grow @ covariance @ grow.T + np.diag([0] + n * [epsilon])
                inverse = np.linalg.inv(covariance)
                precision += inverse
                vector += inverse @ mean
            else:
                grow, down = _beside_time(row.matrix), _beside_time(row.jacobian)
                known = row.displacement + row.jacobian @ joints
                weight = down.T @ np.linalg.inv(grow @ covariance @ grow.T)
                precision += weight @ down
                vector += weight @ (grow @ mean + np.concatenate(([0], known)))
        if prior_std is not None:
            precision[1:, 1:] += np.eye(n) / prior_std**2
            vector[1:] += joints / prior_std**2
        covariance = np.linalg.inv(precision)
        mean = covariance @ vector
        gain = covariance[1:, 0] / covariance[0, 0]
        means.append(mean[1:] + gain * (time - mean[0]))
        covariances.append(covariance[1:, 1:] - np.outer(gain, covariance[0, 1:]))
        at, spread = mean[0], covariance[0, 0]
        if activation == "time":
            at, spread = mixtures[0].means[k, 0], mixtures[0].covariances[k, 0, 0]
        h.append(weights[k] * normal(time, at, spread))
    share = np.array(h) / sum(h)
    mean, covariance = mix(share, np.array(means), np.array(covariances))
    return Answer(mean, covariance, share, np.array(means))


def candidate(
    time: float, joints: Array, row: Row, local: Local, activation: Array
) -> tuple[Array, Array]:
    """Eq. (1) for one operator: each component projected, conditioned on time, mixed."""
    linear, offset = row.linear_and_offset(joints)
    grow = _beside_time(linear)
    means, covariances = [], []
    for mean, covariance in zip(local.means, local.covariances, strict=True):
        mean = grow @ mean + np.concatenate(([0], offset))
        covariance = grow @ covariance @ grow.T
        gain = covariance[1:, 0] / covariance[0, 0]
        means.append(mean[1:] + gain * (time - mean[0]))
        covariances.append(covariance[1:, 1:] - np.outer(gain, covariance[0, 1:]))
    return mix(activation, np.array(means), np.array(covariances))


def _beside_time(matrix: Array) -> Array:
    """The same map for (t, x): time stays as it is."""
    grown = np.zeros((matrix.shape[0] + 1, matrix.shape[1] + 1))
    grown[0, 0] = 1
    grown[1:, 1:] = matrix
    return grown
