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
from typing import Any

import torch
from torch import Tensor
from torch.nn.functional import pad

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.impedance.stiffness import geometric_mean
from tpgmm_torch.operators import (
    Canonical,
    Operator,
    PoseOperator,
    RelativeOrientation,
    RelativePosition,
    Stack,
)
from tpgmm_torch.operators.base import of_joints
from tpgmm_torch.operators.pose import linearize_poses
from tpgmm_torch.operators.stack import leaves
from tpgmm_torch.operators.wrench import ExpectedForce, Wrench
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.torque.gains import TorqueGains

__all__ = [
    "Body",
    "LocalGaussians",
    "Mechanics",
    "TorqueRows",
    "fastest",
    "force_axes",
    "force_row",
    "fused_torque",
    "jacobians",
]

#: Directions in which links move by less than this share of what their axes suggest are given
#: up smoothly, as postures become singular (a ratio of eigenvalues, without a unit).
SINGULAR = 1e-3
#: Precision of the prior ``PRIOR H^-1`` around the torque that holds a robot [1/J].
PRIOR = 1e-9
#: Variance that stands for none, of rows between things that no joint moves [m^2, rad^2].
FREE = 1e12
#: Smallest share of contact of which a force has an effect.
LEAST_SHARE = 1e-3
#: Inverse of the largest mass and inertia of a link that count [1/kg, 1/(kg m^2)].
LEAST_MOBILITY = 1e-3

#: A link, or an object, that moves; what it is seen from, where that moves too; whether that is
#: an object that is held.
Body = tuple[str, str | None, bool]


@dataclass(frozen=True, eq=False)
class Mechanics:
    """Stiffness, damping and the inverses ``T`` of joints and links at one state.

    Coordinates are those of the joints, and behind them six of each link (N in all).

    Parameters
    ----------
    inverse : Tensor of shape (..., n, n)
        ``H^-1``.
    mobility : Tensor of shape (..., B, 6, 6)
        ``J H^-1 J^T`` of each link.
    consistent : Tensor of shape (..., N, n)
        ``T``.
    seen : Tensor of shape (..., N, N)
        ``T J^T``: the identity, but near singular postures.
    velocity : Tensor of shape (..., N)
        ``J qd``.
    stiffness, damping : Tensor of shape (..., N, N)
        Block by block.
    held : Tensor of shape (..., n)
        ``-D_q qd``, the torque of a robot that is held.
    rate : Tensor of shape (...)
        The fastest of the damping [1/s].
    """

    inverse: Tensor
    mobility: Tensor
    consistent: Tensor
    seen: Tensor
    velocity: Tensor
    stiffness: Tensor
    damping: Tensor
    held: Tensor
    rate: Tensor

    @classmethod
    def at(
        cls,
        inertia: Tensor,
        jacobians: Tensor,
        velocities: Tensor,
        gains: TorqueGains,
        stiffness: tuple[Tensor, Tensor] | None = None,
    ) -> Mechanics:
        """At a state.

        Parameters
        ----------
        inertia : Tensor of shape (..., n, n)
        jacobians : Tensor of shape (..., B, 6, n)
            Of each link.
        velocities : Tensor of shape (..., n)
            ``qd``.
        gains : TorqueGains
        stiffness : tuple of Tensor of shapes (..., n, n) and (..., B, 6, 6), optional
            Of joints and links, by default those of the gains for this state.
        """
        inverse = torch.cholesky_inverse(gaussians.cholesky(inertia, "the inertia"))
        accelerations = jacobians @ inverse.unsqueeze(-3)
        mobility = accelerations @ jacobians.mT
        masses, seen = _inverse(mobility)
        if stiffness is None:
            stiffness = gains.joint_stiffness(inertia), gains.link_stiffness(mobility)
        joint, link = stiffness
        twice = 2 * gains.damping_ratio
        joint_damping = twice * geometric_mean(inertia, joint)
        link_damping = twice * geometric_mean(link, masses)
        rates = [
            fastest(inverse @ joint_damping).unsqueeze(-1),
            fastest(mobility @ link_damping),
        ]
        eye = torch.eye(inertia.shape[-1]).to(inertia).expand_as(inertia)
        turned = (jacobians @ velocities[..., None, :, None]).flatten(-3)
        return cls(
            inverse,
            mobility,
            torch.cat((eye, (masses @ accelerations).flatten(-3, -2)), -2),
            _blocks(eye, seen),
            torch.cat((velocities, turned), -1),
            _blocks(joint, link),
            _blocks(joint_damping, link_damping),
            -(joint_damping @ velocities.unsqueeze(-1)).squeeze(-1),
            torch.cat(rates, -1).amax(-1),
        )


