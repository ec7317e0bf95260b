"""Whether new situations are like what a model has seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from torch import Tensor

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Situation
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.plausibility.findings import Finding, Report
from tpgmm_torch.plausibility.joints import IMPOSSIBLE
from tpgmm_torch.plausibility.shown import Shown
from tpgmm_torch.plausibility.summaries import poses_among
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["START", "situations_report", "tick_report"]

#: Within this share of a skill's duration from its begin, a posture is a start.
START = 0.02


def situations_report(
    situations: Sequence[Situation], shown: Shown | None, time: Tensor, kinematics: Kinematics
) -> Report:
    """What is implausible about situations: start posture, objects, clock.

    Parameters
    ----------
    situations : sequence of Situation
    shown : Shown or None
        What the model has seen; without it only the robot's limits and the clock count.
    time : Tensor of shape (T,)
        The model's time grid [s].
    kinematics : Kinematics
    """
    findings: list[Finding] = []
    many = len(situations) > 1
    for index, situation in enumerate(situations):
        label = f"situation {index}, " if many else ""
        impossible = _impossible_posture(as_array(situation.joints), kinematics, label)
        findings += impossible
        start = None if impossible else situation.joints
        if shown is not None and shown.distance(start, situation.frames).max() > 1:
            findings += shown.findings(start, situation.frames, label)
        if situation.time is not None and situation.time is not time:
            findings += _clock(situation.time[[0, -1]].tolist(), time, label)
    return Report.of(findings, f"{len(situations)} situations" if many else "the situation")


def tick_report(
    now: Tensor,
    joints: Tensor,
    frames: Mapping[str, Frame],
    shown: Shown | None,
    time: Tensor,
    kinematics: Kinematics,
) -> Report:
    """What is implausible about one control tick: units and places of a batch of robots.

    Parameters
    ----------
    now : Tensor of the batch shape, or of shape ()
        The time [s].
    joints : Tensor of shape (..., n_joints)
    frames : mapping of str to Frame
        Of shapes that broadcast with the batch.
    shown : Shown or None
    time : Tensor of shape (T,)
        The model's time grid [s].
    kinematics : Kinematics
    """
    begin, end = float(time[0]), float(time[-1])
    findings = _clock([float(now.min()), float(now.max())], time, "")
    rows = as_array(joints).reshape(-1, kinematics.n_joints)
    for row in rows:
        if impossible := _impossible_posture(row, kinematics, ""):
            findings += impossible
            break
    else:
        at_start = float(now.max()) <= begin + START * (end - begin)
        given = rows.reshape(joints.shape) if at_start else None
        if shown is not None and (distance := shown.distance(given, frames)).max() > 1:
            worst = np.unravel_index(distance.argmax(), distance.shape)
            start = (
                None
                if given is None
                else np.broadcast_to(given, (*distance.shape, kinematics.n_joints))[worst]
            )
            here = {
                name: frame.expand(distance.shape)[worst]
                for name, frame in poses_among(frames).items()
            }
            findings += shown.findings(start, here)
    return Report.of(findings, "the first tick")


def _impossible_posture(joints: Array, kinematics: Kinematics, label: str) -> list[Finding]:
    below, above = as_array(kinematics.lower) - joints, joints - as_array(kinematics.upper)
    excess = np.maximum(below, above)
    worst = int(excess.argmax())
    if not excess[worst] > IMPOSSIBLE:
        return []
    name = kinematics.joint_names[worst]
    return [
        Finding(
            "units",
            "error",
            f"{label}start posture: {name} = {joints[worst]:.4g} cannot be in radians, its "
            f"limits are {float(kinematics.lower[worst]):.4g} to "
            f"{float(kinematics.upper[worst]):.4g}",
            "Is the posture in degrees? Convert all of it (np.deg2rad)",
            (name,),
            value=float(excess[worst]),
        )
    ]


def _clock(given: Sequence[float], learned: Tensor, label: str) -> list[Finding]:
    """Times so far from the skill's that they are of another clock or unit."""
    begin, end = float(learned[0]), float(learned[-1])
    (first, last), length = given, end - begin
    if begin - length <= first and last <= end + length:
        return []
    return [
        Finding(
            "time",
            "unlikely",
            f"{label}references are wanted from {first:.4g} to {last:.4g} s, the skill goes "
            f"from {begin:.4g} to {end:.4g} s",
            "Is time in seconds, and from the same zero? Without one the skill's own is used",
            value=last,
        )
    ]
