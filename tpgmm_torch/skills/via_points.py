"""Via-points: a skill conditioned on points, without learning again.

A mixture says what the joints are at each instant, ``N(m_t, P_t)``, and not how what they
are at one instant goes with what they are at another. To condition it on a via-point takes
such a covariance. It is that of the Gaussian process

    q_t = m_t + e_t,   E[e_s e_t^T] = k(s, t) C(P_s, P_t),

whose law at each instant is the mixture's: ``k`` is Wendland's function, 1 at equal times and 0
from ``fade`` seconds on, and ``C(A, B)``, with ``C(A, A) = A``, solves

    A^-1 C + C B^-1 = 2 I,

the harmonic mean of variances where A and B have the same axes. Both are positive definite, so
that is their product. At a via-point
at t_a the operators and what it asks for are fused, and linearised where that leads; with its
Jacobian J and variances R,

    e_t = X_t P_a^-1 e_a,   P_t - X_t J^T S^-1 J X_t^T,
    X_t = k(t, t_a) C(P_t, P_a),   S = J P_a J^T + R.

Nowhere is the reproduction moved by more than ``k(t, t_a)`` times as many standard deviations
as at the via-point, and from ``fade`` on it is as it was. Via-points less than ``fade`` apart
are conditioned on together.

References
----------
Paraschos, Daniel, Peters, Neumann: Using probabilistic movement primitives in robotics,
Autonomous Robots 42 (2018), whose weights have such a covariance, and which are conditioned so.
Huang, Rozo, Silvério, Caldwell: Kernelized movement primitives, IJRR 38 (2019): a kernel over
time makes one of a mixture. Wendland: Piecewise polynomial, positive definite and compactly
supported radial functions of minimal degree, Advances in Computational Mathematics 4 (1995).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import groupby
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch import gaussians
from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.trajectories import Candidate, Trajectory
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.joint_limits import keep_within
from tpgmm_torch.regression.posture import PostureSearch, Residual
from tpgmm_torch.robots.kinematics import Bounds, Kinematics, RobotState
from tpgmm_torch.skills.skill import CompositeSkill, Skill
from tpgmm_torch.skills.via_point import ViaPoint

__all__ = ["ViaPoints"]

#: Linearisations at a tick: where there was none before, and where there was one.
FIRST, LATER = 8, 1
#: Joints move by no more at a linearisation than this [rad or m].
LARGEST = 0.2
#: What is asked for without a tolerance leaves this share of the variance that was there.
EXACT = 1e-8
#: What is further away than this, and than three times the tolerance, is missed [m, rad].
MISSED = 1e-3


def wendland(distance: Tensor) -> Tensor:
    """Compute a correlation that is 1 at 0, 0 from 1 on, and four times differentiable.

    ``(1 - r)^5 (8 r^2 + 5 r + 1)``, positive definite over a line.

    Parameters
    ----------
    distance : Tensor of shape (...)
        Not negative: r.
    """
    left = (1 - distance).clamp(min=0.0)
    return left**5 * (8 * distance**2 + 5 * distance + 1)


def covariance_between(one: Tensor, other: Tensor) -> Tensor:
    """Solve for C in ``A^-1 C + C B^-1 = 2 I``, with covariances A, B (..., n, n).

    In their eigenvectors it has the harmonic means of their eigenvalues: however unlike they
    are, what is moved by the one is moved by at most about twice as much by the other.

    Parameters
    ----------
    one, other : Tensor of shape (..., n, n)
    """
    (a, left), (b, right) = torch.linalg.eigh(one), torch.linalg.eigh(other)
    a, b = a.clamp(min=0.0)[..., :, None], b.clamp(min=0.0)[..., None, :]
    mean = 2 * a * b / (a + b).clamp(min=torch.finfo(a.dtype).tiny)
    return left @ ((left.mT @ right) * mean) @ right.mT


@dataclass(frozen=True, eq=False)
class Request:
    """Displacements that one via-point asks for.

    Parameters
    ----------
    term : Residual
        Of the via-point's operator.
    coordinates : Tensor of shape (D,)
        Wanted local coordinates of the operator.
    variances : Tensor of shape (m,)
        Of these [m^2, rad^2].
    """

    term: Residual
    coordinates: Tensor
    variances: Tensor

    @classmethod
    def of(cls, point: ViaPoint, kinematics: Kinematics) -> Self:
        """Make the request of a ``point`` of the robot that ``kinematics`` describe."""
        like, operator, wanted = kinematics.lower, point.operator, point.coordinates(kinematics)
        posture = torch.zeros_like(like)
        posture[list(kinematics.quaternion_starts)] = 1.0
        anywhere = dict.fromkeys(operator.references(), Frame(like.new_zeros(3)))
        at = operator.linearize(kinematics.state(posture), anywhere)
        variances = like.new_tensor(point.variances(at.displacement.shape[-1]))
        return cls(Residual.of(operator, kinematics), wanted, variances)

    def displacement(self, state: RobotState, frames: Frames) -> tuple[Tensor, Tensor]:
        """Compute the displacement ``r`` (..., m) and minus its derivative (..., m, n)."""
        _, residual, jacobian, _ = self.term(self.coordinates, state, frames)
        n = state.joints.shape[-1]
        if jacobian is None:
            jacobian = torch.eye(n, dtype=residual.dtype, device=residual.device)
        batch = gaussians.common_shape(residual.shape[:-1], jacobian.shape[:-2])
        return residual.expand(*batch, -1), jacobian.expand(*batch, -1, n)


@dataclass(frozen=True, eq=False)
class Surroundings:
    """Skill and objects at a tick, to estimate at other times and postures.

    Parameters
    ----------
    skill : Skill
        Without via-points.
    frames : mapping of str to Frame
        Poses of the objects.
    held : RobotState, optional
        The present state, if robots hold objects: they are in the same grasps elsewhere.
    """

    skill: Skill
    frames: Frames
    held: RobotState | None = None

    def state(self, joints: Tensor) -> RobotState:
        """Compute the state at other ``joints``, with what the robots hold."""
        state = self.skill.kinematics.state(joints)
        return state if self.held is None else _attach_objects(state, self.held)

    def estimate(self, time: Tensor, joints: Tensor, bounds: Bounds = None) -> Estimate:
        """Estimate the skill at ``time``, linearised at ``joints``, within ``bounds``."""
        given = joints if self.held is None else self.state(joints)
        return self.skill.estimate(time, given, self.frames, bounds)


@dataclass(frozen=True, eq=False)
class Cluster:
    """Via-points so near to each other in time that they are conditioned on together.

    Parameters
    ----------
    fade : float
        How long before and after a via-point it counts [s].
    times : tuple of float
        Ascending [s].
    requests : tuple of tuple of Request
        What is asked for at each time.
    """

    fade: float
    times: tuple[float, ...]
    requests: tuple[tuple[Request, ...], ...]

    @classmethod
    def group(
        cls, points: Iterable[ViaPoint], kinematics: Kinematics, fade: float
    ) -> tuple[Self, ...]:
        """Group the ``points`` of a robot whose times are less than ``fade`` apart."""
        clusters: list[Self] = []
        for time, same in groupby(sorted(points, key=lambda p: p.time), lambda p: p.time):
            cluster = cls(fade, (time,), (tuple(Request.of(p, kinematics) for p in same),))
            if clusters and time - clusters[-1].times[-1] < fade:
                last = clusters.pop()
                together = (*last.requests, *cluster.requests)
                cluster = cls(fade, (*last.times, time), together)
            clusters.append(cluster)
        return tuple(clusters)

    def counts(self, time: Tensor) -> bool:
        """Check whether it moves anything at one of the times (...)."""
        return any(bool(((time - at).abs() < self.fade).any()) for at in self.times)

    def condition(
        self, time: Tensor, here: Estimate, around: Surroundings, moved: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Condition the estimate ``here`` at ``time`` on the via-points.

        Returns
        -------
        shift : Tensor of shape (..., n)
            ``e_t``.
        narrowed : Tensor of shape (..., n, n)
            By how much the covariance becomes less.
        moved : Tensor of shape (..., A n)
            ``e_a``, from which the next tick goes on.
        """
        there = [around.estimate(time.new_tensor(at), here.joints) for at in self.times]
        free = torch.cat([one.joints for one in there], -1)
        postures, rounds = (free, FIRST) if moved is None else (free + moved, LATER)
        for _ in range(rounds):
            postures = self._linearize_once(postures, around)
        moved = postures - free
        spreads = [one.covariance.double() for one in there]
        near = [self._correlation(time, at)[..., None, None].double() for at in self.times]
        between = [covariance_between(here.covariance.double(), one) for one in spreads]
        cross = torch.cat([k * c for k, c in zip(near, between, strict=True)], -1)
        prior = self._prior(spreads)
        factor = gaussians.cholesky(prior, "the covariance between via-points")
        shift = cross @ torch.cholesky_solve(moved.double().unsqueeze(-1), factor)
        _, jacobian, noise = self._requests_at(postures, around)
        square = _covariance_of_requests(jacobian, prior, noise)
        white = gaussians.whiten(square, jacobian @ cross.mT, "the covariance of via-points")
        like = here.joints
        return shift[..., 0].to(like), (white.mT @ white).to(like), moved

    def _linearize_once(self, postures: Tensor, around: Surroundings) -> Tensor:
        """Solve for postures (..., A n), operators and via-points linearised where they are."""
        parts = postures.split(postures.shape[-1] // len(self.times), -1)
        pairs = zip(self.times, parts, strict=True)
        there = [around.estimate(part.new_tensor(at), part) for at, part in pairs]
        prior = self._prior([one.covariance.double() for one in there])
        mean = torch.cat([one.joints for one in there], -1)
        residual, jacobian, noise = self._requests_at(postures, around)
        square = _covariance_of_requests(jacobian, prior, noise)
        factor = gaussians.cholesky(square, "the covariance of via-points")
        away = (postures - mean).double()
        target = residual.unsqueeze(-1) + jacobian @ away.unsqueeze(-1)
        gain = prior @ jacobian.mT @ torch.cholesky_solve(target, factor)
        step = gain[..., 0] - away
        largest = step.abs().amax(-1, keepdim=True)
        step = step * (LARGEST / largest.clamp(min=LARGEST))
        moved = (postures + step.to(postures)).unflatten(-1, (len(self.times), -1))
        return around.skill.kinematics.retract(moved).flatten(-2)

    def _prior(self, spreads: Sequence[Tensor]) -> Tensor:
        """Compute the covariance of the joints at all times, (..., A n, A n)."""
        rows = []
        for at, one in zip(self.times, spreads, strict=True):
            k = [self._correlation(one.new_tensor(at), other) for other in self.times]
            parts = zip(k, spreads, strict=True)
            rows.append(torch.cat([x * covariance_between(one, two) for x, two in parts], -1))
        return torch.cat(rows, -2)

    def _correlation(self, time: Tensor, at: float) -> Tensor:
        return wendland((time - at).abs() / self.fade)

    def _requests_at(
        self, postures: Tensor, around: Surroundings
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Compute displacements, Jacobians on a diagonal, and variances (..., A n)."""
        found: list[tuple[Tensor, Tensor, Tensor]] = []
        width = postures.shape[-1]
        n = width // len(self.times)
        for first, requests in zip(range(0, width, n), self.requests, strict=True):
            state = around.state(postures[..., first : first + n])
            for one in requests:
                residual, jacobian = one.displacement(state, around.frames)
                pads = first, width - n - first
                jacobian = torch.nn.functional.pad(jacobian, pads)
                found.append((residual, jacobian, one.variances))
        residuals, jacobians, variances = zip(*found, strict=True)
        both = torch.cat(residuals, -1).double(), torch.cat(jacobians, -2).double()
        return *both, torch.cat(variances).double()


def _covariance_of_requests(jacobian: Tensor, prior: Tensor, noise: Tensor) -> Tensor:
    """Compute ``J P J^T + R``, where what is asked for exactly has a small share for R."""
    square = jacobian @ prior @ jacobian.mT
    least = EXACT * square.diagonal(dim1=-2, dim2=-1)
    return square + torch.maximum(noise, least).diag_embed()


def _attach_objects(state: RobotState, like: RobotState) -> RobotState:
    """Add to the state of a robot alone the objects of another state, in the same grasps."""
    names = like.links[len(like.robot_links) :]
    for name, carrier in zip(names, like.carriers, strict=True):
        pose = like.pose(name)
        state = state.with_link(name, None, pose)
        for index in [carrier] if isinstance(carrier, int) else carrier.unique().tolist():
            if index >= 0:
                grasp = pose.seen_from(like.pose(like.links[index]))
                where = None if isinstance(carrier, int) else carrier == index
                state = state.with_link(name, like.links[index], grasp, where)
    return state


@dataclass(frozen=True, eq=False)
class Memory:
    """State of via-points from tick to tick.

    Parameters
    ----------
    clusters : tuple of Cluster
        What is asked for, by times.
    moved : mapping of int to Tensor of shape (..., A n_joints)
        ``e_a`` at the last tick of each cluster that counted, by its number.
    shift : Tensor of shape (..., n_joints), optional
        ``e_t`` of the last tick; None where nothing was moved.
    """

    clusters: tuple[Cluster, ...] = ()
    moved: Mapping[int, Tensor] = field(default_factory=dict)
    shift: Tensor | None = None


NOTHING = Memory()


@dataclass(frozen=True, eq=False)
class ViaPoints(CompositeSkill):
    """A skill conditioned on via-points; at other times it is the skill itself.

    Parameters
    ----------
    skill : Skill
        What is conditioned.
    points : sequence of ViaPoint or str
        Between begin and end of the skill; text is for :meth:`ViaPoint.parse`.
    fade : float, default=1.0
        For how long before and after a via-point the skill is changed [s].
    memory : Memory, optional
        Of the last tick; made when it is left out.

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If a via-point does not fit the skill.
    """

    skill: Skill
    points: Sequence[Any]
    fade: float = 1.0
    memory: Memory = field(default=NOTHING, repr=False, metadata={"saved": False})

    def __post_init__(self) -> None:
        if self.memory is not NOTHING:
            return
        points = [ViaPoint.parse(p) if isinstance(p, str) else p for p in self.points]
        for point in points:
            _check(point, self.skill)
        if not self.fade > 0:
            raise DataError(f"via-points fade over a positive time, got {self.fade} s")
        clusters = Cluster.group(points, self.skill.kinematics, self.fade)
        memory = Memory(clusters)
        vars(self).update(points=tuple(points), fade=float(self.fade), memory=memory)

    @property
    def skills(self) -> tuple[Skill]:  # type: ignore[override]
        """The skill alone."""
        return (self.skill,)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Frames of the skill and of the via-points."""
        links = self.kinematics.links
        asked = [name for one in self.points for name in one.operator.references()]
        names = [*self.skill.frame_names, *(name for name in asked if name not in links)]
        return tuple(dict.fromkeys(names))

    def shares(self, time: Tensor) -> Tensor:
        """Return 1 at times (...): there is one skill."""
        return torch.ones_like(time).unsqueeze(-1)

    def with_skills(self, skills: Iterable[Skill]) -> Self:
        """Replace the skill; see :meth:`CompositeSkill.with_skills`."""
        [skill] = skills
        return self if skill is self.skill else replace(self, skill=skill)

    def estimate(
        self, time: Tensor, state: Tensor | RobotState, frames: Frames, bounds: Bounds = None
    ) -> Estimate:
        """Estimate the skill, given the via-points; see :meth:`Skill.estimate`."""
        joints, held = (state, None) if isinstance(state, Tensor) else (state.joints, state)
        clusters, shift = self.memory.clusters, self.memory.shift
        if shift is not None and shift.shape == joints.shape:
            joints = joints - shift  # of other robots than those of the last tick: none
        around = Surroundings(self.skill, frames, held if held and held.carriers else None)
        free = around.estimate(time, joints, bounds)
        skill = self.skill.advance(free)
        if not any(cluster.counts(time) for cluster in clusters):
            return replace(free, after=replace(self, skill=skill, memory=Memory(clusters)))
        if not bool(free.joints.isfinite().all()):  # no estimate: stay
            kept = free.joints if self.memory.shift is None else free.joints + self.memory.shift
            return replace(free, joints=kept, after=replace(self, skill=skill))
        given, memory = self._condition(time, free, around)
        after = replace(self, skill=skill, memory=memory)
        return replace(keep_within(given, bounds), after=after)

    def _condition(
        self, time: Tensor, free: Estimate, around: Surroundings
    ) -> tuple[Estimate, Memory]:
        """Condition an estimate on all clusters."""
        here, moved = around.estimate(time, free.joints), dict[int, Tensor]()
        shift, covariance = torch.zeros_like(here.joints), here.covariance
        for k, cluster in enumerate(self.memory.clusters):
            if cluster.counts(time):
                last = self.memory.moved.get(k)
                more, narrowed, moved[k] = cluster.condition(time, here, around, last)
                shift, covariance = shift + more, covariance - narrowed
        given = replace(free, joints=here.joints + shift, covariance=covariance)
        return given, Memory(self.memory.clusters, moved, shift)

    def candidates(
        self, time: Tensor, state: RobotState, frames: Frames, estimate: Estimate
    ) -> tuple[Candidate, ...]:
        """Return those of the skill; see :meth:`Skill.candidates`."""
        return self.skill.candidates(time, state, frames, estimate)

    def start(self, joints: Tensor, frames: Frames) -> Self:
        """Condition on the same points; see :meth:`Skill.start`."""
        return type(self)(self.skill.start(joints, frames), self.points, self.fade)

    def of_robots(self, robots: Tensor) -> Self:
        """Keep some of the robots; see :meth:`Skill.of_robots`."""
        some, shift = super().of_robots(robots), self.memory.shift
        if shift is None or shift.ndim == 1:
            return some
        moved = {k: one[robots] for k, one in self.memory.moved.items()}
        return replace(some, memory=Memory(self.memory.clusters, moved, shift[robots]))

    def posture_search(self) -> PostureSearch | None:
        """Return the skill's search where no via-point counts, which it would undo."""
        return None if self.memory.shift is not None else self.skill.posture_search()

    def report_misses(
        self, situations: Sequence[Situation], trajectories: Sequence[Trajectory]
    ) -> Report:
        """Report the via-points that trajectories do not pass through.

        Parameters
        ----------
        situations : sequence of Situation
            In which the skill was reproduced.
        trajectories : sequence of Trajectory
            What was reproduced in each.
        """
        findings = [
            Finding(
                "via-points",
                f"situation {n}: {point} is missed by {distance:.3g} m or rad",
                "Can the robot reach it, in so short a time? A longer fade asks for less "
                "speed, and bounds=None is for what no robot has to follow",
                episodes=(n,),
                value=distance,
            )
            for n, (there, done) in enumerate(zip(situations, trajectories, strict=True))
            for point in self.points
            if not self.holds  # a frame that is held is not where the situation has it
            and (distance := self._miss(point, done, there.frames))
        ]
        if isinstance(self.skill, ViaPoints):
            findings += self.skill.report_misses(situations, trajectories)
        return Report.of(findings, f"{len(situations)} situations with via-points")

    def _miss(self, point: ViaPoint, done: Trajectory, frames: Frames) -> float | None:
        """Measure by how much references miss a via-point [m, rad]; None if they do not."""
        time = done.time
        step = int((time - point.time).abs().argmin())
        if not torch.isclose(time[step], time.new_tensor(point.time)):
            return None  # between two steps
        here = {n: f[step] if f.batch_shape else f for n, f in frames.items()}
        request = Request.of(point, self.kinematics)
        residual, _ = request.displacement(self.kinematics.state(done.joints[step]), here)
        beyond = residual.abs() - 3 * request.variances.sqrt()
        return float(residual.norm()) if float(beyond.max()) > MISSED else None


def _check(point: object, skill: Skill) -> None:
    """Refuse what is no via-point, or none of this skill."""
    if not isinstance(point, ViaPoint):
        raise DataError(f"via-points are ViaPoint objects, got {type(point).__name__}")
    if not skill.begin <= point.time <= skill.end:
        raise DataError(
            f"the via-point {point} is at {point.time:g} s, but the skill lasts from "
            f"{skill.begin:g} to {skill.end:g} s"
        )
    kinematics = skill.kinematics
    point.operator.check(kinematics, point.operator.references())
    if strangers := set(point.operator.links()) - set(kinematics.links):
        raise UnknownNameError("link", strangers.pop(), "the robot", kinematics.links)
