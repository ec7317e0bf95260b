"""Levenberg-Marquardt, for several starts at once."""

from collections.abc import Callable

import torch
from torch import Tensor


def levenberg_marquardt(
    residual: Callable[[Tensor], tuple[Tensor, Tensor]],
    start: Tensor,
    steps: int,
    retract: Callable[[Tensor, Tensor], Tensor] = torch.add,
) -> tuple[Tensor, Tensor]:
    """Minimise sums of squares by damped Gauss-Newton steps.

    Parameters
    ----------
    residual : callable
        Of points (S, d): residuals (S, n), and minus their Jacobian (S, n, p), how a step
        lessens them.
    start : Tensor of shape (S, d)
        Where each descent begins.
    steps : int
        How many are tried; those that do not lower a sum are not taken.
    retract : callable, default=torch.add
        Points after steps (S, p), where these are no plain sums.

    Returns
    -------
    points : Tensor of shape (S, d)
    cost : Tensor of shape (S,)
        Half the sum of squares there.
    """
    points, (left, jacobian) = start, residual(start)
    cost, damping = left.square().sum(-1) / 2, torch.ones_like(start[:, 0])
    for _ in range(steps):
        normal = jacobian.mT @ jacobian
        diagonal = normal.diagonal(dim1=-2, dim2=-1)
        ridge = damping[:, None] * diagonal + 1e-9 * diagonal.amax(-1, keepdim=True)
        gradient = jacobian.mT @ left[..., None]
        step = torch.linalg.solve(normal + torch.diag_embed(ridge), gradient)[..., 0]
        tried = retract(points, step)
        found = residual(tried)
        new_cost = found[0].square().sum(-1) / 2
        better = new_cost < cost
        points = torch.where(better[:, None], tried, points)
        left = torch.where(better[:, None], found[0], left)
        jacobian = torch.where(better[:, None, None], found[1], jacobian)
        cost = torch.where(better, new_cost, cost)
        damping = torch.where(better, damping / 5, damping * 5).clamp(1e-9, 1e9)
    return points, cost