def _inverse(mobility: Tensor) -> tuple[Tensor, Tensor]:
    """``L = (J H^-1 J^T)^-1`` (..., 6, 6), and the product of both.

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


def _blocks(first: Tensor, others: Tensor) -> Tensor:
    """Matrices (..., n, n) and (..., B, 6, 6) on the diagonal of one."""
    n, count = first.shape[-1], others.shape[-3]
    apart = torch.eye(count).to(first)[:, None, :, None]
    second = (others.unsqueeze(-2) * apart).flatten(-2).flatten(-3, -2)
    more = 6 * count
    return pad(first, (0, more, 0, more)) + pad(second, (n, 0, n, 0))


@dataclass(frozen=True, eq=False)
class TorqueRows:
    """Rows ``T tau' = y``.

    Parameters
    ----------
    consistent : Tensor of shape (..., m, n)
        ``T``.
    targets : Tensor of shape (..., m)
        ``y`` [N m or N].
    covariance : Tensor of shape (..., m, m)
    rate : Tensor of shape (...), optional
        Of a damping of its own, beside that of the mechanics [1/s].
    """

    consistent: Tensor
    targets: Tensor
    covariance: Tensor
    rate: Any = 0.0


class LocalGaussians:
    """The local Gaussians of a mixture's operators over time, mixed, as rows of torques.

    Components are mixed by matching moments operator by operator, which commutes with the
    affine maps to torques; each operator is its own expert in the product that follows.

    Parameters
    ----------
    skill : Regression
        With operators of joints, and of positions and orientations of links, and their stacks.
    gains : TorqueGains

    Raises
    ------
    DataError
        If there is an operator of another kind.
    """

    def __init__(self, skill: Any, gains: TorqueGains) -> None:
        kinematics: Kinematics = skill.kinematics
        operators = of_joints(skill.operators)
        with torch.inference_mode(False):
            self.conditionals = Conditionals.stacked(skill.fused)
        self.skill, self.marginals, self.stack = skill, skill.marginals, Stack(*operators)
        self._starts = self.stack.quaternion_starts(kinematics)
        self._kinematics = kinematics
        #: What the rows of :class:`Mechanics` are of: which of the six are asked for.
        self.bodies = _bodies(skill)
        index: list[int] = []
        self._tangents: list[tuple[int, Any]] = []
        labels, noise = [], []  # operator, leaf and three coordinates that rows belong to
        for expert, operator in enumerate(operators):
            for leaf in leaves([operator]):
                rows = self._rows(leaf)
                block = 0 if isinstance(leaf, Canonical) else rows[0]
                labels += [(expert, len(index), block)] * len(rows)
                noise += [_tolerance(leaf, kinematics, gains)] * len(rows)
                if leaf.rotation_vector_starts(kinematics):
                    self._tangents.append((len(index), leaf))
                index += rows
        like = kinematics.lower
        self.index = torch.tensor(index, device=like.device)
        self.noise = torch.tensor(noise).to(like).square()
        expert_of, leaf_of, block_of = torch.tensor(labels).T.unsqueeze(-1)
        same = expert_of == expert_of.mT
        # two operators of one stack may both have the position of one link
        apart = (leaf_of != leaf_of.mT) & (block_of == block_of.mT)
        self.same_expert, self.coupled = same.to(like), (same & ~apart).to(like)

    def _rows(self, leaf: Operator) -> list[int]:
        """Where the rows of an operator are among the coordinates of :class:`Mechanics`."""
        if isinstance(leaf, Canonical):
            return list(leaf.columns(self._kinematics.joint_names))
        assert isinstance(leaf, PoseOperator)
        body = list(self.bodies).index(_body(leaf, self._kinematics))
        first = self._kinematics.n_joints + 6 * body + 3 * (leaf.gain is not None)
        return [first, first + 1, first + 2]

    def mixed(self, time: Tensor, present: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Means (..., D), their time derivatives and covariances of the local coordinates.

        Parameters
        ----------
        time : Tensor of shape () or (...)
        present : Tensor of shape (..., D)
            Present coordinates, to the side of which quaternions are brought.
        """
        one, marginals, weights = self.conditionals, self.marginals, self.skill.weights_at(time)
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
        """The rows of all operators at a state.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            In the skill [s].
        pace : Tensor of shape () or (...)
            How fast that time passes: 1 as in the demonstrations, 0 where it stands.
        state : RobotState
        frames : mapping of str to Frame
        mechanics : Mechanics
            Of :attr:`bodies`.
        """
        stack = self.stack.at(time)
        at = stack.linearize(state, frames)
        present = at.present
        if present is None:
            present = stack.coordinates(state, frames) if self._starts else state.joints
        mean, speed, covariance = self.mixed(time, present)
        _, matrix = at.dense()
        mean, speed = matrix @ mean.unsqueeze(-1), matrix @ speed.unsqueeze(-1)
        step, moving = mean + at.displacement.unsqueeze(-1), pace[..., None, None] * speed
        if self._tangents:
            turns = self._turns(at.displacement, state, frames)
            step, moving, matrix = turns @ step, turns @ moving, turns @ matrix
        spread = matrix @ covariance @ matrix.mT * self.same_expert
        noise = self.noise if at.noise is None else self.noise + FREE * at.noise
        spread = spread + noise.diag_embed()
        stiffness, damping, seen = (
            whole[..., self.index, :][..., self.index] * self.coupled
            for whole in (mechanics.stiffness, mechanics.damping, mechanics.seen)
        )
        error = moving - mechanics.velocity[..., self.index, None]
        targets = seen @ (stiffness @ step + damping @ error)
        return TorqueRows(
            mechanics.consistent[..., self.index, :],
            targets.squeeze(-1),
            stiffness @ spread @ stiffness.mT,
        )

    def _turns(
        self, displacement: Tensor, state: RobotState, frames: Mapping[str, Frame]
    ) -> Tensor:
        """From tangent spaces to the base frame (..., m, m), by the transposed factor of ``J``.

        ``J = J_r(y)^-1 R(eps)^T J_o``: the torque of the potential ``k |mu - y|^2 / 2`` is
        ``J_o^T R(eps) J_r(y)^-T k (mu - y)``, however large the turn.
        """
        m = displacement.shape[-1]
        turns = torch.eye(m).to(displacement).repeat(*displacement.shape[:-1], 1, 1)
        for at, leaf in self._tangents:
            rows = slice(at, at + 3)
            rotation = quaternions.to_matrix(leaf.poses(state, frames)[0].orientation)
            inverse = quaternions.inverse_left_jacobian(displacement[..., rows])
            turns[..., rows, rows] = rotation @ inverse.mT
        return turns


