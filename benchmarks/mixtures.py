"""EM by this library and by others, from one start, for a given number of iterations.

Each function returns ``fit(n)``, which makes n iterations. All take one thread, and points in
the dtype that is measured, in the layout that they like best.
"""

import warnings
from collections.abc import Callable

import numpy as np
import torch
from sklearn.exceptions import ConvergenceWarning
from sklearn.mixture import GaussianMixture

from benchmarks.points import Problem
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture

__all__ = ["gmr", "ours", "pomegranate", "scikit_learn"]

Fit = Callable[[int], object]


def ours(problem: Problem, dtype: str = "float64", n_init: int = 1) -> Fit:
    """Fit with this library: blocks as they are, from the start given or from others."""
    points = problem.points.astype(dtype, copy=False)
    start = problem.start if n_init == 1 else None

    def fit(n: int) -> object:
        settings = {"blocks": problem.blocks, "tol": 0.0, "max_iter": n, "dtype": dtype}
        with warnings.catch_warnings(action="ignore"):
            mixture = BlockGaussianMixture(
                len(problem.weights), n_init=n_init, random_state=0, **settings
            )
            return mixture.fit(points, start=start)

    return fit


def scikit_learn(problem: Problem, dtype: str = "float64") -> Fit:
    """Fit with scikit-learn, full covariance of all columns in one block.

    The nearest of its covariance types: it has no blocks. Given precisions spare it k-means,
    rows are contiguous, and float32 points are computed with in float32.
    """
    points, means, covariances = problem.join_blocks(dtype)
    start = {
        "weights_init": problem.weights.astype(dtype),
        "means_init": means,
        "precisions_init": np.linalg.inv(covariances),
    }

    def fit(n: int) -> object:
        mixture = GaussianMixture(len(means), tol=0.0, max_iter=n, **start)
        with warnings.catch_warnings(action="ignore", category=ConvergenceWarning):
            return mixture.fit(points)

    return fit


def pomegranate(problem: Problem) -> Fit:
    """Fit with pomegranate, full covariance: tensors, the start given, no early end."""
    from pomegranate.distributions import Normal
    from pomegranate.gmm import GeneralMixtureModel

    points, means, covariances = map(torch.from_numpy, problem.join_blocks())
    weights = torch.from_numpy(problem.weights)

    def fit(n: int) -> object:
        components = [  # fitting changes them
            Normal(means=mean.clone(), covs=covariance.clone())
            for mean, covariance in zip(means, covariances, strict=True)
        ]
        mixture = GeneralMixtureModel(
            components, priors=weights.clone(), max_iter=n, tol=float("-inf")
        )
        return mixture.fit(points)

    return fit


def gmr(problem: Problem) -> Fit:
    """Fit with gmr, full covariances: the start given, no early end (R_diff = 0)."""
    from gmr import GMM

    points, means, covariances = problem.join_blocks()

    def fit(n: int) -> object:
        mixture = GMM(len(means), problem.weights.copy(), means.copy(), covariances.copy())
        return mixture.from_samples(points, R_diff=0.0, n_iter=n)

    return fit
