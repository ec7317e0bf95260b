"""Bundle adjustment: the state that explains what is seen, and the noise of corners and joints.

The noise of the joints is integrated out to first order: corners of one posture err together.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise, starmap

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.optimize import minimize
from torch import Tensor

from tpgmm_datasets.least_squares import levenberg_marquardt
from tpgmm_vision.calibration.reprojection import Reprojection
from tpgmm_vision.poses import Array

__all__ = ["Adjustment", "Noise", "adjust"]

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
    surprise : float
        Minus the logarithm of the likelihood, and of what is known before.
    """

    problem: Reprojection
    state: Array
    noise: Noise
    misfit: Array
    left: Array
    jacobian: Array
    surprise: float

    def covariance(self) -> Array:
        """Of the entries of a step (n_steps, n_steps), zero where they are not free."""
        free, found = self.problem.free, np.zeros((self.problem.n_steps,) * 2)
        weak = np.zeros(len(free))
        weak[: self.problem.offsets.start] = np.tile(
            np.repeat(POSE_PRIOR, 3) ** -2.0, self.problem.n_poses
        )
        jacobian = self.jacobian[:, free]
        normal = jacobian.T @ jacobian + np.diag(weak[free])
        found[np.ix_(free, free)] = np.linalg.inv(normal)
        return found

    def gain(self, columns: Array) -> tuple[float, Array, Array]:
        """What another cause would explain, to first order and with the noise left by it.

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
            left, jacobian = _whitened(problem, points[0].numpy(), whitening)  # noqa: B023
            free = jacobian[:, problem.free]
            return torch.as_tensor(left)[None], torch.as_tensor(free)[None]

        def retract(points: Tensor, step: Tensor) -> Tensor:
            whole = np.zeros(problem.n_steps)
            whole[problem.free] = step[0].numpy()
            return torch.as_tensor(problem.moved(points[0].numpy(), whole))[None]

        points, _ = levenberg_marquardt(residual, torch.as_tensor(state)[None], STEPS, retract)
        state = points[0].numpy()
        found, surprise = _noise(problem, state, weights, noise)
        misfit = _misfit(problem, state, found)
        if robust:
            weights = np.repeat((STUDENT + 8) / (STUDENT + 8 * misfit), 4)
        if abs(last - surprise) < SMALL_CHANGE:
            break
        last = surprise
    left, jacobian = _whitened(problem, state, _whitening(problem, state, found, weights))
    return Adjustment(problem, state, found, misfit, left, jacobian, surprise)


def _errors(problem: Reprojection, state: Array) -> tuple[Array, Array]:
    """How far corners are from where they are expected (N, 2), and its Jacobian."""
    pixels, jacobian, _ = problem.expected(state)
    return problem.corners.pixels - pixels, jacobian


def _whitening(
    problem: Reprojection, state: Array, noise: Noise, weights: Array
) -> list[tuple[slice, Array]]:
    """For the corners of each posture a matrix that makes their noise independent."""
    _, jacobian = _errors(problem, state)
    moved = noise.joints * jacobian[..., problem.offsets].reshape(2 * len(weights), -1)
    variance, made = noise.pixels**2 / np.repeat(weights, 2), []
    for own in starmap(slice, pairwise(2 * _starts(problem))):
        covariance = np.diag(variance[own]) + moved[own] @ moved[own].T
        made.append((own, np.linalg.inv(np.linalg.cholesky(covariance))))
    return made


def _starts(problem: Reprojection) -> NDArray[np.int_]:
    """Where the corners of each posture begin, and their number."""
    postures = problem.corners.posture
    changes = np.flatnonzero(np.diff(postures)) + 1
    return np.concatenate(([0], changes, [len(postures)]))


def _whitened(
    problem: Reprojection, state: Array, whitening: list[tuple[slice, Array]]
) -> tuple[Array, Array]:
    """Errors in units of their noise, and how steps lessen them."""
    errors, jacobian = _errors(problem, state)
    table = np.column_stack((errors.ravel(), jacobian.reshape(errors.size, -1)))
    table = np.concatenate([root @ table[own] for own, root in whitening])
    known, priors = _known(problem, state)
    prior = np.zeros((len(known), problem.n_steps))
    prior[:, problem.offsets.start :] = np.diag(1 / priors)
    left = np.concatenate((table[:, 0], -known / priors))
    return left, np.concatenate((table[:, 1:], prior))


def _known(problem: Reprojection, state: Array) -> tuple[Array, Array]:
    """Offsets and scales, and their standard deviations before what is seen tells."""
    counts = problem.robot.n_joints, len(problem.cameras) + 1
    return state[16 * problem.n_poses :], np.repeat((OFFSET_PRIOR, SCALE_PRIOR), counts)


def _noise(
    problem: Reprojection, state: Array, weights: Array, given: Noise | None
) -> tuple[Noise, float]:
    """The likeliest noise, or what is given, and minus the logarithm of the likelihood."""
    errors, jacobian = _errors(problem, state)
    by_joint = jacobian[..., problem.offsets].reshape(len(errors), 2, -1)
    starts = _starts(problem)[:-1]
    inner = np.einsum("ncj,nck,n->njk", by_joint, by_joint, weights)
    share = np.einsum("ncj,nc,n->nj", by_joint, errors, weights)
    values, vectors = np.linalg.eigh(np.add.reduceat(inner, starts))
    values = values.clip(0)
    share = np.einsum("kji,kj->ki", vectors, np.add.reduceat(share, starts)) ** 2
    total = float((weights[:, None] * errors**2).sum())

    def surprise(logs: Array) -> float:
        variance, ratio = np.exp(2 * logs[0]), np.exp(2 * (logs[1] - logs[0]))
        inside = 1 + ratio * values
        square = (total - (ratio * share / inside).sum()) / variance
        log_variances = errors.size * 2 * logs[0] - 2 * np.log(weights).sum()
        return float((log_variances + np.log(inside).sum() + square) / 2)

    if given is None:
        start, bounds = np.log([0.3, np.radians(0.5)]), np.log([PIXELS, JOINTS])
        logs = minimize(surprise, start, method="Nelder-Mead", bounds=bounds).x
        given = Noise(*np.exp(logs).tolist())
    known, priors = _known(problem, state)
    least = surprise(np.log([given.pixels, given.joints])) + ((known / priors) ** 2).sum() / 2
    return given, float(least)


def _misfit(problem: Reprojection, state: Array, noise: Noise) -> Array:
    """Mean square deviation of each tag in each picture, in units of what noise explains."""
    errors, jacobian = _errors(problem, state)
    errors = errors.reshape(-1, 8)
    moved = noise.joints * jacobian[..., problem.offsets].reshape(len(errors), 8, -1)
    covariance = noise.pixels**2 * np.eye(8) + moved @ moved.swapaxes(1, 2)
    solved = np.linalg.solve(covariance, errors[..., None])[..., 0]
    return np.asarray((errors * solved).mean(1))