def jacobians(
    bodies: Mapping[Body, tuple[bool, bool]], state: RobotState, frames: Mapping[str, Frame]
) -> Tensor:
    """Jacobians (..., B, 6, n) of links and objects, in the base frame.

    Parameters
    ----------
    bodies : mapping of Body to tuple of two bool
        Whether positions and turns are asked for; rows are zero where they are not.
    state : RobotState
    frames : mapping of str to Frame
    """
    found = []
    for (link, frame, held), (place, turn) in bodies.items():
        if frame is not None:
            both = (
                RelativePosition(link, frame, held=held),
                RelativeOrientation(link, frame, held=held),
            )
            jacobian = linearize_poses(both, state, frames).jacobian
            assert jacobian is not None
        elif link in state.links:
            jacobian = state.jacobian(link)
        else:  # an object that is free
            jacobian = torch.zeros_like(state.jacobians[..., 0, :, :])
        found.append(jacobian * torch.tensor([place] * 3 + [turn] * 3).to(jacobian)[:, None])
    if not found:
        return state.jacobians[..., :0, :, :]
    return torch.stack(torch.broadcast_tensors(*found), -3)


def fastest(rates: Tensor) -> Tensor:
    """Largest eigenvalue (...) [1/s].

    Parameters
    ----------
    rates : Tensor of shape (..., m, m)
        ``H^-1 D``.
    """
    return torch.linalg.eigvals(rates).real.amax(-1)


def force_axes(operator: Wrench, state: RobotState, frames: Mapping[str, Frame]) -> Tensor:
    """The axes ``e^T`` (..., n_axes, 3) of a force, in the base frame.

    Parameters
    ----------
    operator : Wrench
    state : RobotState
    frames : mapping of str to Frame
    """
    rotation = quaternions.to_matrix(operator.pose(state, frames).orientation)
    return rotation.mT[..., list(operator.axes or ()), :]


