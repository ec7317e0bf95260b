"""Situations, completed for a skill and compared with the demonstrations."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tpgmm_torch.checks.situations import check_situations
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import RobotState
from tpgmm_torch.skills.skill import Skill


def complete_frames(skill: Skill, joints: Any, frames: Frames) -> dict[str, Frame]:
    """Frames, and those that are not given but follow from the start posture.

    Parameters
    ----------
    skill : Skill
    joints : array-like of shape (..., n_joints)
        Start postures.
    frames : mapping of str to Frame

    Raises
    ------
    UnknownNameError
        If a frame that the skill needs is missing, or has the name of a link.
    """
    complete, start = dict(frames), skill.kinematics.joint_tensor(joints)
    for summary in skill.summaries:
        complete |= summary.start_frames(start, skill.kinematics, complete)
    for name in skill.frame_names:
        if name not in complete:
            raise UnknownNameError("frame", name, "the situation", complete)
    for name in complete:
        if name in skill.kinematics.links:
            where = "the situation alone, it is a link of the robot too: rename the frame"
            raise UnknownNameError("frame", name, where, complete)
    return complete


def complete_situations(
    skill: Skill, given: Situation | Demonstration | Iterable[Situation | Demonstration]
) -> list[Situation]:
    """Situations in the robot's joint order, with all frames and a time grid, and reported.

    Parameters
    ----------
    skill : Skill
    given : sequence of Situation or Demonstration

    Raises
    ------
    DataError, ShapeError, UnknownNameError, PlausibilityError
        If one does not fit the skill, or cannot be what it is taken for.
    """
    if isinstance(given, Situation | Demonstration):
        given = [given]
    if not isinstance(given, Iterable):
        raise DataError(f"situations are a list of Situation, got {type(given).__name__}")
    situations = [_complete(skill, one) for one in given]
    if situations:
        _report(skill, situations)
    return situations


def _report(skill: Skill, situations: Sequence[Situation]) -> None:
    """Compare complete situations with the demonstrations."""
    firsts = [at_first(one) for one in situations]
    times = [one.time[[0, -1]] for one in situations if one.time is not None]
    joints = torch.stack([one.joints for one in situations])
    frames = {name: Frame.stack([first[name] for first in firsts]) for name in firsts[0]}
    now = torch.stack(times), skill.kinematics, _span(skill), skill.summaries
    check_situations(joints, frames, *now).act()


def _complete(skill: Skill, given: Situation | Demonstration) -> Situation:
    names, like = skill.kinematics.joint_names, skill.kinematics.lower
    if isinstance(given, Demonstration):
        given = Situation.of(given)
    if not isinstance(given, Situation):
        raise DataError(f"situations are Situation objects, got {type(given).__name__}")
    given = given.reorder(names)
    if len(given.joints) != len(names):
        raise ShapeError(
            f"the start posture has {len(given.joints)} joints, the model has {len(names)}: "
            f"{names}"
        )
    complete = complete_frames(skill, given.joints, given.frames)
    time = skill.time if given.time is None else given.time.to(like)
    present = {**complete, **given.frames_at(time)}
    frames = {name: present[name].to(like) for name in skill.frame_names}
    return Situation(given.joints.to(like), frames, time)


def report_start(skill: Skill, joints: Any, frames: Frames, time: Tensor | None = None) -> None:
    """Warn of start postures and frames unlike those of the demonstrations.

    Parameters
    ----------
    skill : Skill
    joints : array-like of shape (..., n_joints)
    frames : mapping of str to Frame
    time : Tensor, optional
        When that is, by default the begin of the skill [s].

    Raises
    ------
    PlausibilityError
        If a posture cannot be in radians.
    """
    start = skill.kinematics.joint_tensor(joints)
    span = _span(skill)
    known = {n: f.to(start) for n, f in frames.items() if n in skill.frame_names}
    now = span[0] if time is None else time
    check_situations(start, known, now, skill.kinematics, span, skill.summaries).act()


def tick_inputs(
    skill: Skill, time: Any, state: RobotState | Any, frames: Frames
) -> tuple[Tensor, Tensor | RobotState, dict[str, Frame]]:
    """Time, joints and frames as tensors of the robot's dtype and device.

    Parameters
    ----------
    skill : Skill
    time : float or Tensor
        [s].
    state : RobotState, array-like of shape (..., n_joints), or mapping of str to array-like
        Joints may go by name.
    frames : mapping of str to Frame

    Raises
    ------
    DataError, ShapeError, UnknownNameError
        If one is not finite, or the joints are others than the robot's.
    """
    kinematics = skill.kinematics
    if not isinstance(state, Tensor | RobotState):
        state = kinematics.joint_tensor(state)
    here = {name: frame.to(kinematics.lower) for name, frame in frames.items()}
    return as_tensor(time, "time").to(kinematics.lower), state, here


def _span(skill: Skill) -> Tensor:
    """Begin and end of a skill [s]."""
    return torch.tensor([skill.begin, skill.end], dtype=torch.float64)


def with_novelty(
    skill: Skill, situations: Sequence[Situation], trajectories: Sequence[Trajectory]
) -> list[Trajectory]:
    """Trajectories with the novelty of their situations, where the skill knows it.

    Parameters
    ----------
    skill : Skill
    situations, trajectories : sequence of Situation, sequence of Trajectory
    """
    summaries = skill.summaries
    if not summaries:
        return list(trajectories)
    found = []
    for one, situation in zip(trajectories, situations, strict=True):
        here = situation.joints, at_first(situation)
        novelty = min(float(summary.novelty(*here)) for summary in summaries)
        found.append(replace(one, novelty=novelty))
    return found


def at_first(situation: Situation) -> dict[str, Frame]:
    """Frames where the skill begins.

    Parameters
    ----------
    situation : Situation
    """
    frames = situation.frames.items()
    return {name: frame[0] if frame.batch_shape else frame for name, frame in frames}
