"""References that keep within limits, by what the Gaussian says of the other joints.

The most likely joints within bounds are those of

    minimise 1/2 (q - m)^T C^-1 (q - m)   such that   lower <= q <= upper,

a convex problem. Where the joints A stand at their bounds ``b``, the conditional Gaussian
``q = m + C_:A y`` with ``y = C_AA^-1 (b - m_A)`` solves it, and ``y`` is the gradient of the
objective in A: the set A is the right one if no joint is beyond a bound, no joint at an upper
bound has ``y > 0`` and none at a lower one ``y < 0``.
"""

from __future__ import annotations

import daqp
import numpy as np
import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.data.arrays import Array

__all__ = ["step_within", "within"]

#: So many robots are sooner solved one by one.
FEW = 8
#: How often all wrong joints are exchanged without a gain before one at a time is.
PATIENCE = 5
#: So many exchanges are enough but for covariances that rounding spoiled.
MOST = 100


def within(mean: Tensor, covariance: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """The most likely joints within bounds: exact, for each robot of a batch.

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
        If a covariance that is asked is singular.

    References
    ----------
    Júdice, Pires: A block principal pivoting algorithm for large-scale strictly monotone linear
    complementarity problems, Computers & Operations Research 21 (1994): what a batch runs.
    Arnström, Bemporad, Axehill: A dual active-set solver for embedded quadratic programming
    using recursive LDL^T updates, IEEE Transactions on Automatic Control 67 (2022): what one
    robot runs.
    """
    kept = torch.clamp(mean, lower, upper)
    if torch.equal(kept, mean):
        return mean
    lower, upper = torch.minimum(lower, upper).expand_as(mean), upper.expand_as(mean)
    some = (kept != mean).any(-1)  # of a batch, only these robots
    means, lowers, uppers = mean[some], lower[some], upper[some]
    covariances = covariance.expand(*mean.shape, -1)[some]
    with torch.no_grad():
        problem = means, covariances, lowers, uppers
        few = len(means) <= FEW and mean.device.type == "cpu"
        found = [_sides_of_one(*one) for one in zip(*problem, strict=True)] if few else [None]
        known = [one for one in found if one is not None]
        sides = torch.stack(known) if len(known) == len(means) else _sides(*problem)
    joints, _ = _standing(means, covariances, lowers, uppers, sides)
    whole = mean.clone()
    whole[some] = torch.clamp(joints, lowers, uppers)  # but for rounding
    return whole


def step_within(
    joints: Tensor, vector: Tensor, precision: Tensor, lower: Tensor, upper: Tensor
) -> Tensor:
    """Where a quadratic cost is least within bounds: exact, for each robot of a batch.

    What :func:`within` says of ``N(joints + precision^-1 vector, precision^-1)``, for those who
    know the precision. On a processor each robot is solved by itself, so that it does not
    depend on the others.

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
    there, left = torch.empty_like(joints), np.ones(joints.shape[:-1], bool)
    if joints.device.type == "cpu":
        numbers = (joints, vector, precision, lower.expand_as(joints), upper.expand_as(joints))
        q, v, p, low, high = (
            x.numpy(force=True).astype(np.float64, copy=False) for x in numbers
        )
        with np.errstate(all="ignore"):  # what is no number is left
            unit = 1 / np.sqrt(np.diagonal(p, axis1=-2, axis2=-1))
            scaled = p * unit[..., :, None] * unit[..., None, :]
            least, most = (np.minimum(low, high) - q) / unit, (high - q) / unit
            downhill = v * unit
        found = np.empty_like(q)
        for row in np.ndindex(*left.shape):
            solved = None
            if np.isfinite(scaled[row]).all() and np.isfinite(downhill[row]).all():
                solved = _solved(scaled[row], downhill[row], least[row], most[row])
            left[row] = solved is None
            found[row] = q[row] if solved is None else q[row] + unit[row] * solved[0]
        there = torch.from_numpy(found.clip(np.minimum(low, high), high)).to(joints)
    if left.any():
        rows = torch.from_numpy(left)
        factor = gaussians.cholesky(precision[rows], "the product")
        step = torch.cholesky_solve(vector[rows].unsqueeze(-1), factor).squeeze(-1)
        bounds = (bound.expand_as(joints)[rows] for bound in (lower, upper))
        covariance = torch.cholesky_inverse(factor)
        there[rows] = within(joints[rows] + step, covariance, *bounds)
    return there


def _standing(
    mean: Tensor, covariance: Tensor, lower: Tensor, upper: Tensor, sides: Tensor
) -> tuple[Tensor, Tensor]:
    """The joints given those that stand, 1 at upper and -1 at lower bounds, and gradients."""
    stands = sides != 0
    bound = torch.where(sides > 0, upper, torch.where(stands, lower, mean))
    identity = torch.eye(mean.shape[-1], dtype=torch.bool, device=mean.device)
    both = stands.unsqueeze(-1) & stands.unsqueeze(-2)
    block = torch.where(both, covariance, identity.to(mean))
    factor = gaussians.cholesky(block, "the product")
    gradient = torch.cholesky_solve((bound - mean).unsqueeze(-1), factor)
    joints = mean + (covariance @ gradient).squeeze(-1)
    return torch.where(stands, bound, joints), gradient.squeeze(-1)


def _sides(mean: Tensor, covariance: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Which joints stand at which bound, by block principal pivoting.

    All joints that are wrong change their state at once, as long as they become fewer; if they
    do not for a while, one at a time does, which ends for every positive definite covariance.
    """
    deviation = covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    tolerance = torch.finfo(mean.dtype).eps ** 0.6
    index = torch.arange(1, mean.shape[-1] + 1, device=mean.device)
    sides = torch.sign(mean - torch.clamp(mean, lower, upper))
    sides = torch.where(lower == upper, 1.0, sides)
    fewest = torch.full_like(mean[:, :1], torch.inf)
    patience = torch.full_like(fewest, PATIENCE)
    left = torch.arange(len(mean), device=mean.device)  # robots that are not done
    for _ in range(MOST):
        here = mean[left], covariance[left], lower[left], upper[left], sides[left]
        joints, gradient = _standing(*here)
        _, _, low, high, side = here
        pull = side * gradient * deviation[left]  # positive: it would rather leave its bound
        leaves = (pull > tolerance * pull.abs().amax(-1, keepdim=True)) & (low < high)
        slack = tolerance * deviation[left]
        beyond = (joints > high + slack).to(mean) - (joints < low - slack).to(mean)
        wrong = leaves | ((side == 0) & (beyond != 0))
        count = wrong.sum(-1, keepdim=True)
        fewer = count < fewest[left]
        fewest[left] = torch.where(fewer, count.to(fewest), fewest[left])
        patience[left] = torch.where(fewer, PATIENCE, patience[left] - 1)
        last = (index * wrong).amax(-1, keepdim=True) == index
        wrong = wrong & (last | (patience[left] >= 0))
        sides[left] = torch.where(wrong, torch.where(side == 0, beyond, 0.0), side)
        left = left[count[:, 0] > 0]
        if not len(left):
            break
    for row in left:  # by far the most need three exchanges
        other = _sides_of_one(mean[row], covariance[row], lower[row], upper[row])
        sides[row] = sides[row] if other is None else other
    return sides


def _sides_of_one(
    mean: Tensor, covariance: Tensor, lower: Tensor, upper: Tensor
) -> Tensor | None:
    """The same for one robot alone, by a solver that needs a tenth of the time.

    None if it finds no solution, or one that rounding spoiled.
    """
    m, c, low, high = (x.double().cpu().numpy() for x in (mean, covariance, lower, upper))
    deviation = np.sqrt(np.diag(c))
    if not deviation.all():
        return None
    try:
        unit_precision = np.linalg.inv(c / np.outer(deviation, deviation))
    except np.linalg.LinAlgError:
        return None
    low, high = (low - m) / deviation, (high - m) / deviation
    precision = np.asarray(unit_precision, dtype=np.float64)
    solved = _solved(precision, np.zeros_like(m), low, high)
    # its multipliers are positive at upper bounds
    return None if solved is None else torch.from_numpy(np.sign(solved[1])).to(mean)


def _solved(
    precision: Array, vector: Array, low: Array, high: Array
) -> tuple[Array, Array] | None:
    """The ``x`` of least ``x^T precision x / 2 - vector^T x`` within bounds, multipliers."""
    none = np.zeros((0, len(vector)))
    x, _, flag, info = daqp.solve(precision, -vector, none, high, low, primal_tol=1e-11)
    fits = (x <= high + 1e-9) & (x >= low - 1e-9)
    return (x, info["lam"]) if flag == 1 and fits.all() else None
