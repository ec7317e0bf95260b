r"""Rows of torque space: Gaussians of torques, fused as Gaussians of joints are.

With :math:`\tau = h(q, \dot q) + \tau'` each operator says ``T tau' = y`` with a covariance.
All rows of one link belong to one dynamically consistent inverse of its six-row Jacobian,
:math:`T = \Lambda J H^{-1}`, :math:`\Lambda = (J H^{-1} J^T)^{-1}`, so that a force asks for no
moment; rows of joints have ``T = I``. With the row ``J (q* - q) = M mu + c`` of the paper's
Table I,

    y = K (M mu + c) + D (M dmu/dt - J qd),   covariance K M Sigma M^T K^T.

J. Silverio, Y. Huang, L. Rozo, S. Calinon, D. G. Caldwell: Probabilistic Learning of Torque
Controllers from Kinematic and Force Constraints, IROS 2018, arXiv 1712.07249; dynamically
consistent inverse: O. Khatib, IEEE Journal of Robotics and Automation 3(1), 1987.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from tpgmm_control.impedance.stiffness import geometric_mean
from tpgmm_control.torque.gains import TorqueGains
from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Canonical, Operator, PoseOperator, Stack
from tpgmm_torch.operators.base import leaves, of_joints
from tpgmm_torch.operators.wrench import ExpectedForce, Wrench
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.robots.kinematics import RobotState

#: Directions in which links move by less than this share of what their axes suggest are given
#: up smoothly, as postures become singular (a ratio of eigenvalues, without a unit).
SINGULAR = 1e-3
#: Precision of the prior ``PRIOR H^-1`` around the torque that holds a robot [1/J].
PRIOR = 1e-9
#: Smallest share of contact of which a force has an effect.
LEAST_SHARE = 1e-3
#: Inverse of the largest mass and inertia of a link that count [1/kg, 1/(kg m^2)].
LEAST_MOBILITY = 1e-3

#: ``T`` (..., m, n), ``y`` (..., m, 1) [N m or N] and the covariance of rows ``T tau' = y``.
TorqueRows = tuple[Tensor, Tensor, Tensor]


@dataclass(frozen=True, eq=False)
class Mechanics:
    """Stiffness, damping and the inverses ``T`` of joints and links at one state.

    Coordinates are those of the n joints, and behind them six of each link (N in all).

    Parameters
    ----------
    mobility : Tensor of shape (..., N, N)
        ``H^-1``, and ``J H^-1 J^T`` of each link.
    consistent : Tensor of shape (..., N, n)
        ``T``.
    seen : Tensor of shape (..., N, N)
        ``T J^T``: the identity, but near singular postures.
    velocity : Tensor of shape (..., N)
        ``J qd``.
    stiffness, damping : Tensor of shape (..., N, N)
        Block by block.
    rate : Tensor of shape (...)
        The fastest of the damping [1/s].
    """

    mobility: Tensor
    consistent: Tensor
    seen: Tensor
    velocity: Tensor
    stiffness: Tensor
    damping: Tensor
    rate: Tensor

    @classmethod
    def at(
        cls,
        inertia: Tensor,
        jacobian: Tensor,
        velocities: Tensor,
        gains: TorqueGains,
        stiffness: Tensor | None = None,
    ) -> Mechanics:
        """At a state.

        Parameters
        ----------
        inertia : Tensor of shape (..., n, n)
        jacobian : Tensor of shape (..., 6 B, n)
            Of B links, one below the other.
        velocities : Tensor of shape (..., n)
            ``qd``.
        gains : TorqueGains
        stiffness : Tensor of shape (..., N, N), optional
            Of joints and links, by default that of the gains for this state.
        """

        def blocks(joints: Tensor, links: Tensor) -> Tensor:
            return gaussians.block_diagonal((joints, links), inertia.shape[:-2])

        inverse = torch.cholesky_inverse(gaussians.cholesky(inertia, "the inertia"))
        accelerations = jacobian @ inverse
        link = torch.arange(jacobian.shape[-2], device=jacobian.device) // 6
        own = accelerations @ jacobian.mT * (link[:, None] == link)
        masses, seen = _inverse(own)
        if stiffness is None:
            stiffness = blocks(*gains.stiffness(inertia, own))
        damping = 2 * gains.damping_ratio * geometric_mean(stiffness, blocks(inertia, masses))
        eye = torch.eye(inertia.shape[-1]).to(inertia)
        mobility = blocks(inverse, own)
        return cls(
            mobility,
            torch.cat((eye.expand_as(inertia), masses @ accelerations), -2),
            blocks(eye, seen),
            torch.cat((velocities, (jacobian @ velocities.unsqueeze(-1)).squeeze(-1)), -1),
            stiffness,
            damping,
            fastest(mobility @ damping),
        )

    @property
    def held(self) -> Tensor:
        """``-D_q qd`` (..., n), the torque of a robot that is held."""
        n = self.consistent.shape[-1]
        return -(self.damping[..., :n, :n] @ self.velocity[..., :n, None]).squeeze(-1)


def _inverse(mobility: Tensor) -> tuple[Tensor, Tensor]:
    """``L = (J H^-1 J^T)^-1`` (..., m, m), and the product of both.

    Directions along which a link hardly moves have eigenvalues ``a`` below :data:`SINGULAR`,
    once axes are scaled alike: ``a / SINGULAR^2`` in place of ``1 / a`` gives them up.
    """
    axes = mobility.diagonal(dim1=-2, dim2=-1)
    scale = axes.clamp_min(LEAST_MOBILITY).rsqrt()
    values, vectors = torch.linalg.eigh(scale.unsqueeze(-1) * mobility * scale.unsqueeze(-2))
    values = values.clamp_min(0)
    kept = (values / SINGULAR).square().clamp_max(1.0)
    left = scale.unsqueeze(-1) * vectors
    masses = left * (kept / torch.where(values > 0, values, 1.0)).unsqueeze(-2) @ left.mT
    return masses, left * kept.unsqueeze(-2) @ (vectors / scale.unsqueeze(-1)).mT


class LocalGaussians:
    """The local Gaussians of a mixture's operators over time, mixed, as rows of torques.

    Components are mixed by matching moments operator by operator, which commutes with the
    affine maps to torques; each operator is its own expert in the product that follows.

    Parameters
    ----------
    skill : Regression
        With operators of joints, of positions and quaternions of links as places or the base
        see them, their stacks, and of forces.
    gains : TorqueGains

    Raises
    ------
    DataError
        If there is an operator of another kind.
    """

    def __init__(self, skill: Regression, gains: TorqueGains) -> None:
        self.skill, self._kinematics, like = skill, skill.kinematics, skill.kinematics.lower
        with torch.inference_mode(False):
            self._conditionals = Conditionals.stack(skill.scaled_conditionals)
        self._stack = Stack(*of_joints(skill.operators))
        self._starts = self._stack.quaternion_starts(skill.kinematics)
        noise, links = list[float](), dict[str, None]()
        labels = list[tuple[int, ...]]()  # operator, leaf, block and coordinate
        for leaf in leaves(skill.operators):
            links |= dict.fromkeys(leaf.links())
        self._links, asked = tuple(links), set[int]()
        for expert, operator in enumerate(skill.operators):
            for leaf in leaves([operator]):
                rows, at = self._rows(leaf), len(labels)
                asked.update(rows)
                if isinstance(leaf, Wrench):
                    continue
                block = 0 if isinstance(leaf, Canonical) else rows[0]
                labels += [(expert, at, block, row) for row in rows]
                turns = getattr(leaf, "gain", None) is not None
                tolerance = gains.frame_turn_tolerance if turns else gains.frame_tolerance
                noise += [tolerance * bool(leaf.references())] * len(rows)
        expert_of, leaf_of, block_of, self._index = torch.tensor(labels).T.to(like.device)
        same = expert_of == expert_of[:, None]
        # two operators of one stack may both have the position of one link
        apart = (leaf_of != leaf_of[:, None]) & (block_of == block_of[:, None])
        self._same_expert, self._coupled = same.to(like), (same & ~apart).to(like)
        self._noise = torch.tensor(noise).to(like).square().diag()
        behind = range(len(like), len(like) + 6 * len(links))
        self._asked = torch.tensor([row in asked for row in behind]).to(like)[:, None]

    def _rows(self, leaf: Operator) -> list[int]:
        """Where the rows of an operator are among the coordinates of :class:`Mechanics`."""
        if isinstance(leaf, Canonical):
            return list(leaf.columns(self._kinematics.joint_names))
        moves = {*leaf.links()[1:], *leaf.references()} & {*self._kinematics.links}
        other = moves or leaf.rotation_vector_starts(self._kinematics)
        if not isinstance(leaf, Wrench) and (not isinstance(leaf, PoseOperator) or other):
            raise DataError(
                f"{leaf!r} has no rows in torque space: there are those of Canonical, of "
                "positions and quaternions seen from a place, their stacks, and Wrench"
            )
        first = self.first_row(leaf.link) + 3 * (getattr(leaf, "gain", None) is not None)
        return [first, first + 1, first + 2]

    def first_row(self, link: str) -> int:
        """Where the six coordinates of a link begin."""
        return self._kinematics.n_joints + 6 * self._links.index(link)

    def jacobian(self, state: RobotState) -> Tensor:
        """Jacobians (..., 6 B, n) of links; zero where nobody asks for a position, or a turn.

        Parameters
        ----------
        state : RobotState
        """
        places = [state.links.index(link) for link in self._links]
        return state.jacobians[..., places, :, :].flatten(-3, -2) * self._asked

    def mixed(self, time: Tensor, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Means (..., D), their time derivatives and covariances of the local coordinates.

        Parameters
        ----------
        time : Tensor of shape () or (...)
        present : Tensor of shape (..., D)
            Present coordinates, to the side of which quaternions are brought.
        """
        one, marginals = self._conditionals, self.skill.marginals
        weights = self.skill.weights_at(time)
        mean, gain, covariance = one.at(time), one.gain, one.covariance
        if self._starts:
            signs = quaternions.hemisphere_signs(mean, present.unsqueeze(-2), self._starts)
            mean, gain = signs * mean, signs * gain
            covariance = signs[..., None] * covariance * signs[..., None, :]
        slopes = marginals.precision * (marginals.mean - time.unsqueeze(-1))
        rates = weights * (slopes - (weights * slopes).sum(-1, keepdim=True))
        speed = (weights.unsqueeze(-1) * gain + rates.unsqueeze(-1) * mean).sum(-2)
        center, spread = gaussians.moment_match(weights, mean, covariance)
        return center, speed, spread

    def rows(
        self,
        time: Tensor,
        pace: Tensor,
        state: RobotState,
        frames: Mapping[str, Frame],
        mechanics: Mechanics,
    ) -> TorqueRows:
        """The rows of all operators but forces at a state.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            In the skill [s].
        pace : Tensor of shape () or (...)
            How fast that time passes: 1 as in the demonstrations, 0 where it stands.
        state : RobotState
        frames : mapping of str to Frame
        mechanics : Mechanics
            Of :meth:`jacobian`.
        """
        at = self._stack.linearize(state, frames)
        present = at.present
        if present is None:
            present = self._stack.coordinates(state, frames) if self._starts else state.joints
        mean, speed, covariance = self.mixed(time, present)
        _, matrix = at.dense()
        step = matrix @ mean.unsqueeze(-1) + at.displacement.unsqueeze(-1)
        moving = pace[..., None, None] * (matrix @ speed.unsqueeze(-1))
        spread = matrix @ covariance @ matrix.mT * self._same_expert
        index = self._index
        stiffness, damping, seen = (
            whole[..., index, :][..., index] * self._coupled
            for whole in (mechanics.stiffness, mechanics.damping, mechanics.seen)
        )
        error = moving - mechanics.velocity[..., index, None]
        targets = seen @ (stiffness @ step + damping @ error)
        covariance = stiffness @ (spread + self._noise) @ stiffness.mT
        return mechanics.consistent[..., index, :], targets, covariance


