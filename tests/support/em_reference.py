"""EM as the definition says, dense and in float64: what the fast passes are compared with.

Written with whitening by triangular solution, one component and one block after the other.
"""

import numpy as np
import torch

from tpgmm_torch.em import expectation_maximization
from tpgmm_torch.em.column_moments import ColumnMoments
from tpgmm_torch.em.covariance_family import CovarianceFamily
from tpgmm_torch.em.parameters import Parameters
from tpgmm_torch.em.points import StoredPoints, standardized_chunks

WIDTHS = (3, 4)


def standardized(X, dtype=torch.float64, widths=WIDTHS, group_size=1, n_components=10):
    """Points as EM sees them, and the units they are in."""
    units = ColumnMoments.of(X).standardization(widths, isotropic=False)
    return StoredPoints(standardized_chunks(X, units, n_components, dtype, group_size)), units


def family(units, reg_covar=1e-6, covariance_type="full", dtype=torch.float64):
    return CovarianceFamily.regularized(
        covariance_type, units, reg_covar, relative=True, dtype=dtype
    )


def columns(points):
    """All points of a source in float64, per block (n, D_j)."""
    blocks = zip(*points, strict=True)
    return [torch.cat([part[:-1] for part in block], 1).T.double() for block in blocks]


def reference_joint(parameters, blocks):
    """Log of weight times density, (n, K)."""
    joint = []
    for k, weight in enumerate(parameters.weights):
        total = weight.log()
        for x, mean, factor in zip(blocks, parameters.means, parameters.factors, strict=True):
            y = torch.linalg.solve_triangular(factor[k], (x - mean[k]).T, upper=False)
            size = torch.log(factor[k].diagonal() * np.sqrt(2 * np.pi)).sum()
            total = total - y.square().sum(0) / 2 - size
        joint.append(total)
    return torch.stack(joint, 1)


def reference_step(parameters, blocks, family, group_size=1):
    """One iteration: the mixture after it, and the mean log-likelihood before it."""
    joint = reference_joint(parameters, blocks)
    joint = joint.unflatten(0, (-1, group_size)).mean(1).repeat_interleave(group_size, 0)
    gamma = torch.softmax(joint, 1)
    mass = gamma.sum(0)
    means, covariances = [], []
    for x, diagonal in zip(blocks, family.diagonals, strict=True):
        mean = gamma.T @ x / mass[:, None]
        scatter = [
            (g[:, None] * (x - m)).T @ (x - m) for g, m in zip(gamma.T, mean, strict=True)
        ]
        covariance = torch.stack(scatter) / mass[:, None, None]
        covariances.append(family.restrict(covariance, mass / len(x)) + torch.diag(diagonal))
        means.append(mean)
    after = Parameters.from_covariances(mass / len(blocks[0]), means, covariances)
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
    return Parameters.from_covariances(weights, means, covariances)


def movements(n_points=6000, noise=0.05, seed=0):
    """Ten noisy demonstrations with time in both blocks, sorted by time, (n, 7)."""
    rng = np.random.RandomState(seed)
    time = np.repeat(np.linspace(0, 1, n_points // 10), 10)
    phase = rng.rand(5) * 6
    curves = np.sin(rng.rand(5) * 12 * time[:, None] + phase)
    curves += noise * rng.randn(len(time), 5)
    return np.column_stack([time, curves[:, :2], time, curves[:, 2:]])


def assert_same_mixture(actual, expected, tolerance=1e-9):
    """Equal parameters, covariances as seen by the narrowest directions' deviations."""
    torch.testing.assert_close(actual.weights, expected.weights, rtol=0, atol=tolerance)
    close = {"rtol": tolerance, "atol": tolerance}
    for own, other in zip(actual.means, expected.means, strict=True):
        torch.testing.assert_close(own, other, **close)
    for own, other in zip(actual.covariances, expected.covariances, strict=True):
        torch.testing.assert_close(own, other, **close)


def counted_passes(monkeypatch):
    """A list to which each pass over the points adds how many mixtures it serves."""
    passes = []
    e_step = expectation_maximization.e_step

    def counted(parameters, *arguments, **settings):
        passes.append(len(parameters.weights))
        return e_step(parameters, *arguments, **settings)

    monkeypatch.setattr(expectation_maximization, "e_step", counted)
    return passes


def one(parameters):
    """A mixture as a stack of one."""
    return Parameters.stack([parameters])


def m_step(expectation, family, floored=False):
    """The M step of a pass for one mixture."""
    flags = torch.full((len(expectation.bound),), floored)
    return expectation_maximization.m_step(expectation, family, flags)[0]


def random_mixture(seed=0, count=4, widths=(2, 3)):
    """Weights, means and covariances drawn at random."""
    rng = np.random.RandomState(seed)
    roots = [torch.from_numpy(rng.randn(count, width, width)) for width in widths]
    return Parameters.from_covariances(
        torch.from_numpy(rng.dirichlet(np.ones(count))),
        [torch.from_numpy(rng.randn(count, width)) for width in widths],
        [root @ root.mT + 0.1 * torch.eye(len(root[0])) for root in roots],
    )
