"""Via-points: a skill that passes through given coordinates at given times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import torch
from torch import Tensor

from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.data.trajectories import Candidate, Trajectory
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.joint_limits import keep_within
from tpgmm_torch.regression.posture import PostureSearch
from tpgmm_torch.robots.kinematics import Bounds, RobotState
from tpgmm_torch.skills.conditioning import Cluster, Request, Surroundings
from tpgmm_torch.skills.skill import CompositeSkill, Skill
from tpgmm_torch.skills.via_point import ViaPoint

__all__ = ["ViaPoints"]

#: What is further away than this, and than three times the tolerance, is missed [m, rad].
MISSED = 1e-3


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
