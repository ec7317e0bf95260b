"""The update of :class:`TaskUpdate`, formulated for a compiler.

Libraries multiply and factorise matrices that stand in the last dimensions, one call for each
matrix; a compiler makes one loop of many formulas, fastest over what stands in the last
dimension and has no end: the B robots. The matrices of a robot have a few rows; products of
them are sums, and the factor of H is eliminated row by row, in the same loops.
"""

from __future__ import annotations

import torch
from torch import Tensor

from tpgmm_torch.operators import Linearization
from tpgmm_torch.regression.component_tables import Tables

__all__ = ["CompiledUpdate"]


class CompiledUpdate:
    """The joints' Gaussian, corrected by tasks; see :class:`TaskUpdate` for the formulas.

    Parameters
    ----------
    sides : Tensor of shape (m, D), optional
        Which coordinates are the quaternion that a row is about.
    """

    def __init__(self, sides: Tensor | None) -> None:
        self._sides = sides

    def __call__(
        self, tables: Tables, time: Tensor, at: Linearization, joints: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """References of B robots at one time.

        Parameters
        ----------
        tables : Tables
            Of A components.
        time : Tensor of shape ()
        at : Linearization
            With Jacobian (B, m, n), matrix (B, m, D) and present quaternions.
        joints : Tensor of shape (B, n)
            The joints q_{t-1}.

        Returns
        -------
        joints : Tensor of shape (n, B)
            Not a number where H is not positive definite.
        covariance : Tensor of shape (n, n, B)
        activation : Tensor of shape (K,)
        """
        assert at.jacobian is not None and at.matrix is not None and at.present is not None
        # each number of all robots side by side
        jacobian = at.jacobian.permute(2, 1, 0).contiguous()
        matrix = at.matrix.permute(2, 1, 0).contiguous()
        present, shift, joints = (
            x.T.contiguous() for x in (at.present, at.displacement, joints)
        )
        width = len(matrix)
        apart = time - tables.time_mean
        weights = torch.softmax(
            tables.log_weights - 0.5 * tables.time_precision * apart * apart, -1
        )
        mean = tables.mean + tables.gain * apart.unsqueeze(-1)  # (A, D + n)
        task, negative = mean[:, :width], mean[:, width:]

        # M mu and M S, J C and J (-m), of each component in turn: (A, D + 1, m, B) and so on
        n = len(jacobian)
        priors = tables.priors.view(-1, n, n)
        tasks = _mapped(tables.tasks.view(width, -1, width).transpose(0, 1), task, matrix)
        cross = _mapped(priors, negative, jacobian)
        h = (tasks[:, :-1].unsqueeze(3) * matrix.unsqueeze(1)).sum(1)  # (A, m, m, B)
        measured = tasks[:, -1]  # (A, m, B)
        if self._sides is not None:
            # a mean quaternion on the other side of the sphere is minus itself, as are its rows
            sides = (task.unsqueeze(1) * self._sides).unsqueeze(-1) * present  # (A, m, D, B)
            signs = torch.where(sides.sum(2) < 0, -1.0, 1.0)
            measured, h = measured * signs, h * signs.unsqueeze(1) * signs.unsqueeze(2)
        h = h + (cross[:, :-1].unsqueeze(3) * jacobian.unsqueeze(1)).sum(1)
        innovation = measured + cross[:, -1] + shift + (jacobian * joints.unsqueeze(1)).sum(0)

        right = torch.cat((cross[:, :-1].transpose(1, 2), innovation.unsqueeze(2)), 2)
        white = _whitened(torch.cat((h, right), 2).transpose(0, 1))  # (m, A, n + 1, B)
        gain, innovation = white[:, :, :-1], white[:, :, -1:]
        by_component = weights[:, None, None]  # (A, 1, 1)
        each = (gain * innovation).sum(0) - negative.unsqueeze(-1)  # (A, n, B)
        joints = (each * by_component).sum(0)
        # within the components C - G^T G, and between them: the law of total variance
        apart = each - joints
        covariance = (by_component * priors).sum(0).unsqueeze(-1)
        less = ((gain * by_component).unsqueeze(3) * gain.unsqueeze(2)).sum((0, 1))
        between = ((apart * by_component).unsqueeze(2) * apart.unsqueeze(1)).sum(0)
        activation = (weights.unsqueeze(-1) * tables.places).sum(0)
        return joints, covariance - less + between, activation


def _mapped(covariance: Tensor, mean: Tensor, rows: Tensor) -> Tensor:
    """``C R^T`` and ``mu R^T`` below it, (A, D + 1, m, B), of rows R^T (D, m, B)."""
    a, d = mean.shape
    m, batch = rows.shape[1:]
    both = torch.cat((covariance, mean.unsqueeze(1)), 1)  # (A, D + 1, D)
    if batch == 1:
        return (both.unsqueeze(-1) * rows.squeeze(-1)).sum(2).unsqueeze(-1)
    return (both.reshape(-1, d) @ rows.reshape(d, m * batch)).reshape(a, d + 1, m, batch)


def _whitened(matrix: Tensor) -> Tensor:
    """``L^-1 R`` of ``[H, R]`` (m, A, m + r, B), with H = L L^T: elimination, row by row."""
    rows = []
    for left in range(len(matrix), 0, -1):  # what is left of H
        row = matrix[0] * torch.rsqrt(matrix[0, :, :1])
        rows.append(row[:, left:])
        below = row[:, 1:left].transpose(0, 1).unsqueeze(2)
        matrix = matrix[1:, :, 1:] - below * row[:, 1:]
    return torch.stack(rows)