def force_row(
    one: ExpectedForce,
    axes: Tensor,
    integral: Tensor | float,
    body: int,
    mechanics: Mechanics,
    gains: TorqueGains,
) -> TorqueRows:
    r"""Rows of an expected force along axes ``e``: ``e^T T tau' = f - D_f e^T v + integral``.

    Where only a share :math:`\kappa` of the demonstrations is in contact, the variance grows
    by :math:`(f_c^2 + c^2) (1 - \kappa) / \kappa`, with :math:`f_c = f / \kappa` the force in
    contact and ``c`` that at which contact begins: at even odds a force is as uncertain as it
    is large.

    Parameters
    ----------
    one : ExpectedForce
    axes : Tensor of shape (..., n_axes, 3)
    integral : Tensor of shape (..., n_axes)
        Of the error of the force [N].
    body : int
        Which one of the mechanics the link is.
    mechanics : Mechanics
    gains : TorqueGains
    """
    first = mechanics.inverse.shape[-1] + 6 * body
    rows, share = slice(first, first + 3), one.share.clamp_min(LEAST_SHARE)[..., None]
    mobility = axes @ mechanics.mobility[..., body, :3, :3] @ axes.mT
    masses = 1 / mobility.diagonal(dim1=-2, dim2=-1).clamp_min(LEAST_MOBILITY)
    damping = 2 * gains.damping_ratio * (gains.contact_stiffness * masses).sqrt()
    speed = (axes @ mechanics.velocity[..., rows, None]).squeeze(-1)
    targets = (one.force + integral - damping * speed).unsqueeze(-1)
    force = one.force.square().sum(-1, keepdim=True) / share.square()
    noise = (force + one.operator.contact**2) * (1 - share) / share
    return TorqueRows(
        axes @ mechanics.consistent[..., rows, :],
        (axes @ mechanics.seen[..., rows, rows] @ axes.mT @ targets).squeeze(-1),
        one.covariance + noise.expand_as(one.force).diag_embed(),
        (damping / masses).amax(-1),
    )


def fused_torque(rows: Sequence[TorqueRows], mechanics: Mechanics) -> tuple[Tensor, Tensor]:
    """Mean (..., n) and covariance (..., n, n) of the product of all rows, and of a prior.

    Parameters
    ----------
    rows : sequence of TorqueRows
    mechanics : Mechanics
        The prior, which counts where no row does, is the torque of a robot that is held, with
        the precision ``PRIOR H^-1``.
    """
    precision = PRIOR * mechanics.inverse
    vector = precision @ mechanics.held.unsqueeze(-1)
    for one in rows:
        more, towards, _ = gaussians.information(
            one.consistent, one.targets.unsqueeze(-1), one.covariance
        )
        precision, vector = precision + more, vector + towards
    factor = gaussians.cholesky(precision, "the precision of the torques")
    return torch.cholesky_solve(vector, factor).squeeze(-1), torch.cholesky_inverse(factor)


def _bodies(skill: Any) -> dict[Body, tuple[bool, bool]]:
    """What the operators of a skill ask for: positions and turns of each body."""
    bodies: dict[Body, tuple[bool, bool]] = {}
    for leaf in leaves(skill.operators):
        turns = isinstance(leaf, PoseOperator) and leaf.gain is not None
        if isinstance(leaf, PoseOperator):
            body = _body(leaf, skill.kinematics)
        elif isinstance(leaf, Wrench):
            body = leaf.link, None, False
        elif isinstance(leaf, Canonical):
            continue
        else:
            raise DataError(
                f"{leaf!r} has no rows in torque space: there are those of Canonical, of "
                "positions and orientations, their stacks, and Wrench"
            )
        place, turn = bodies.get(body, (False, False))
        bodies[body] = place or not turns, turn or turns
    return bodies


def _body(leaf: PoseOperator, kinematics: Kinematics) -> Body:
    """A link, or an object, that moves, seen from a place or from another that moves."""
    link, *held = leaf.links()
    moving = [*held, *(name for name in leaf.references() if name in kinematics.links)]
    return link, moving[0] if moving else None, bool(held)


def _tolerance(leaf: Operator, kinematics: Kinematics, gains: TorqueGains) -> float:
    """Standard deviation of the frame that an operator refers to [m or rad]."""
    frames = {*leaf.links()[1:], *leaf.references()} - {*kinematics.links}
    if not frames or not isinstance(leaf, PoseOperator):
        return 0.0
    return gains.frame_tolerance if leaf.gain is None else gains.frame_turn_tolerance
