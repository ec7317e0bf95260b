"""What is wanted now: the posture that minimises the fused cost within limits of position.

A tick asks for one step of the linearised product (2). That is all there is to do while what is
wanted stays near: then the step is exact to second order. For what is far away, or cannot be
reached, the step overshoots, and taken again and again it circles. The product of component i
is, up to a constant, ``exp(-F_i(q))`` with

    F_i(q) = 1/2 sum_j r_ij(q)^T S_ij^-1 r_ij(q),   r_ij = M_j(q) mu_ij(t) + c_j(q),

where r_ij is the displacement that operator j asks for at q, with Jacobian ``-J_j`` (section
4.1), and S_ij its covariance. The wanted posture is

    q* = sum_i h_i(t) q_i*,   q_i* = argmin F_i(q)  such that  lower <= q <= upper,

the components' minima mixed as the regression mixes their means: to first order it is the
regression's estimate. Out of reach, where these minima lie apart and nothing between them is
near, it is that of their mean cost, ``argmin sum_i h_i(t) F_i(q)``. Minima are found by
Levenberg's and Marquardt's method with steps that keep within the limits exactly, taken only
where the cost falls, from where the last tick ended: what cannot be reached is approached, and
then nothing moves. Where the limits leave several minima, others are looked for meanwhile, from
a few fixed postures in turn.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch import gaussians, quaternions
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.operators import Operator
from tpgmm_torch.operators.stack import leaves
from tpgmm_torch.regression.conditionals import Conditionals
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.fusion import TASKS
from tpgmm_torch.regression.joint_limits import step_within
from tpgmm_torch.robots.kinematics import Kinematics, RobotState

__all__ = ["PostureCost", "PostureSearch", "Residual", "descend"]

#: Steps that are tried in one tick: the time that they take is all that trouble may cost.
TRIALS = 2
#: Components of a smaller weight do not count.
NEGLIGIBLE = 1e-5
#: Damping, as a share of the precision: at least, at first after a step that failed, and at
#: most. Joints that only their own operator keeps are a million times softer than hands, and
#: whoever gives up all damping at once creeps along the valleys between them.
LEAST, FIRST, MOST = 1e-6, 1e-3, 1e8
#: A step that promises less than this share of the cost is not tried.
PROMISE = 1e-9
#: The regression is trusted where its step leaves less than this share of the way to the
#: minimum, and not at all where it leaves twice as much.
TRUST = 0.2
#: Ticks for which a lower cost is looked for from one of so many other postures. It is gone to
#: if it is lower by this factor, and by so much.
LOOK, STARTS, BETTER, SLACK = 25, 64, 0.95, 50.0
#: After so many ticks a look that is still this many times as high is given up for the next.
EARLY, HOPELESS = 5, 5.0


@dataclass(frozen=True, eq=False)
class PostureSearch:
    """Search for the nearest posture to an estimate that cannot be followed; immutable.

    It costs nothing as long as all robots follow. Once begun for a robot it goes on until the
    regression's own step leads to the minimum as well.

    Parameters
    ----------
    kinematics : Kinematics
    operators : sequence of Operator
    conditionals : sequence of Conditionals
        The components' Gaussians given time, as they are fused, one for each operator.
    prior : Tensor of shape (n_joints,)
        Precision of the prior around q_{t-1}: 0 where operators determine every joint.
    active : Tensor of bool, of shape (...), optional
        Robots whose regression is not trusted; None if there are none.
    minima, damping : Tensor of shape (K + 2, ..., n_joints) and (K + 2, ...), optional
        Where the components' searches are; behind them that for the lowest mean cost, and one
        that looks elsewhere for a lower one.
    age : Tensor of int, of shape (...), optional
        Ticks since each robot's search began, and those that looks were given up early.
    """

    kinematics: Kinematics
    operators: Sequence[Operator]
    conditionals: Sequence[Conditionals]
    prior: Tensor
    active: Tensor | None = None
    minima: Tensor | None = None
    damping: Tensor | None = None
    age: Tensor | None = None

    def advance(
        self,
        time: Tensor,
        reference: Tensor,
        frames: Mapping[str, Frame],
        estimate: Estimate,
        bounds: tuple[Tensor, Tensor],
        asked: Tensor,
        state_at: Callable[[Tensor], RobotState] | None = None,
    ) -> tuple[Tensor, Self]:
        """The nearest posture of each robot, and the search for the next tick.

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
            return estimate.joints, self.begun()
        with torch.no_grad():
            wanted, trust, *state = self._searched(
                time, reference, frames, estimate, bounds, rows, state_at
            )
        joints = torch.lerp(wanted, estimate.joints, trust.unsqueeze(-1))
        joints = torch.where((trust < 1).unsqueeze(-1), joints, estimate.joints)
        active = rows & (asked | (trust < 1))
        minima, damping, age = state
        searched = replace(self, active=active, minima=minima, damping=damping, age=age)
        return joints, searched

    def begun(self) -> Self:
        """The same before any robot is searched for."""
        return replace(self, active=None, minima=None, damping=None, age=None)

    def ended(self, robots: Tensor) -> Self:
        """The same without the searches of robots (...) that were displaced."""
        active = None if self.active is None else self.active & ~robots
        if active is None or not bool(active.any()):
            return self.begun()
        return replace(self, active=active)

    def _searched(
        self,
        time: Tensor,
        reference: Tensor,
        frames: Mapping[str, Frame],
        estimate: Estimate,
        bounds: tuple[Tensor, Tensor],
        rows: Tensor,
        state_at: Callable[[Tensor], RobotState] | None,
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Wanted joints, trust in the estimate's, minima, damping and age."""
        like, batch = estimate.joints, estimate.joints.shape[:-1]
        where: tuple[Any, ...] = rows.nonzero(as_tuple=True) if batch else (None,)
        of_all = (slice(None), *where)
        weights = estimate.activation.expand(*batch, -1)[where]
        weights = torch.where(weights > NEGLIGIBLE, weights, 0.0).mT  # (K, R)
        count, index = len(weights), weights.any(-1).nonzero()[:, 0]
        weights = weights[index] / weights.sum(0)
        lower, upper = (bound.expand_as(like)[where] for bound in bounds)
        minima, damping, age = self._state(reference, count)

        def state(joints: Tensor) -> RobotState:
            if state_at is None:
                return self.kinematics.state(joints)
            everyone = reference.expand(len(joints), *batch, -1).clone()
            everyone[of_all] = joints
            return state_at(everyone)[of_all]

        # rows: a step of the heaviest component from where the robot stands, the components'
        # searches, that of their mean cost, and the same from elsewhere
        here, heaviest = age[where], weights.argmax(0, keepdim=True)
        places = torch.cat((index, index.new_tensor([count, count + 1])))
        found, damped = minima[places][of_all], damping[places][of_all]
        begins = here % LOOK == 0
        starts = _starts(here // LOOK, lower, upper)
        found[-1] = torch.where(begins.unsqueeze(-1), starts, found[-1])
        damped[-1] = torch.where(begins, 0.0, damped[-1])
        every = index.unsqueeze(-1).expand(-1, len(here))
        cost = PostureCost(
            self,
            torch.cat((every.gather(0, heaviest), every, every, every)),
            time.expand(batch)[where] if time.ndim else time,
            reference[where],
            {name: frame.expand(batch)[where] for name, frame in frames.items()},
            state,
        )
        begun = torch.clamp(reference[where], lower, upper)
        found, damped, height, stepped = descend(
            partial(_with_means, cost, weights, 1 + len(weights)),
            torch.cat((begun.unsqueeze(0), found)),
            torch.cat((torch.zeros_like(damped[:1]), damped)),
            lower,
            upper,
        )
        found, damped, height = found[1:], damped[1:], height[1:]
        asked = begun, stepped[0], estimate.joints[where]
        trust = like.new_ones(batch)
        sought, nearest, trust[where] = _nearest(
            weights, found, height, here, asked, (lower, upper)
        )
        wanted = like.clone()
        wanted[where] = sought
        # a component that counts only later begins where the others are
        counts = (weights > 0).unsqueeze(-1)
        own = torch.where(counts, nearest[:-1], sought)
        minima = wanted.expand(count + 2, *batch, -1).clone()
        damping = torch.zeros_like(damping)
        rows_of = (places[:, None], *where) if batch else (places, None)
        minima[rows_of] = torch.cat((own, nearest[-1:], found[-1:]))
        damping[rows_of] = damped
        hopeless = (here % LOOK == EARLY - 1) & (height[-1] > HOPELESS * height[-2])
        age = age + 1
        age[where] = torch.where(hopeless, (here // LOOK + 1) * LOOK, age[where])
        return wanted, trust, minima, damping, age

    def _state(self, reference: Tensor, count: int) -> tuple[Tensor, Tensor, Tensor]:
        """Minima, damping and age; a search begins where the robot stands."""
        batch = reference.shape[:-1]
        minima = reference.expand(count + 2, *batch, -1)
        damping = reference.new_zeros(count + 2, *batch)
        age = torch.zeros(batch, dtype=torch.long, device=reference.device)
        if self.active is None or self.minima is None:
            return minima, damping, age
        assert self.damping is not None and self.age is not None
        return (
            torch.where(self.active.unsqueeze(-1), self.minima, minima),
            torch.where(self.active, self.damping, damping),
            torch.where(self.active, self.age, age),
        )


def _nearest(
    weights: Tensor,
    found: Tensor,
    height: Tensor,
    age: Tensor,
    asked: tuple[Tensor, Tensor, Tensor],
    bounds: tuple[Tensor, Tensor],
) -> tuple[Tensor, Tensor, Tensor]:
    """Wanted postures (R, n), minima (S + 1, R, n), and trust in the estimates (R,).

    Of the components' minima, that of their mean cost, and one that was looked for elsewhere;
    ``asked`` are where robots stand, a step of the heaviest component, and the estimates.
    """
    heaviest = weights.argmax(0, keepdim=True)
    low = height.gather(0, heaviest)[0]
    reached, least = low < SLACK, BETTER * height[-2] - SLACK
    better = (age % LOOK == LOOK - 1) & (height[-1] < least) & ~reached
    nearest = torch.where(better.unsqueeze(-1), found[-1], found[:-1])
    # out of reach the components' minima lie apart, and what is between them is none
    mixed = torch.clamp((weights.unsqueeze(-1) * nearest[:-1]).sum(0), *bounds)
    share = torch.clamp(low / SLACK - 1, 0, 1).unsqueeze(-1)
    sought = torch.lerp(mixed, nearest[-1], share)
    # how much nearer to its minimum one step of the linearised problem leads; out of
    # reach, where components of little weight may lead astray, of the whole mixture
    begun, stepped, estimates = asked
    goal = nearest.gather(0, heaviest.unsqueeze(-1).expand(1, *begun.shape))[0]
    goal = torch.where(reached.unsqueeze(-1), goal, sought)
    step = torch.where(reached.unsqueeze(-1), stepped, estimates)
    away, misses = ((x - goal).abs().amax(-1) for x in (begun, step))
    trust = torch.where(away > 0, 2 - misses / (TRUST * away), 0.0).clamp(0, 1)
    return sought, nearest, trust


def _with_means(
    cost: PostureCost, weights: Tensor, alone: int, joints: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Costs for joints (A, R, n): of one component each for ``alone`` rows, then means.

    For each mean, ``cost`` has a row for each of the components with ``weights`` (S, R).
    """
    means = joints[alone:].repeat_interleave(len(weights), 0)

    def mixed(values: Tensor) -> Tensor:
        every = values[alone:].unflatten(0, (-1, len(weights)))
        shares = weights.reshape(weights.shape + (1,) * (every.ndim - 3))
        return torch.cat((values[:alone], (shares * every).sum(1)))

    height, vector, precision = map(mixed, cost(torch.cat((joints[:alone], means))))
    return height, vector, precision


def _starts(number: Tensor, lower: Tensor, upper: Tensor) -> Tensor:
    """Postures (R, n) to look for a lower cost from: the middle of the limits, and others."""
    # joints without limits turn
    low, high = lower.clamp(min=-torch.pi), upper.clamp(max=torch.pi)
    shares = _shares(lower.shape[-1]).to(lower)[number % STARTS]
    return torch.lerp(low, torch.maximum(low, high), shares)


@cache
def _shares(n_joints: int) -> Tensor:
    """Where between their limits the joints begin, (STARTS, n)."""
    generator = torch.Generator().manual_seed(0)
    with torch.inference_mode(False):
        shares = torch.rand(STARTS, n_joints, generator=generator, dtype=torch.float64)
        shares[0] = 0.5
    return shares


def descend(
    cost: Callable[[Tensor], tuple[Tensor, Tensor, Tensor]],
    joints: Tensor,
    damping: Tensor,
    lower: Tensor,
    upper: Tensor,
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """A few steps of Levenberg's and Marquardt's method within bounds.

    Parameters
    ----------
    cost : callable
        Cost, downhill gradient and precision at joints.
    joints : Tensor of shape (A, ..., n_joints)
    damping : Tensor of shape (A, ...)
    lower, upper : Tensor of shape (..., n_joints)

    Returns
    -------
    joints, damping, cost : Tensor
        After the steps.
    first : Tensor of shape (A, ..., n_joints)
        Joints after the first step.
    """
    joints = torch.clamp(joints, lower, upper)
    here, vector, precision = cost(joints)
    first = joints
    for trial in range(TRIALS):
        scale = precision.diagonal(dim1=-2, dim2=-1) * damping.unsqueeze(-1)
        damped = precision + torch.diag_embed(scale)
        there = step_within(joints, vector, damped, lower, upper)
        first, step = there if trial == 0 else first, there - joints
        bend = (step.unsqueeze(-2) @ precision @ step.unsqueeze(-1))[..., 0, 0]
        promise = (vector * step).sum(-1) - 0.5 * bend
        tried = promise > PROMISE * (here + PROMISE)
        if not bool(tried.any()):
            break
        new, new_vector, new_precision = cost(there)
        gain = torch.where(tried, (here - new) / promise, 0.0)
        taken = tried & (new < here)
        easier = torch.where(damping > LEAST, damping / 5, 0.0)
        harder = torch.clamp(10 * damping, FIRST, MOST)
        damping = torch.where(tried & (gain > 0.75), easier, damping)
        damping = torch.where(tried & (gain < 0.25), harder, damping)
        joints = torch.where(taken.unsqueeze(-1), there, joints)
        here = torch.where(taken, new, here)
        vector = torch.where(taken.unsqueeze(-1), new_vector, vector)
        precision = torch.where(taken[..., None, None], new_precision, precision)
    return joints, damping, here, first


class PostureCost:
    """The costs F_i of components (A, ...) at one instant, for joints (A, ..., n).

    Parameters
    ----------
    search : PostureSearch
        Operators and their conditionals.
    index : Tensor of int, of shape (A, ...)
        The components.
    time : Tensor of shape () or (...)
    centre : Tensor of shape (..., n_joints)
        Mean of the prior where no operator determines every joint.
    frames : mapping of str to Frame
    state_at : callable
        ``state_at(joints)`` gives the states of joints (A, ..., n_joints).
    """

    def __init__(
        self,
        search: PostureSearch,
        index: Tensor,
        time: Tensor,
        centre: Tensor,
        frames: Mapping[str, Frame],
        state_at: Callable[[Tensor], RobotState],
    ) -> None:
        self.centre, self.frames = centre, frames
        self.state_at, self.factors = state_at, list[Tensor]()
        self.local = []
        for operator, one in zip(search.operators, search.conditionals, strict=True):
            chosen = one.select(index)
            elapsed = (time - chosen.time_mean).unsqueeze(-1)
            mean = torch.addcmul(chosen.mean, chosen.gain, elapsed)
            term = Residual.of(operator.at(time), search.kinematics)
            self.local.append((term, mean, chosen.covariance))
        self.prior = search.prior

    def __call__(self, joints: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Cost (A, ...), downhill gradient (A, ..., n), and precision (A, ..., n, n)."""
        state = self.state_at(joints)
        away, n = self.centre - joints, joints.shape[-1]
        cost = 0.5 * (self.prior * away.square()).sum(-1)
        vector, precision = self.prior * away, self.prior.diag()
        first = not self.factors
        factors = []
        for j, (term, mean, covariance) in enumerate(self.local):
            matrix, residual, jacobian, noise = term(mean, state, self.frames)
            if first:  # how far apart displacements are does not change within a tick
                spread = covariance if matrix is None else matrix @ covariance @ matrix.mT
                if noise is not None:
                    spread = spread + noise.diag_embed()
                name = "the covariance of a projected component"
                factor = gaussians.cholesky(spread, name)
                # of the joints themselves the precision is all that is asked for
                known = jacobian is None
                factors.append(torch.cholesky_inverse(factor) if known else factor)
            factor = factors[j] if first else self.factors[j]
            if jacobian is None:
                pull = (factor @ residual.unsqueeze(-1)).squeeze(-1)
                cost = cost + 0.5 * (residual * pull).sum(-1)
                vector, precision = vector + pull, precision + factor
                continue
            right = torch.cat((jacobian.expand(*residual.shape, n), residual.unsqueeze(-1)), -1)
            white = torch.linalg.solve_triangular(factor, right, upper=False)
            gram = white.mT @ white
            cost = cost + 0.5 * gram[..., n, n]
            vector = vector + gram[..., :n, n]
            precision = precision + gram[..., :n, :n]
        self.factors = self.factors or factors
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
        Position and orientation operators: each with the slices of its displacement and, of an
        orientation, of its quaternion.
    """

    operator: Operator
    starts: tuple[int, ...]
    leaves: tuple[tuple[Any, slice, slice | None], ...]

    @classmethod
    def of(cls, operator: Operator, kinematics: Kinematics) -> Self:
        """For an ``operator`` on the joints of ``kinematics``."""
        parts: list[Any] = list(leaves([operator]))
        found: list[tuple[Any, slice, slice | None]] = []
        row, column = 0, 0
        for leaf in parts if all(type(leaf) in TASKS for leaf in parts) else ():
            block = slice(column, column + 4) if leaf.gain is not None else None
            if not leaf.rotation_vector_starts(kinematics):
                found.append((leaf, slice(row, row + 3), block))
            row, column = row + 3, column + leaf.dimension(kinematics)
        return cls(operator, operator.quaternion_starts(kinematics), tuple(found))

    def __call__(
        self, mean: Tensor, state: RobotState, frames: Mapping[str, Frame]
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
        if jacobian is None or not self.leaves:
            return matrix, residual, jacobian, at.noise
        jacobian = jacobian.expand(*residual.shape, -1).clone()
        for leaf, rows, block in self.leaves:
            still, own = residual[..., rows], jacobian[..., rows, :]
            if block is not None:
                assert present is not None  # there are quaternions
                cosine = (mean[..., block] * present[..., block]).sum(-1)[..., None, None]
                jacobian[..., rows, :] = leaf.gain / 2 * cosine * own + _cross(still / 2, own)
            if (reference := leaf.moving_reference(state)) is not None:
                jacobian[..., rows, :] += _cross(still, state.angular_jacobian(reference))
        return matrix, residual, jacobian, at.noise


def _cross(vector: Tensor, matrix: Tensor) -> Tensor:
    """``v x M``, column by column."""
    shape = gaussians.common_shape(vector.unsqueeze(-1).shape, matrix.shape)
    return torch.linalg.cross(vector.unsqueeze(-1).expand(shape), matrix.expand(shape), dim=-2)
