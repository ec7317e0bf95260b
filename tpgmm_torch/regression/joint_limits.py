"""References that keep within limits, by what the Gaussian says of the other joints."""

from __future__ import annotations

import torch
from torch import Tensor

from tpgmm_torch import gaussians

__all__ = ["within"]


def within(mean: Tensor, covariance: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """The mean, given that joints beyond a bound stand at it.

    The other joints take over as the Gaussian says: clipping alone would move the hands away
    from where they are wanted. A joint that is driven over a bound by that joins the ones that
    stand, until none is left.

    Parameters
    ----------
    mean : Tensor of shape (..., n_joints)
    covariance : Tensor of shape (..., n_joints, n_joints)
    lower, upper : Tensor of shape (..., n_joints)
        The lowest and the highest joints allowed.

    Returns
    -------
    Tensor of shape (..., n_joints)
        ``mean`` itself where all joints are within.

    Raises
    ------
    DataError
        If a covariance that is asked is singular.
    """
    kept = torch.clamp(mean, lower, upper)
    if torch.equal(kept, mean):
        return mean
    lower, upper = lower.expand_as(mean), upper.expand_as(mean)
    some = (kept != mean).any(-1)  # of a batch, only these robots
    means, lowers, uppers = mean[some], lower[some], upper[some]
    precision = torch.cholesky_inverse(
        gaussians.cholesky(covariance.expand(*mean.shape, -1)[some], "the product")
    )
    joints, standing = means, torch.zeros_like(means, dtype=torch.bool)
    # bounds that contradict each other, of a robot that stands outside, end the loop too
    while bool((beyond := ~standing & ((joints < lowers) | (joints > uppers))).any()):
        standing = standing | beyond
        limit = torch.clamp(joints, lowers, uppers)
        # a joint that stands is known this many times better than the product knows it
        weight = torch.where(standing, 1e10 * precision.diagonal(dim1=-2, dim2=-1), 0.0)
        pull = (weight * (limit - means))[..., None]
        factor = gaussians.cholesky(precision + torch.diag_embed(weight), "the product")
        free = means + torch.cholesky_solve(pull, factor)[..., 0]
        joints = torch.where(standing, limit, free)
    whole = mean.clone()
    whole[some] = joints
    return whole
