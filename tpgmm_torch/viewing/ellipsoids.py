"""How sure a model is of where a link goes, as ellipsoids."""

from __future__ import annotations

import torch
from torch import Tensor

from tpgmm_torch import quaternions
from tpgmm_torch.robots.kinematics import RobotState

__all__ = ["STANDARD_DEVIATIONS", "ellipsoids"]

#: Half axes of the ellipsoids, in standard deviations.
STANDARD_DEVIATIONS = 2.0


def ellipsoids(state: RobotState, covariance: Tensor, link: str) -> tuple[Tensor, Tensor]:
    """Contours of the covariance of a link's position, ``J_p Sigma J_p^T`` to first order.

    Parameters
    ----------
    state : RobotState
        At the reproduction's joints, of leading shape (...).
    covariance : Tensor of shape (..., n_joints, n_joints)
        Of the joints, :attr:`Trajectory.covariance`.
    link : str

    Returns
    -------
    half_axes : Tensor of shape (..., 3)
        ``STANDARD_DEVIATIONS`` standard deviations along the principal axes, ascending [m].
    orientations : Tensor of shape (..., 4)
        Unit quaternions that turn x, y, z into the principal axes.
    """
    jacobian = state.linear_jacobian(link)
    variances, axes = torch.linalg.eigh(jacobian @ covariance @ jacobian.mT)
    # eigenvectors have a sign to choose: the one that makes them a rotation
    axes = torch.cat(
        (axes[..., :2], axes[..., 2:] * torch.linalg.det(axes)[..., None, None]), -1
    )
    half_axes = STANDARD_DEVIATIONS * variances.clamp(min=0).sqrt()
    return half_axes, quaternions.from_matrix(axes)
