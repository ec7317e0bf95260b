r"""Stiffness and damping from a covariance: firm where demonstrations agree, soft elsewhere.

Minimal intervention: of all feedback :math:`u = K (\hat q - q) + D (\dot{\hat q} - \dot q)`
for the double integrator :math:`M \ddot q = u`, a linear-quadratic regulator takes the one of
least cost :math:`\int e^T \Sigma^{-1} e + u^T R\, u`: it leaves errors alone that the
demonstrations have as well. Its stationary Riccati equation asks for
:math:`K^T R\, K = \Sigma^{-1}`, which one symmetric positive definite matrix solves, the
geometric mean :math:`K = R^{-1} \# \Sigma^{-1}`; its damping is :math:`2 \zeta\, (M \# K)` with
:math:`\zeta = 1 / \sqrt 2`. For one joint, :math:`k = f / \sigma` with :math:`f = R^{-1/2}` the
effort that answers an error of one standard deviation.

S. Calinon: A Tutorial on Task-Parameterized Movement Learning and Retrieval, Intelligent
Service Robotics 9(1), 2016 (its section on minimal intervention control); damping by double
diagonalisation: A. Albu-Schäffer et al., ICRA 2003; geometric means of matrices: R. Bhatia,
Positive Definite Matrices, 2007, chapter 4.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.exceptions import DataError, ShapeError
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["Impedance", "Stiffness"]

Numbers = float | tuple[float, ...]


def geometric_mean(a: Tensor, b: Tensor) -> Tensor:
    r"""The mean :math:`A \# B` of matrices, the definite solution X of ``X A^-1 X = B``.

    Parameters
    ----------
    a : Tensor of shape (..., n, n)
        Symmetric positive definite.
    b : Tensor of shape (..., n, n)
        Symmetric positive semi-definite.

    Raises
    ------
    DataError
        If the first is not positive definite.

    Examples
    --------
    >>> a, b = torch.tensor([1.0, 4.0]).diag(), torch.tensor([4.0, 9.0]).diag()
    >>> [round(float(mean), 3) for mean in geometric_mean(a, b).diagonal()]
    [2.0, 6.0]
    """
    factor = gaussians.cholesky(a, "the first matrix of the mean (the inertia)")
    left = torch.linalg.solve_triangular(factor, b, upper=False)
    inner = torch.linalg.solve_triangular(factor, left.mT, upper=False)
    values, vectors = torch.linalg.eigh(inner)
    half = factor @ vectors * values.clamp_min(0).pow(0.25).unsqueeze(-2)
    return half @ half.mT


@dataclass(frozen=True)
class Stiffness:
    """How stiff to be for a covariance, in coordinates such as joints or a link's pose.

    The stiffness of least cost stands in series with one of ``highest - lowest`` and beside
    one of ``lowest``, as springs do: it is symmetric positive definite, within both bounds in
    every direction, and changes as smoothly as the covariance. Numbers are for all coordinates
    alike, or one for each.

    Parameters
    ----------
    lowest, highest : float or tuple of float
        Bounds [N m/rad, for coordinates in metres N/m].
    effort : float or tuple of float
        What answers an error of one standard deviation, before bounds [N m, N].
    inertia : float or tuple of float
        What has to be damped [kg m^2, kg].
    damping_ratio : float
        1 is critical; the least cost has 0.71.

    Raises
    ------
    DataError
        If a number is not finite and positive, or a highest below its lowest.
    ShapeError
        If tuples are of different lengths.

    Examples
    --------
    >>> rule = Stiffness(lowest=10.0, highest=500.0, effort=1.0)
    >>> deviation = torch.tensor([1e-6, 0.01, 1.0])
    >>> stiffness = rule.matrix(deviation.square().diag())
    >>> [round(float(k), 1) for k in stiffness.diagonal()]
    [499.8, 93.1, 11.0]
    """

    lowest: Numbers = 5.0
    highest: Numbers = 400.0
    effort: Numbers = 0.2
    inertia: Numbers = 0.1
    damping_ratio: float = math.sqrt(0.5)

    def __post_init__(self) -> None:
        lengths = {}
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            numbers = value if isinstance(value, tuple) else (value,)
            if not numbers or not all(0 < number < math.inf for number in numbers):
                raise DataError(f"{name} is above 0 and finite, got {value!r}")
            if isinstance(value, tuple):
                lengths[name] = len(value)
        if len(set(lengths.values())) > 1:
            raise ShapeError(f"one number for each coordinate; lengths differ: {lengths}")
        if bool((self._of("highest") < self._of("lowest")).any()):
            raise DataError(
                f"highest is not below lowest, got lowest={self.lowest!r}, "
                f"highest={self.highest!r}"
            )

    def matrix(self, covariance: Tensor) -> Tensor:
        """The stiffness for a covariance.

        Parameters
        ----------
        covariance : Tensor of shape (..., n, n)
            Positive semi-definite: directions without variance are as stiff as may be. One that
            is not finite gives the lowest stiffness.

        Returns
        -------
        Tensor of shape (..., n, n)
            Symmetric positive definite.
        """
        finite = covariance.isfinite().all(-1, keepdim=True).all(-2, keepdim=True)
        known = torch.where(finite, covariance, 0.0)
        lowest, highest, effort = (
            self._of(name, like=known) for name in ("lowest", "highest", "effort")
        )
        # compliance in units of the series spring: R # Sigma between its roots
        room = (highest - lowest).sqrt()
        values, vectors = torch.linalg.eigh(effort.unsqueeze(-1) * known * effort)
        half = (
            (room / effort).unsqueeze(-1)
            * vectors
            * values.clamp_min(0).pow(0.25).unsqueeze(-2)
        )
        identity = torch.eye(known.shape[-1], dtype=known.dtype, device=known.device)
        factor = torch.linalg.cholesky(identity + half @ half.mT)
        above = room.unsqueeze(-1) * torch.cholesky_inverse(factor) * room
        return torch.where(finite, above, 0.0) + lowest * identity

    def damping(self, stiffness: Tensor, inertia: Tensor | None = None) -> Tensor:
        r"""``2 zeta (M # K)``: each mode of inertia and stiffness has the damping ratio.

        Parameters
        ----------
        stiffness : Tensor of shape (..., n, n)
        inertia : Tensor of shape (..., n, n), optional
            The robot's own, in place of the rule's.
        """
        if inertia is None:
            inertia = torch.diag_embed(self._of("inertia", like=stiffness))
        return 2 * self.damping_ratio * geometric_mean(inertia, stiffness)

    def diagonal_damping(self, stiffness: Tensor) -> Tensor:
        """The same for motors that take one gain each: of ``stiffness`` (..., n), as is it."""
        return 2 * self.damping_ratio * (self._of("inertia", like=stiffness) * stiffness).sqrt()

    def check_size(self, size: int) -> None:
        """Refuse tuples that are not of ``size`` numbers.

        Raises
        ------
        ShapeError
        """
        for name in (field.name for field in fields(self)):
            value = getattr(self, name)
            if isinstance(value, tuple) and len(value) != size:
                raise ShapeError(f"{name} has {len(value)} numbers for {size} coordinates")

    def _of(self, name: str, like: Tensor | None = None) -> Tensor:
        """Of each coordinate (n,), or of all."""
        value = torch.as_tensor(getattr(self, name), dtype=torch.float64)
        return value if like is None else value.to(like).expand(like.shape[-1])


@dataclass(frozen=True)
class Impedance:
    """How stiff a robot is: in its joints, and its links in task space.

    Parameters
    ----------
    kinematics : Kinematics
        Of the robot.
    joints : Stiffness
        Of the joints.
    link : Stiffness
        Of a link's pose: displacement [m], then rotation vector [rad], in the base frame.

    Raises
    ------
    ShapeError
        If tuples have another length than the robot has joints, or 6 for a link.
    """

    kinematics: Kinematics
    joints: Stiffness = Stiffness()
    link: Stiffness = Stiffness(
        lowest=(100.0,) * 3 + (5.0,) * 3,
        highest=(2000.0,) * 3 + (100.0,) * 3,
        effort=(5.0,) * 3 + (0.5,) * 3,
        inertia=(2.0,) * 3 + (0.02,) * 3,
    )

    def __post_init__(self) -> None:
        self.joints.check_size(self.kinematics.n_joints)
        self.link.check_size(6)

    def at_link(self, link: str, joints: Tensor, covariance: Tensor) -> Tensor:
        """Stiffness of a link's pose, from ``J Sigma J^T``.

        Parameters
        ----------
        link : str
        joints : Tensor of shape (..., n_joints)
            Where the Jacobian is taken.
        covariance : Tensor of shape (..., n_joints, n_joints)
            Of the joints.

        Returns
        -------
        Tensor of shape (..., 6, 6)

        Raises
        ------
        UnknownNameError
            If the robot has no such link.
        """
        state = self.kinematics.state(joints)
        jacobian = torch.cat((state.linear_jacobian(link), state.angular_jacobian(link)), -2)
        return self.link.matrix(jacobian @ covariance @ jacobian.mT)
