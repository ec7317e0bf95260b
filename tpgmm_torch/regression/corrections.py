"""What measurements change about Gaussians: many small systems of equations at once.

A component that knows the joints with covariance C is told a task ``J q`` with the innovation
v. With ``H = L L^T`` the covariance of v and ``G = L^-1 J C``, its mean moves by ``G^T L^-1 v``
and its covariance shrinks by ``G^T G``. One robot has a few such systems, which a library
factorises one by one; of thousands, each step of the elimination is one operation, which takes
half as long.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tpgmm_torch import gaussians

__all__ = ["corrections"]

#: Systems at once from which the elimination is faster than the library.
MANY = 512


def corrections(
    h: Tensor, crossed: Tensor, innovation: Tensor, weights: Tensor, prior: Tensor
) -> tuple[Tensor, Tensor]:
    """The corrections of A components of B robots, by m measurements of n joints.

    Parameters
    ----------
    h : Tensor of shape (B, m A, m)
        H of the components: each of the m rows for all of them.
    crossed : Tensor of shape (B, m A, n)
        ``J C``, likewise.
    innovation : Tensor of shape (B, m, A)
    weights : Tensor of shape (A,) or (B, A)
        Of the components.
    prior : Tensor of shape (B, n, n) or (1, n, n)
        The covariances before, weighted and summed.

    Returns
    -------
    moves : Tensor of shape (B, A, n)
        By how much each mean moves.
    covariance : Tensor of shape (B, n, n)
        ``prior - sum_a w_a G_a^T G_a``.

    Raises
    ------
    DataError
        If a matrix H is not positive definite.
    """
    given = (h, crossed, innovation, weights, prior)
    n_systems = innovation.shape[0] * innovation.shape[2]
    if (
        h.dtype == torch.float32
        and n_systems >= MANY
        and not any(tensor.requires_grad for tensor in given)
    ):
        found = _eliminated(*given)
        if bool(found[0].isfinite().all()):
            return found
    return _factorized(*given)


def _factorized(
    h: Tensor, crossed: Tensor, innovation: Tensor, weights: Tensor, prior: Tensor
) -> tuple[Tensor, Tensor]:
    """By the library's factors, robots and components first; differentiable."""
    (b, m, a), n = innovation.shape, crossed.shape[-1]
    h = h.view(b, m, a, m).transpose(1, 2).reshape(b * a, m, m)
    right = torch.cat(
        (crossed.view(b, m, a, n).transpose(1, 2), innovation.mT.unsqueeze(-1)), -1
    ).view(b * a, m, n + 1)
    factor = gaussians.cholesky(h, "the covariance of the tasks")
    # transposed, so that the result is stored row by row
    white = torch.linalg.solve_triangular(factor.mT, right.mT, upper=True, left=False).mT
    gain, innovation = white.narrow(-1, 0, n), white.narrow(-1, n, 1)
    moves = torch.bmm(gain.mT, innovation).view(b, a, n)
    gain = gain.view(b, a, m, n)
    weighted = gain * weights.unsqueeze(-1).unsqueeze(-1)
    covariance = torch.baddbmm(
        prior, weighted.view(b, a * m, n).mT, gain.view(b, a * m, n), alpha=-1
    )
    return moves, covariance


def _eliminated(
    h: Tensor, crossed: Tensor, innovation: Tensor, weights: Tensor, prior: Tensor
) -> tuple[Tensor, Tensor]:
    """By elimination in place, the systems last; not finite where H is not definite."""
    (b, m, a), n = innovation.shape, crossed.shape[-1]
    system = h.new_empty(m, m + n + 1, a, b)  # [H, J C, innovation]
    system[:, :m] = h.view(b, m, a, m).permute(1, 3, 2, 0)
    system[:, m:-1] = crossed.view(b, m, a, n).permute(1, 3, 2, 0)
    system[:, -1] = innovation.permute(1, 2, 0)
    for k in range(m):
        row = system[k, k:]
        row *= row[0].rsqrt()
        system[k + 1 :, k + 1 :].addcmul_(row[1 : m - k].unsqueeze(1), row[1:], value=-1)
    gain, innovation = system[:, m:-1], system[:, -1:]
    moves = (gain * innovation).sum(0).permute(2, 1, 0).contiguous()
    # with the root of its weight, one matrix is both factors of the product
    gain *= weights.sqrt().reshape(-1, a).mT
    gain = gain.permute(3, 2, 0, 1).reshape(b, a * m, n)
    return moves, torch.baddbmm(prior, gain.mT, gain, alpha=-1)
