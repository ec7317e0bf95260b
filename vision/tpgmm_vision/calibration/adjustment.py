"""Bundle adjustment: the state that explains what is seen, and the noise of corners and joints.

The noise of the joints is integrated out to first order: corners of one posture err together.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, starmap

import numpy as np
import torch
from scipy.optimize import minimize
from torch import Tensor

from tpgmm_datasets.least_squares import levenberg_marquardt
from tpgmm_vision.calibration.reprojection import Integers, Reprojection
from tpgmm_vision.poses import Array

#: Standard deviations before what is seen tells: of offsets of joints [rad], and of scales of
#: focal lengths and of the size of tags. Makers' zeros are some degrees off, prints a percent.
OFFSET_PRIOR, SCALE_PRIOR = np.radians(3.0), 0.03
#: The same of poses [m, rad]: hardly anything, so that what is not seen is uncertain.
POSE_PRIOR = 1.0, 3.0
#: Bounds of what noise is found: of corners [pixels], and of joints [rad].
PIXELS, JOINTS = (0.03, 5.0), (np.radians(0.01), np.radians(5.0))
#: Degrees of freedom of Student's distribution, by whose weights wrong tags count little.
STUDENT = 5.0
#: A fit ends where half the sum of squares changes less, or after so many rounds, which find
#: the noise from the state, then the state, in so many steps, from the noise.
SMALL_CHANGE, ROUNDS, STEPS = 0.05, 12, 8


#: Rows of some corners, and the matrix that belongs to them.
Blocks = list[tuple[slice, Array]]


@dataclass(frozen=True)
class Noise:
    """Standard deviations of corners [pixels] and of joints [rad]."""

    pixels: float = 0.5
    joints: float = float(np.radians(1.0))


@dataclass(frozen=True, eq=False)
class Adjustment:
    """A fit.

    Parameters
    ----------
    problem : Reprojection
    state : ndarray
    noise : Noise
    misfit : ndarray of shape (N / 4,)
        Of each tag in each picture: mean square of its corners' deviations, in units of what
        noise explains.
    left, jacobian : ndarray of shape (n,) and (n, n_steps)
        Errors in units of their noise, 2 N of corners and those of offsets and scales from
        what is known before, and how steps lessen them.
    """

    problem: Reprojection
    state: Array
    noise: Noise
    misfit: Array
    left: Array
    jacobian: Array

    def covariance(self) -> Array:
        """Compute the covariance of a step (n_steps, n_steps), zero where it is not free."""
        problem, free = self.problem, self.problem.free
        found, weak = np.zeros((len(free), len(free))), np.zeros(len(free))
        poses = np.repeat(POSE_PRIOR, 3) ** -2.0
        weak[: problem.offsets.start] = np.tile(poses, problem.n_poses)
        jacobian = self.jacobian[:, free]
        normal = jacobian.T @ jacobian + np.diag(weak[free])
        found[np.ix_(free, free)] = np.linalg.inv(normal)
        return found

    def gain(self, columns: Array) -> tuple[float, Array, Array]:
        """Gain in likelihood by another cause, to first order and with the noise left by it.

        Parameters
        ----------
        columns : ndarray of shape (n, k)
            How steps of the cause lessen the errors.

        Returns
        -------
        gain : float
            By how much the logarithm of the likelihood rises.
        step, spread : ndarray of shape (k,)
            The likeliest step, and its standard deviations.
        """
        known, _ = np.linalg.qr(self.jacobian[:, self.problem.free])
        columns = columns - known @ (known.T @ columns)
        covariance = np.linalg.pinv(columns.T @ columns, hermitian=True)
        share = columns.T @ self.left
        explained = share @ covariance @ share / (self.left @ self.left)
        gain = -len(self.left) / 2 * float(np.log1p(-explained))
        return gain, covariance @ share, np.diag(covariance) ** 0.5


def adjust(
    problem: Reprojection, state: Array, noise: Noise | None = None, robust: bool = False
) -> Adjustment:
    """Fit the state, and the noise unless it is given.

    Parameters
    ----------
    problem : Reprojection
    state : ndarray
        Where to begin.
    noise : Noise, optional
        What it is; by default it is found.
    robust : bool, default=False
        Whether tags count less that do not fit.
    """
    corners, found, last = problem.corners, noise or Noise(), np.inf
    weights: Array = np.ones(len(corners.pixels))
    for _ in range(ROUNDS):
        whitening = _whitening(problem, state, found, weights)

        def residual(points: Tensor) -> tuple[Tensor, Tensor]:
            left, jacobian = _whiten(problem, points[0].numpy(), whitening)  # noqa: B023
            free = jacobian[:, problem.free]
            return torch.as_tensor(left)[None], torch.as_tensor(free)[None]

        def retract(points: Tensor, step: Tensor) -> Tensor:
            whole = np.zeros(problem.n_steps)
            whole[problem.free] = step[0].numpy()
            return torch.as_tensor(problem.move_state(points[0].numpy(), whole))[None]

        points, _ = levenberg_marquardt(residual, torch.as_tensor(state)[None], STEPS, retract)
        state = points[0].numpy()
        found, surprise = _noise(problem, state, weights, noise)
        misfit = _misfit(problem, state, found)
        if robust:
            weights = np.repeat((STUDENT + 8) / (STUDENT + 8 * misfit), 4)
        if abs(last - surprise) < SMALL_CHANGE:
            break
        last = surprise
    left, jacobian = _whiten(problem, state, _whitening(problem, state, found, weights))
    return Adjustment(problem, state, found, misfit, left, jacobian)


def _errors(problem: Reprojection, state: Array) -> tuple[Array, Array]:
    """Compute the errors of corners (N, 2) [pixels], and their Jacobian."""
    pixels, jacobian, _ = problem.expect_pixels(state)
    return problem.corners.pixels - pixels, jacobian


def _covariances(
    problem: Reprojection, jacobian: Array, noise: Noise, weights: Array, starts: Integers
) -> Blocks:
    """Compute the covariances of errors of corners from each start to the next [pixels^2]."""
    moved = noise.joints * jacobian[..., problem.offsets].reshape(2 * len(weights), -1)
    variance = noise.pixels**2 / np.repeat(weights, 2)
    blocks = starmap(slice, pairwise((2 * starts).tolist()))
    return [(own, np.diag(variance[own]) + moved[own] @ moved[own].T) for own in blocks]


def _whitening(problem: Reprojection, state: Array, noise: Noise, weights: Array) -> Blocks:
    """For the corners of each posture a matrix that makes their noise independent."""
    _, jacobian = _errors(problem, state)
    blocks = _covariances(problem, jacobian, noise, weights, _starts(problem))
    return [(own, np.linalg.inv(np.linalg.cholesky(block))) for own, block in blocks]


def _starts(problem: Reprojection) -> Integers:
    """Return where the corners of each posture begin, and their number."""
    postures = problem.corners.posture
    changes = np.flatnonzero(np.diff(postures)) + 1
    return np.concatenate(([0], changes, [len(postures)]))


def _whiten(problem: Reprojection, state: Array, whitening: Blocks) -> tuple[Array, Array]:
    """Errors in units of their noise, and how steps lessen them."""
    errors, jacobian = _errors(problem, state)
    table = np.column_stack((errors.ravel(), jacobian.reshape(errors.size, -1)))
    table = np.concatenate([root @ table[own] for own, root in whitening])
    known, priors = _prior_terms(problem, state)
    prior = np.zeros((len(known), problem.n_steps))
    prior[:, problem.offsets.start :] = np.diag(1 / priors)
    left = np.concatenate((table[:, 0], -known / priors))
    return left, np.concatenate((table[:, 1:], prior))


def _prior_terms(problem: Reprojection, state: Array) -> tuple[Array, Array]:
    """Offsets and scales, and their standard deviations before what is seen tells."""
    counts = problem.robot.n_joints, len(problem.cameras) + 1
    return state[16 * problem.n_poses :], np.repeat((OFFSET_PRIOR, SCALE_PRIOR), counts)


def _noise(
    problem: Reprojection, state: Array, weights: Array, given: Noise | None
) -> tuple[Noise, float]:
    """Return the likeliest or given noise, and minus the logarithm of the likelihood."""
    errors, jacobian = _errors(problem, state)
    errors, starts = errors.ravel(), _starts(problem)

    def surprise(logs: Array) -> float:
        blocks = _covariances(problem, jacobian, Noise(*np.exp(logs)), weights, starts)
        return sum(
            np.linalg.slogdet(block)[1] + errors[own] @ np.linalg.solve(block, errors[own])
            for own, block in blocks
        ) / 2  # fmt: skip

    if given is None:
        start, bounds = np.log([0.3, np.radians(0.5)]), np.log([PIXELS, JOINTS])
        logs = minimize(surprise, start, method="Nelder-Mead", bounds=bounds).x
        given = Noise(*np.exp(logs).tolist())
    known, priors = _prior_terms(problem, state)
    least = surprise(np.log([given.pixels, given.joints])) + ((known / priors) ** 2).sum() / 2
    return given, float(least)


def _misfit(problem: Reprojection, state: Array, noise: Noise) -> Array:
    """Mean square deviation of each tag in each picture, in units of what noise explains."""
    errors, jacobian = _errors(problem, state)
    errors, n = errors.ravel(), len(errors)
    blocks = _covariances(problem, jacobian, noise, np.ones(n), np.arange(0, n + 1, 4))
    return np.array([errors[own] @ np.linalg.solve(b, errors[own]) / 8 for own, b in blocks])
