"""Via-points: a skill that passes through given coordinates at given times."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

from torch import Tensor

from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.regression.estimate import Estimate
from tpgmm_torch.regression.posture import PostureSearch
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.conditioning import Conditioning
from tpgmm_torch.skills.skill import Skill
from tpgmm_torch.skills.via_point import ViaPoint

__all__ = ["ViaPoints"]


class ViaPoints:
    """A skill conditioned on via-points; at other times it is the skill itself.

    Parameters
    ----------
    skill : Skill
    points : iterable of ViaPoint or str
        Between begin and end of the skill; text is for :meth:`ViaPoint.parse`.
    fade : float, default=1.0
        For how long before and after a via-point the skill is changed [s].

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If a via-point does not fit the skill.
    """

    def __init__(self, skill: Any, points: Iterable[ViaPoint | str], fade: float = 1.0) -> None:
        given = [ViaPoint.parse(one) if isinstance(one, str) else one for one in points]
        for point in given:
            if not isinstance(point, ViaPoint):
                raise DataError(f"via-points are ViaPoint objects, got {type(point).__name__}")
            if not skill.begin <= point.time <= skill.end:
                raise DataError(
                    f"the via-point {point} is at {point.time:g} s, but the skill lasts from "
                    f"{skill.begin:g} to {skill.end:g} s"
                )
            references, kinematics = point.operator.references(), skill.kinematics
            point.operator.check(kinematics, references)
            if strangers := set(point.operator.links()) - set(kinematics.links):
                raise UnknownNameError("link", strangers.pop(), "the robot", kinematics.links)
        self.skill, self.points, self.fade = skill, tuple(given), float(fade)
        self.conditioning = Conditioning.of(skill, self.points, self.fade)

    @property
    def frame_names(self) -> tuple[str, ...]:
        """Frames of the skill and of the via-points."""
        links = self.skill.kinematics.links
        asked = [name for one in self.points for name in one.operator.references()]
        names = [*self.skill.frame_names, *(name for name in asked if name not in links)]
        return tuple(dict.fromkeys(names))

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") or name == "skill":
            raise AttributeError(name)
        return getattr(self.skill, name)

    def estimate(
        self,
        time: Tensor,
        state: Tensor | RobotState,
        frames: Mapping[str, Frame],
        bounds: tuple[Tensor, Tensor] | None = None,
    ) -> Estimate:
        """The skill's estimate, given the via-points; see :meth:`Skill.estimate`."""
        joints = state.joints if isinstance(state, RobotState) else state
        shift = self.conditioning.shift
        if shift is not None and shift.shape != joints.shape:
            shift = None  # of other robots than those of the last tick
        free = joints if shift is None else joints - shift

        def attach(bare: RobotState) -> RobotState:
            """Objects that the robots hold move with their links."""
            assert isinstance(state, RobotState)
            return _attached(bare, state)

        holds = attach if isinstance(state, RobotState) and state.carriers else None
        given: Tensor | RobotState = free
        if holds is not None:
            given = holds(self.skill.kinematics.state(free))
        unconditioned = self.skill.estimate(time, given, frames, bounds)
        estimate, after = self.conditioning.advance(time, unconditioned, frames, bounds, holds)
        mean, covariance, activation = estimate.joints, estimate.covariance, estimate.activation
        own = unconditioned.candidates
        skill = self.skill.advance(unconditioned)
        remembers = self._with(skill, replace(after, regression=skill))
        return Estimate(mean, covariance, activation, own, remembers)

    def start(self, joints: Tensor, frames: Mapping[str, Frame]) -> Skill:
        """Conditioned on the same points; see :meth:`Skill.start`."""
        return ViaPoints(self.skill.start(joints, frames), self.points, self.fade)

    def of_robots(self, robots: Tensor) -> Skill:
        """See :meth:`Skill.of_robots`."""
        skill = self.skill.of_robots(robots)
        return self._with(skill, self.conditioning.of_robots(skill, robots))

    def advance(self, estimate: Estimate) -> Skill:
        """Go on from the last conditioned estimate; see :meth:`Skill.advance`."""
        after: Skill | None = estimate.after
        return self if after is None else after

    def _with(self, skill: Any, conditioning: Conditioning) -> ViaPoints:
        other = object.__new__(type(self))
        vars(other).update(vars(self), skill=skill, conditioning=conditioning)
        return other

    def missed(
        self, situations: Sequence[Situation], trajectories: Sequence[Trajectory]
    ) -> Report:
        """Report the via-points that trajectories do not pass through.

        Parameters
        ----------
        situations : sequence of Situation
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
            for point, distance in self.conditioning.missed(
                done.time, done.joints, there.frames
            )
            if not self.skill.holds  # a frame that is held is not where the situation has it
        ]
        if isinstance(self.skill, ViaPoints):
            findings += self.skill.missed(situations, trajectories)
        return Report.of(findings, f"{len(situations)} situations with via-points")

    def posture_search(self) -> PostureSearch | None:
        """The skill's search where no via-point counts; see :meth:`Skill.posture_search`."""
        # a search would undo what via-points ask for
        return None if self.conditioning.shift is not None else self.skill.posture_search()


def _attached(state: RobotState, like: RobotState) -> RobotState:
    """A state of the robot alone with the objects of another state, in the same grasps."""
    names = like.links[len(like.robot_links) :]
    for name, carrier in zip(names, like.carriers, strict=True):
        pose = like.pose(name)
        state = state.with_link(name, None, pose)
        each = [carrier] if isinstance(carrier, int) else carrier.unique().tolist()
        for index in each:
            if index >= 0:
                grasp = pose.seen_from(like.pose(like.links[index]))
                where = None if isinstance(carrier, int) else carrier == index
                state = state.with_link(name, like.links[index], grasp, where)
    return state
