"""The wanted posture: the one that minimises the fused cost within limits of position.

A tick asks for one step of the linearised product (2). That is all there is to do while what is
wanted stays near: then the step is exact to second order. For what is far away, or cannot be
reached, the step overshoots, and taken again and again it circles. The product of component i
is, up to a constant, ``exp(-F_i(q))``; the wanted posture minimises the mean of these costs,

    sum_i h_i(t) F_i(q)   such that  lower <= q <= upper,
    F_i(q) = 1/2 sum_j r_ij(q)^T S_ij^-1 r_ij(q),   r_ij = M_j(q) mu_ij(t) + c_j(q),

where r_ij is the displacement that operator j asks for at q, with Jacobian ``-J_j`` (section
4.1), and S_ij its covariance. Within reach it is moved by how far the regression's step leads
from that of the mean cost, which is, to first order, the regression's estimate. The minimum is
found by Levenberg's and Marquardt's method with steps that keep within the limits exactly, from
where the last tick ended. Each tick evaluates the cost once, where the search is and where its
next step leads, both at the same instant: what cannot be reached is approached, and then
nothing moves. Where the limits leave several minima, others are looked for meanwhile, from a
sequence of postures.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.base import leaves
from tpgmm_torch.operators.stack import POSE_OPERATORS
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.joint_limits import step_within
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

#: Components of a smaller weight do not count.
NEGLIGIBLE = 1e-5
#: Damping, as a share of the precision: at least, at first after a step that failed, and at
#: most. Joints that only their own operator keeps are a million times softer than hands, and
#: whoever gives up all damping at once creeps along the valleys between them.
LEAST, FIRST, MOST = 1e-6, 1e-3, 1e8
#: A step that promises less than this share of the cost is not tried.
PROMISE = 1e-6
#: The regression is trusted where its step leaves less than this share of the way to the
#: minimum, and not at all where it leaves twice as much.
TRUST = 0.2
#: Ticks for which a lower cost is looked for from another posture. It is gone to where it is
#: lower by this factor, and by so much: within reach nothing else is looked for.
LOOK, BETTER, SLACK = 40, 0.95, 50.0
#: After so many ticks a look that is still this many times as high is given up for the next.
EARLY, HOPELESS = 10, 5.0


@dataclass(frozen=True, eq=False)
class PostureSearch:
    """Search for the nearest posture to an estimate that cannot be followed; immutable.

    It costs nothing as long as all robots follow. Once begun for a robot it goes on until the
    regression's own step leads to the minimum as well.

    Parameters
    ----------
    kinematics : Kinematics
    terms : sequence of Residual
        Of each operator.
    conditionals : sequence of Conditionals
        The components' Gaussians given time, as they are fused, one for each operator.
    prior : Tensor of shape (n_joints,)
        Precision of the prior around q_{t-1}: 0 where operators determine every joint.
    active : Tensor of bool, of shape (...), optional
        Robots whose regression is not trusted; None if there are none.
    postures : Tensor of shape (2, 2, ..., n_joints), optional
        The nearest that was found, and where a nearer one is looked for; behind both, the steps
        from there that are tried next.
    damping : Tensor of shape (2, ...), optional
        Of these steps.
    age : Tensor of int, of shape (...), optional
        Ticks since the first look began; 0 within reach, where none is needed.
    """

    kinematics: Kinematics
    terms: Sequence[Residual]
    conditionals: Sequence[Conditionals]
    prior: Tensor
    active: Tensor | None = None
    postures: Tensor | None = None
    damping: Tensor | None = None
    age: Tensor | None = None

    def advance(
        self,
        time: Tensor,
        reference: Tensor,
        frames: Frames,
        estimate: Estimate,
        bounds: tuple[Tensor, Tensor],
        asked: Tensor,
        state_at: Callable[[Tensor], RobotState] | None = None,
    ) -> tuple[Tensor, Self]:
        """Return the nearest posture of each robot, and the search for the next tick.

        Parameters
        ----------
        time : Tensor of shape () or (...)
            Of the estimate [s].
        reference : Tensor of shape (..., n_joints)
            The state q_{t-1} from which it was made.
        frames : mapping of str to Frame
            Poses of the objects, of shapes that broadcast with the batch.
        estimate : Estimate
            Of this tick, within the bounds.
        bounds : tuple of two Tensor of shape (n_joints,) or (..., n_joints)
            The lowest and the highest joints allowed.
        asked : Tensor of bool, of shape (...)
            Robots that cannot follow the estimate.
        state_at : callable, optional
            ``state_at(joints)`` gives the states of joints (K, ..., n_joints), with what the
            robots hold; the default is the kinematics'.

        Returns
        -------
        wanted : Tensor of shape (..., n_joints)
            The estimate's joints where it is trusted.
        search : PostureSearch
            For the next tick.
        """
        rows = asked if self.active is None else asked | self.active
        if not bool(rows.any()):
            return estimate.joints, self.reset()
        with torch.inference_mode():
            trust, goal, *state = self._search_rows(
                time, reference, frames, estimate, bounds, rows, state_at
            )
        goal, trust = goal.clone(), trust.clone()
        wanted = torch.lerp(goal, estimate.joints, trust.unsqueeze(-1))
        wanted = torch.where((trust < 1).unsqueeze(-1), wanted, estimate.joints)
        active = rows & (asked | (trust < 1))
        postures, damping, age = state
        searched = replace(self, active=active, postures=postures, damping=damping, age=age)
        return wanted, searched

    def reset(self) -> Self:
        """Return the same before any robot is searched for."""
        return replace(self, active=None, postures=None, damping=None, age=None)

    def drop_robots(self, robots: Tensor) -> Self:
        """Return the same without the searches of robots (...) that were displaced."""
        active = None if self.active is None else self.active & ~robots
        if active is None or not bool(active.any()):
            return self.reset()
        return replace(self, active=active)

    def _search_rows(
        self,
        time: Tensor,
        reference: Tensor,
        frames: Frames,
        estimate: Estimate,
        bounds: tuple[Tensor, Tensor],
        rows: Tensor,
        state_at: Callable[[Tensor], RobotState] | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Trust in the estimate's joints, the nearest ones, and the state."""
        like, batch = estimate.joints, estimate.joints.shape[:-1]
        where: tuple[Any, ...] = rows.nonzero(as_tuple=True) if batch else (None,)
        of_both, of_all = (slice(None), *where), (slice(None), slice(None), *where)
        all_postures, all_damping, all_age = self._state(reference)
        postures, damping, age = all_postures[of_all], all_damping[of_both], all_age[where]
        begun, estimated = reference[where], like[where]
        lower, upper = (bound.expand_as(like)[where] for bound in bounds)

        def state(joints: Tensor) -> RobotState:
            if state_at is None:
                return self.kinematics.state(joints)
            everyone = reference.expand(2, 2, *batch, -1).clone()
            everyone[of_all] = joints
            return state_at(everyone)[of_all]

        weights = estimate.activation.expand(*batch, -1)[where]
        now = time.expand(batch)[where] if time.ndim else time
        here = {name: frame.expand(batch)[where] for name, frame in frames.items()}
        cost = PostureCost(self, weights, now, begun, here, state)
        # elsewhere or, within reach, a step from where the robot stands
        look, begins = age // LOOK, (age < LOOK) | (age % LOOK == 0)
        if bool(begins.any()):
            start = torch.where((look > 0).unsqueeze(-1), _starts(look, lower, upper), begun)
            postures[:, 1] = torch.where(begins.unsqueeze(-1), start, postures[:, 1])
            damping[1] = torch.where(begins, 0.0, damping[1])
        postures, damping, (least, height) = descend(cost, postures, damping, lower, upper)
        hopeless = (age % LOOK == EARLY - 1) & ((look == 0) | (height > HOPELESS * least))
        better = height < BETTER * least - SLACK
        postures[:, 0] = torch.where(better.unsqueeze(-1), postures[:, 1], postures[:, 0])
        damping[0] = torch.where(better, damping[1], damping[0])
        reached = torch.where(better, height, least) < SLACK
        age = torch.where(better | hopeless, (look + 1) * LOOK, age + 1)
        # how much nearer to the minimum one step of the linearised problem leads; out of
        # reach, where components of little weight may lead astray, the estimate
        goal = torch.where(reached.unsqueeze(-1), postures[1, 0], postures[0, 0])
        step = torch.where((reached & (look == 0)).unsqueeze(-1), postures[1, 1], estimated)
        away, misses = ((x - goal).abs().amax(-1) for x in (begun, step))
        trusted = torch.where(away > 0, 2 - misses / (TRUST * away), 0.0).clamp(0, 1)
        mixed = torch.clamp(goal + estimated - step, lower, upper)
        goal = torch.where(reached.unsqueeze(-1), mixed, goal)
        trust, wanted = like.new_ones(batch), like.clone()
        trust[where], wanted[where] = trusted, goal
        # where a search begins, nothing is found yet
        begun_before = torch.zeros_like(rows) if self.active is None else self.active
        trust = torch.where(begun_before, trust, 1.0)
        all_postures[of_all], all_damping[of_both] = postures, damping
        all_age[where] = torch.where(reached, 0, age)
        return trust, wanted, all_postures, all_damping, all_age

    def _state(self, reference: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Postures, damping and age; a search begins where the robot stands."""
        postures = reference.expand(2, 2, *reference.shape)
        damping = reference.new_zeros(postures.shape[1:-1])
        age = torch.zeros_like(damping[0], dtype=torch.long)
        if self.active is None or self.postures is None:
            return postures.clone(), damping, age
        assert self.damping is not None and self.age is not None
        return (
            torch.where(self.active.unsqueeze(-1), self.postures, postures),
            torch.where(self.active, self.damping, damping),
            torch.where(self.active, self.age, age),
        )


def _starts(number: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Postures (R, n) to look for a lower cost from.

    Their shares of the way between the limits are Richtmyer's sequence, which fills the cube.
    """
    n = lower.shape[-1]
    steps = 2 ** (torch.arange(1, n + 1, dtype=lower.dtype, device=lower.device) / (n + 1))
    shares = (0.5 + (number.unsqueeze(-1) - 1) * steps).frac()
    # joints without limits turn
    low, high = lower.clamp(min=-torch.pi), upper.clamp(max=torch.pi)
    return torch.lerp(low, torch.maximum(low, high), shares)


def descend(
    cost: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]],
    postures: Tensor,
    damping: Tensor,
    lower: Tensor,
    upper: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return a step of Levenberg's and Marquardt's method within bounds, with one evaluation.

    Parameters
    ----------
    cost : callable
        Cost, downhill gradient and precision at joints.
    postures : Tensor of shape (2, ..., n_joints)
        Where the search is, and what is tried; for a start, both may be the same.
    damping : Tensor of shape (...)
        Of what is tried.
    lower, upper : Tensor of shape (..., n_joints)

    Returns
    -------
    postures, damping : Tensor
        The better ones, and what to try next.
    cost : Tensor of shape (...)
        Of the better ones.
    """
    joints, there = postures = torch.clamp(postures, lower, upper)
    heights, vectors, precisions = cost(postures)
    step = there - joints
    bend = (step.unsqueeze(-2) @ precisions[0] @ step.unsqueeze(-1))[..., 0, 0]
    promise = (vectors[0] * step).sum(-1) - 0.5 * bend
    tried = promise > PROMISE * (heights[0] + PROMISE)
    gain = torch.where(tried, (heights[0] - heights[1]) / promise, 0.5)
    # valleys are curved: within reach a step along them is taken, and the next leads back
    near = heights[1] < SLACK / 2
    gain = torch.where(near, 1.0, gain)
    easier = torch.where(damping > LEAST, damping / 5, 0.0)
    harder = torch.clamp(10 * damping, FIRST, MOST)
    damping = torch.where(gain > 0.75, easier, damping)
    damping = torch.where(gain < 0.25, harder, damping)
    taken = (tried & (heights[1] < heights[0])) | near
    joints = torch.where(taken.unsqueeze(-1), there, joints)
    vector = torch.where(taken.unsqueeze(-1), vectors[1], vectors[0])
    precision = torch.where(taken[..., None, None], precisions[1], precisions[0])
    scale = precision.diagonal(dim1=-2, dim2=-1) * damping.unsqueeze(-1)
    there = step_within(joints, vector, precision + scale.diag_embed(), lower, upper)
    return torch.stack((joints, there)), damping, torch.where(taken, heights[1], heights[0])


class PostureCost:
    """The costs F, mixed over components, at one instant.

    Parameters
    ----------
    search : PostureSearch
        Operators and their conditionals.
    weights : Tensor of shape (..., K)
        Of the components, for the batch of the joints.
    time : Tensor of shape () or (...)
    centre : Tensor of shape (..., n_joints)
        Mean of the prior where no operator determines every joint.
    frames : mapping of str to Frame
    state_at : callable
        ``state_at(joints)`` gives the states of joints (..., n_joints).
    """

    def __init__(
        self,
        search: PostureSearch,
        weights: Tensor,
        time: Tensor,
        centre: Tensor,
        frames: Frames,
        state_at: Callable[[Tensor], RobotState],
    ) -> None:
        weights = torch.where(weights > NEGLIGIBLE, weights, 0.0)
        index = weights.reshape(-1, weights.shape[-1]).any(0).nonzero()[:, 0]
        # components stand in front of joints (P, A, ...)
        weights = weights.movedim(-1, 0)[index]
        self._weights = (weights / weights.sum(0))[:, None, None, ..., None, None]
        self._centre, self._frames, self._state_at = centre, frames, state_at
        self._prior, self._local = search.prior, []
        time, single = time.expand(centre.shape[:-1]), [1] * (centre.ndim + 1)
        for term, one in zip(search.terms, search.conditionals, strict=True):
            if (operator := term.operator.at(time)) is not term.operator:
                term = Residual.of(operator, search.kinematics)
            mean = one.at(time).movedim(-2, 0)[index][:, None, None]
            covariance = one.covariance[index].unflatten(0, (-1, *single))
            self._local.append((term, mean, covariance))

    def __call__(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (P, A, ...), downhill gradient (P, A, ..., n), and precision (P, A, ..., n, n).

        Of joints (P, A, ..., n). How far apart displacements may be is said by the first of P.
        """
        state = self._state_at(joints)
        away = self._centre - joints
        cost = 0.5 * (self._prior * away.square()).sum(-1)
        vector = self._prior * away
        precision = self._prior.diag().expand(*joints.shape, -1)
        for term, mean, covariance in self._local:
            matrix, residual, jacobian, noise = term(mean, state, self._frames)
            if matrix is not None:
                matrix = matrix.expand(*residual.shape, -1)[:, :1]
                covariance = matrix @ covariance @ matrix.mT
            if noise is not None:
                covariance = covariance + noise.expand(residual.shape)[:, :1].diag_embed()
            parts = gaussians.information(jacobian, residual.unsqueeze(-1), covariance)
            mixed, pull, square = ((self._weights * part).sum(0) for part in parts)
            cost = cost + 0.5 * square[..., 0, 0]
            vector, precision = vector + pull[..., 0], precision + mixed
        return cost, vector, precision


