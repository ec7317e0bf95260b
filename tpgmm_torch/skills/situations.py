"""Situations, completed for a skill and compared with the demonstrations."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.checks.training import IMPOSSIBLE
from tpgmm_torch.data.arrays import as_array, as_tensor
from tpgmm_torch.data.demonstrations import Demonstration, Situation
from tpgmm_torch.data.frames import Frame, Frames
from tpgmm_torch.data.trajectories import Trajectory
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.robots.kinematics import Kinematics, RobotState
from tpgmm_torch.skills.skill import Skill

#: Within this share of a skill's duration from its begin, a posture is a start.
START = 0.02


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
    check_situations(skill, joints, frames, torch.stack(times)).act()


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
    known = {n: f.to(start) for n, f in frames.items() if n in skill.frame_names}
    now = torch.tensor(skill.begin, dtype=torch.float64) if time is None else time
    check_situations(skill, start, known, now).act()


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


def check_situations(skill: Skill, joints: Tensor, frames: Frames, times: Tensor) -> Report:
    """Check where robots and objects are when a skill begins, or goes on.

    Postures beyond their limits by more than a turn are an error. Unlikely are times of another
    clock, and situations unlike the demonstrations; of a batch the most unlike is named, and of
    several ways of a skill the nearest counts.

    Parameters
    ----------
    skill : Skill
    joints : Tensor of shape (..., n_joints)
        Postures; after the first 2 % of the skill they are no starts, and only their units
        count.
    frames : mapping of str to Frame
        Of shapes that broadcast with the batch.
    times : Tensor
        When references are wanted [s].
    """
    kinematics, summaries, begin, end = (
        skill.kinematics,
        skill.summaries,
        skill.begin,
        skill.end,
    )
    findings = list(_time(times, begin, end))
    shapes = [frame.batch_shape for frame in frames.values()]
    batch = np.broadcast_shapes(joints.shape[:-1], *shapes)
    rows = joints.expand(*batch, kinematics.n_joints)
    values, lower, upper = map(as_array, (rows, kinematics.lower, kinematics.upper))
    excess = np.maximum(lower - values, values - upper)
    starts = rows if float(times.min()) <= begin + START * (end - begin) else None
    novelties = [np.zeros(batch) + one.novelty(starts, frames) for one in summaries]
    novelty = np.min(novelties or [np.zeros(batch)], axis=0)
    unlike = np.where(excess.max(axis=-1) > IMPOSSIBLE, np.inf, novelty)
    worst = np.unravel_index(int(unlike.argmax()), batch)
    subject, label = _describe_batch(worst, batch)
    joint = int(excess[worst].argmax())
    if excess[*worst, joint] > IMPOSSIBLE:
        findings.append(_unit(kinematics, joint, values[*worst, joint], label))
    elif summaries:
        here = {name: frame.expand(batch)[worst] for name, frame in frames.items()}
        start = None if starts is None else starts[worst]
        nearest = min(summaries, key=lambda one: float(one.novelty(start, here)))
        findings += nearest.findings(start, here, label)
    return Report.of(findings, subject)


def _describe_batch(worst: tuple[Any, ...], batch: tuple[int, ...]) -> tuple[str, str]:
    """Name the batch, and one of its situations."""
    if len(batch) == 1 and batch[0] > 1:
        return f"{batch[0]} situations", f"situation {worst[0]}, "
    return "the situation", ""


def _unit(kinematics: Kinematics, joint: int, value: float, label: str) -> Finding:
    name, lower, upper = kinematics.joint_names[joint], kinematics.lower, kinematics.upper
    message = (
        f"{label}start posture: {name} = {value:.4g} cannot be in radians, its limits are "
        f"{float(lower[joint]):.4g} to {float(upper[joint]):.4g}"
    )
    remedy = "Is the posture in degrees? Convert all of it (np.deg2rad)"
    return Finding("units", message, remedy, (name,), impossible=True)


def _time(times: Tensor, begin: float, end: float) -> Iterator[Finding]:
    """Find times that lie before or after the skill by more than it lasts."""
    first, last = float(times.min()), float(times.max())
    if first < 2 * begin - end or last > 2 * end - begin:
        message = (
            f"references are wanted from {first:.4g} to {last:.4g} s, the skill goes from "
            f"{begin:.4g} to {end:.4g} s"
        )
        remedy = (
            "Is time in seconds, and from the same zero? Without one the skill's own is used"
        )
        yield Finding("time", message, remedy, value=last)
