"""References that keep within limits, by what the Gaussian says of the other joints.

The most likely joints within bounds are those of

    minimise 1/2 (q - m)^T C^-1 (q - m)   such that   lower <= q <= upper,

a convex problem. Where the joints A stand at their bounds ``b``, the conditional Gaussian
``q = m + C_:A C_AA^-1 (b - m_A)`` solves it; a quadratic program says which joints these are.

References
----------
Arnström, Bemporad, Axehill: A dual active-set solver for embedded quadratic programming using
recursive LDL^T updates, IEEE Transactions on Automatic Control 67 (2022): daqp, the solver.
"""

from __future__ import annotations

from dataclasses import replace

import daqp
import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.arrays import Array
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.regression.estimate import Estimate

#: Added to unit variances before they are inverted: rounding may have made them singular.
JITTER = 1e-12
#: What the solver says of a minimum, and of a precision that is not positive.
FOUND, NOT_CONVEX = 1, -5


def within(mean: Tensor, covariance: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Find the most likely joints within bounds: exact, for each robot of a batch.

    The other joints take over as the Gaussian says: clipping alone would move the hands away
    from where they are wanted.

    Parameters
    ----------
    mean : Tensor of shape (..., n_joints)
    covariance : Tensor of shape (..., n_joints, n_joints)
    lower, upper : Tensor of shape (..., n_joints)
        The lowest and the highest joints allowed; where they contradict each other, the joint
        stands at the upper one.

    Returns
    -------
    Tensor of shape (..., n_joints)
        ``mean`` itself where all joints are within.

    Raises
    ------
    DataError
        If the covariance of a robot beyond its bounds is singular.
    """
    kept = torch.clamp(mean, lower, upper)
    if torch.equal(kept, mean):
        return mean
    lower, upper = torch.minimum(lower, upper).expand_as(mean), upper.expand_as(mean)
    some = (kept != mean).any(-1)  # of a batch, only these robots
    means, lowers, uppers = mean[some], lower[some], upper[some]
    covariances = covariance.expand(*mean.shape, -1)[some]
    with torch.no_grad():
        deviation = covariances.diagonal(dim1=-2, dim2=-1).sqrt()
        unit = (covariances / deviation.unsqueeze(-1) / deviation.unsqueeze(-2)).double()
        unit.diagonal(dim1=-2, dim2=-1).add_(JITTER)
        precision = torch.cholesky_inverse(gaussians.cholesky(unit, "the product"))
        low, high = ((bound - means) / deviation for bound in (lowers, uppers))
        _, multipliers = _solve_program(precision, torch.zeros_like(means), low, high)
        sides = torch.from_numpy(np.sign(multipliers)).to(means)  # positive at upper bounds
    stands = sides != 0
    bound = torch.where(sides > 0, uppers, torch.where(stands, lowers, means))
    both = stands.unsqueeze(-1) & stands.unsqueeze(-2)
    identity = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
    factor = gaussians.cholesky(torch.where(both, covariances, identity), "the product")
    pull = torch.cholesky_solve((bound - means).unsqueeze(-1), factor)
    joints = torch.where(stands, bound, means + (covariances @ pull).squeeze(-1))
    whole = mean.clone()
    whole[some] = torch.clamp(joints, lowers, uppers)  # but for rounding
    return whole


def keep_within(estimate: Estimate, bounds: tuple[Tensor, Tensor] | None) -> Estimate:
    """Return an ``estimate`` given that joints keep within ``bounds``, if there are some."""
    if bounds is None:
        return estimate
    joints = within(estimate.joints, estimate.covariance, *bounds)
    return estimate if joints is estimate.joints else replace(estimate, joints=joints)


def step_within(
    joints: Tensor, vector: Tensor, precision: Tensor, lower: Tensor, upper: Tensor
) -> Tensor:
    """Minimise a quadratic cost within bounds: exact, for each robot of a batch.

    What :func:`within` says of ``N(joints + precision^-1 vector, precision^-1)``, for those who
    know the precision.

    Parameters
    ----------
    joints, vector : Tensor of shape (..., n_joints)
        Where the cost has that downhill gradient.
    precision : Tensor of shape (..., n_joints, n_joints)
        Its second derivative.
    lower, upper : Tensor of shape (..., n_joints)
        As for :func:`within`.

    Raises
    ------
    DataError
        If a precision is singular.
    """
    lower = torch.minimum(lower, upper)
    steps, _ = _solve_program(precision, vector, lower - joints, upper - joints)
    return torch.clamp(joints + torch.from_numpy(steps).to(joints), lower, upper)


def _solve_program(
    precision: Tensor, vector: Tensor, low: Tensor, high: Tensor
) -> tuple[Array, Array]:
    """Minimise ``x^T precision x / 2 - vector^T x`` within bounds; also return multipliers.

    Of unit precisions alone the solver finds it where the joints are far from equally stiff.
    """
    shape = vector.shape
    unit = precision.diagonal(dim1=-2, dim2=-1).rsqrt()
    precision = precision * unit.unsqueeze(-1) * unit.unsqueeze(-2)
    low, high = low.expand(shape) / unit, high.expand(shape) / unit
    numbers = (precision, vector * unit, low, high)
    h, f, least, most = (
        np.ascontiguousarray(x.numpy(force=True), dtype=np.float64) for x in numbers
    )
    if not (np.isfinite(h).all() and np.isfinite(f).all()):
        raise DataError("the product is not positive definite, or not finite")
    solution, multipliers = np.empty(shape), np.empty(shape)
    none = np.zeros((0, shape[-1]))
    for row in np.ndindex(*shape[:-1]):
        problem = h[row], -f[row], none, most[row], least[row]
        x, _, flag, info = daqp.solve(*problem, primal_tol=1e-11)
        if flag not in (FOUND, NOT_CONVEX):  # rounding hides which directions are soft
            stiffer = h[row] + 1e3 * JITTER * np.eye(shape[-1])
            x, _, flag, info = daqp.solve(stiffer, *problem[1:], primal_tol=1e-11)
        if flag != FOUND:
            raise DataError("the product is not positive definite: a larger reg_covar helps")
        solution[row], multipliers[row] = x, info["lam"]
    return solution * unit.numpy(force=True), multipliers