@dataclass(frozen=True, eq=False)
class Residual:
    """The displacement that an operator asks for, and its exact derivative.

    A linearisation is exact where the displacement is small; of a rotation that is still to go,
    ``delta = eps_wanted conj(eps) = (w, v)`` with ``r = g v``, the derivative is
    ``-g/2 (w + v x) J_o``, and of what is seen from a frame that turns by ``J_of`` with the
    joints there are ``-g v x J_of`` and, of a position, ``-r x J_of`` more. In tangent space
    the linearisation's is exact.

    Parameters
    ----------
    operator : Operator
    starts : tuple of int
        Where the operator's quaternions begin.
    leaves : tuple
        Position and orientation operators that have three rows each; none if there are others.
    turning : tuple of three Tensor, of shape (D, L), (L,) and (L, 1), optional
        ``w`` of each leaf's turn as a sum of coordinates times present ones and a constant, and
        what of ``r`` is half a ``v``; None where derivatives are exact.
    """

    operator: Operator
    starts: tuple[int, ...]
    leaves: tuple[Any, ...]
    turning: tuple[Tensor, Tensor, Tensor] | None

    @classmethod
    def of(cls, operator: Operator, kinematics: Kinematics) -> Self:
        """For an ``operator`` on the joints of ``kinematics``."""
        parts: Sequence[Any] = leaves([operator])
        parts = parts if all(type(leaf) in POSE_OPERATORS for leaf in parts) else ()
        column = 0
        with torch.inference_mode(False):  # as it serves where gradients are wanted, too
            like = kinematics.lower.new_ones(len(parts))
            whole, half = like.clone(), torch.zeros_like(like).unsqueeze(-1)
            share = like.new_zeros(operator.dimension(kinematics), len(parts))
            for row, leaf in enumerate(parts):
                if leaf.quaternion_starts(kinematics):
                    share[column : column + 4, row] = leaf.gain / 2
                    whole[row], half[row] = 0.0, 0.5
                column += leaf.dimension(kinematics)
        starts = operator.quaternion_starts(kinematics)
        turning = (share, whole, half) if starts and parts else None
        exact = [bool(leaf.rotation_vector_starts(kinematics)) for leaf in parts]
        kept = tuple(None if one else leaf for one, leaf in zip(exact, parts, strict=True))
        return cls(operator, starts, kept, turning)

    def __call__(
        self, mean: Tensor, state: RobotState, frames: Frames
    ) -> tuple[Tensor | None, Tensor, Tensor | None, Tensor | None]:
        """``M`` with the mean's signs, ``r``, minus its derivative (None: identity), noise."""
        at = self.operator.linearize(state, frames)
        matrix, present = at.matrix, at.present
        if self.starts:
            if present is None:
                present = self.operator.coordinates(state, frames)
            signs = quaternions.hemisphere_signs(mean, present, self.starts)
            mean = mean * signs
            matrix = None if matrix is None else matrix * signs.unsqueeze(-2)
        moved = mean if at.matrix is None else (at.matrix @ mean.unsqueeze(-1))[..., 0]
        residual, jacobian = moved + at.displacement, at.jacobian
        # orientations that are tracked have four rows, which are linear in the joints
        if jacobian is not None and residual.shape[-1] == 3 * len(self.leaves):
            cosine = None
            if self.turning is not None:
                assert present is not None  # there are quaternions
                cosine = self.turning[1] + (mean * present) @ self.turning[0]
            jacobian = self._turn_jacobian(jacobian, residual, cosine, state)
        return matrix, residual, jacobian, at.noise

    def _turn_jacobian(
        self, jacobian: Tensor, residual: Tensor, cosine: Tensor | None, state: RobotState
    ) -> Tensor:
        """Add to a linearisation's Jacobian what a rotation that is still to go adds."""
        rows, still = jacobian.unflatten(-2, (-1, 3)), residual.unflatten(-1, (-1, 3))
        if cosine is not None and self.turning is not None:
            rows = cosine[..., None, None] * rows + _cross(self.turning[2] * still, rows)
        for row, leaf in enumerate(self.leaves):
            if leaf is None or (reference := leaf.moving_reference(state)) is None:
                continue
            rows = rows.expand(*still.shape, -1).clone()
            angular = state.angular_jacobian(reference)
            rows[..., row, :, :] += _cross(still[..., row, :], angular)
        return rows.flatten(-3, -2)


def _cross(vector: Tensor, matrix: Tensor) -> Tensor:
    """``v x M``, column by column."""
    shape = gaussians.common_shape(vector.unsqueeze(-1).shape, matrix.shape)
    return torch.linalg.cross(vector.unsqueeze(-1).expand(shape), matrix.expand(shape), dim=-2)