def fastest(rates: Tensor) -> Tensor:
    """Largest eigenvalue (...) [1/s].

    Parameters
    ----------
    rates : Tensor of shape (..., m, m)
        ``H^-1 D``.
    """
    return torch.linalg.eigvals(rates).real.amax(-1)


def force_row(
    one: ExpectedForce,
    axes: Tensor,
    integral: Tensor | float,
    first: int,
    mechanics: Mechanics,
    gains: TorqueGains,
) -> tuple[TorqueRows, Tensor]:
    r"""Rows of an expected force along axes ``e``: ``e^T T tau' = f - D_f e^T v + integral``.

    Where only a share :math:`\kappa` of the demonstrations is in contact, the variance grows
    by :math:`(f_c^2 + c^2) (1 - \kappa) / \kappa`, with :math:`f_c = f / \kappa` the force in
    contact and ``c`` that at which contact begins: at even odds a force is as uncertain as it
    is large.

    Parameters
    ----------
    one : ExpectedForce
    axes : Tensor of shape (..., n_axes, 3)
        In the base frame, :meth:`Wrench.directions`.
    integral : Tensor of shape (..., n_axes)
        Of the error of the force [N].
    first : int
        Where the coordinates of the link begin.
    mechanics : Mechanics
    gains : TorqueGains

    Returns
    -------
    rows : TorqueRows
    rate : Tensor of shape (...)
        Of their own damping [1/s].
    """
    rows, share = slice(first, first + 3), one.share.clamp_min(LEAST_SHARE)[..., None]
    mobility = axes @ mechanics.mobility[..., rows, rows] @ axes.mT
    masses = 1 / mobility.diagonal(dim1=-2, dim2=-1).clamp_min(LEAST_MOBILITY)
    damping = 2 * gains.damping_ratio * (gains.contact_stiffness * masses).sqrt()
    speed = (axes @ mechanics.velocity[..., rows, None]).squeeze(-1)
    targets = (one.force + integral - damping * speed).unsqueeze(-1)
    force = one.force.square().sum(-1, keepdim=True) / share.square()
    noise = (force + one.operator.contact**2) * (1 - share) / share
    targets = axes @ mechanics.seen[..., rows, rows] @ axes.mT @ targets
    covariance = one.covariance + noise.expand_as(one.force).diag_embed()
    consistent = axes @ mechanics.consistent[..., rows, :]
    return (consistent, targets, covariance), (damping / masses).amax(-1)


def fused_torque(rows: Sequence[TorqueRows], mechanics: Mechanics) -> tuple[Tensor, Tensor]:
    """Mean (..., n) and covariance (..., n, n) of the product of all rows, and of a prior.

    Parameters
    ----------
    rows : sequence of TorqueRows
    mechanics : Mechanics
        The prior, which counts where no row does, is the torque of a robot that is held, with
        the precision ``PRIOR H^-1``.
    """
    n = mechanics.consistent.shape[-1]
    precision = PRIOR * mechanics.mobility[..., :n, :n]
    vector = precision @ mechanics.held.unsqueeze(-1)
    for one in rows:
        more, towards, _ = gaussians.information(*one)
        precision, vector = precision + more, vector + towards
    torque, covariance = gaussians.from_information(precision, vector.squeeze(-1))
    return torque, covariance
