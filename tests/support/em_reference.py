"""EM as the definition says, dense and in float64: a reference for passes over chunks.

Written with ``torch.distributions``, one component and one block after the other.
"""

import numpy as np
import torch
from torch.distributions import MultivariateNormal

from tpgmm_torch.mixture.expectation_maximization import CovarianceFamily, Parameters
from tpgmm_torch.mixture.points import Points
from tpgmm_torch.mixture.processes import ALONE
from tpgmm_torch.mixture.row_file import ColumnMoments

WIDTHS = (3, 4)


def points_of(X, dtype=torch.float64, widths=WIDTHS, group_size=1, n_components=10, rows=None):
    """Rows as EM sees them."""
    moments = ColumnMoments.of(X)
    scales = torch.from_numpy(moments.scales(widths, isotropic=False))
    units = torch.from_numpy(moments.mean), scales
    rows = X if rows is None else rows
    return Points(rows, *units, widths, n_components, dtype, group_size, ALONE)


def family(reg_covar=1e-6, covariance_type="full", widths=WIDTHS):
    diagonals = [torch.full((width,), reg_covar, dtype=torch.float64) for width in widths]
    return CovarianceFamily(covariance_type, tuple(diagonals))


def columns(points):
    """All points in their order, in float64, per block (n, D_j)."""
    rows = torch.cat([chunk[points.values] for chunk, _ in points], 1).T.double()
    return rows.split(points.widths, 1)


def reference_joint(parameters, blocks, group_size=1):
    """Log of weight times density, (n, K); rows of a group have the mean of theirs."""
    joint = []
    for k, weight in enumerate(parameters.weights):
        total = weight.log()
        for x, mean, own in zip(blocks, parameters.means, parameters.covariances, strict=True):
            total = total + MultivariateNormal(mean[k], own[k]).log_prob(x)
        joint.append(total)
    stacked = torch.stack(joint, 1).unflatten(0, (-1, group_size))
    return stacked.mean(1).repeat_interleave(group_size, 0)


def reference_step(parameters, blocks, family, group_size=1):
    """One iteration: the mixture after it, and the mean log-likelihood before it."""
    joint = reference_joint(parameters, blocks, group_size)
    gamma = torch.softmax(joint, 1)
    mass = gamma.sum(0)
    means, covariances = [], []
    for x, diagonal in zip(blocks, family.diagonals, strict=True):
        mean = gamma.T @ x / mass[:, None]
        own = [(g[:, None] * (x - m)).T @ (x - m) for g, m in zip(gamma.T, mean, strict=True)]
        covariance = torch.stack(own) / mass[:, None, None]
        covariances.append(family.restrict(covariance, mass / len(x)) + torch.diag(diagonal))
        means.append(mean)
    after = Parameters(mass / len(blocks[0]), tuple(means), tuple(covariances))
    return after, float(torch.logsumexp(joint, 1).mean())


def binned(points, family, n_components):
    """The Gaussians of equal stretches of the points, in their order."""
    blocks = columns(points)
    labels = torch.arange(len(blocks[0])) * n_components // len(blocks[0])
    means, covariances = [], []
    for x, diagonal in zip(blocks, family.diagonals, strict=True):
        parts = [x[labels == k] for k in range(n_components)]
        means.append(torch.stack([part.mean(0) for part in parts]))
        scatter = [torch.atleast_2d(torch.cov(part.T, correction=0)) for part in parts]
        covariances.append(torch.stack(scatter) + torch.diag(diagonal))
    weights = torch.bincount(labels).double() / len(labels)
    return Parameters(weights, tuple(means), tuple(covariances))


def movements(n_points=6000, noise=0.05, seed=0):
    """Ten noisy demonstrations with time in both blocks, sorted by time, (n, 7)."""
    rng = np.random.RandomState(seed)
    time = np.repeat(np.linspace(0, 1, n_points // 10), 10)
    phase = rng.rand(5) * 6
    curves = np.sin(rng.rand(5) * 12 * time[:, None] + phase)
    curves += noise * rng.randn(len(time), 5)
    return np.column_stack([time, curves[:, :2], time, curves[:, 2:]])


def nearly_singular():
    """Movements of which two columns differ by almost nothing."""
    X = movements(noise=1e-5)
    X[:, 2] = X[:, 1] + 1e-5 * np.random.RandomState(2).randn(len(X))
    return X


def assert_same_mixture(actual, expected, tolerance=1e-9):
    close = {"rtol": tolerance, "atol": tolerance}
    torch.testing.assert_close(actual.weights, expected.weights, **close)
    torch.testing.assert_close(actual.means, expected.means, **close)
    torch.testing.assert_close(actual.covariances, expected.covariances, **close)
