"""Check of new situations and of the first control tick: units, clock, novelty."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from torch import Tensor

from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.checks.training import IMPOSSIBLE
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.robots.kinematics import Kinematics

__all__ = ["START", "check_situations"]

#: Within this share of a skill's duration from its begin, a posture is a start.
START = 0.02


def check_situations(
    joints: Tensor,
    frames: Mapping[str, Frame],
    times: Tensor,
    kinematics: Kinematics,
    learned: Tensor,
    summary: TrainingSummary | None = None,
) -> Report:
    """Check where robots and objects are when a skill begins, or goes on.

    Postures beyond their limits by more than a turn are an error. Unlikely are times of another
    clock, and situations unlike the demonstrations; of a batch the most unlike is named.

    Parameters
    ----------
    joints : Tensor of shape (..., n_joints)
        Postures; after the first 2 % of the skill they are no starts, and only their units
        count.
    frames : mapping of str to Frame
        Of shapes that broadcast with the batch.
    times : Tensor
        When references are wanted [s].
    kinematics : Kinematics
    learned : Tensor of shape (T,)
        The model's time grid [s].
    summary : TrainingSummary, optional
        Of the demonstrations.
    """
    begin, end = float(learned[0]), float(learned[-1])
    first, last = float(times.min()), float(times.max())
    findings = []
    if first < 2 * begin - end or last > 2 * end - begin:
        message = (
            f"references are wanted from {first:.4g} to {last:.4g} s, the skill goes from "
            f"{begin:.4g} to {end:.4g} s"
        )
        remedy = (
            "Is time in seconds, and from the same zero? Without one the skill's own is used"
        )
        findings.append(Finding("time", message, remedy, value=last))
    poses = dict(frames)
    batch = np.broadcast_shapes(joints.shape[:-1], *(f.batch_shape for f in poses.values()))
    rows = joints.expand(*batch, kinematics.n_joints)
    values, lower, upper = map(as_array, (rows, kinematics.lower, kinematics.upper))
    excess = np.maximum(lower - values, values - upper)
    starts = rows if first <= begin + START * (end - begin) else None
    novelty = np.zeros(batch) if summary is None else summary.novelty(starts, poses)
    worst = np.unravel_index(
        int(np.where(excess.max(axis=-1) > IMPOSSIBLE, np.inf, novelty).argmax()), batch
    )
    label = f"situation {worst[0]}, " if len(batch) == 1 and batch[0] > 1 else ""
    joint = int(excess[worst].argmax())
    name, value = kinematics.joint_names[joint], values[*worst, joint]
    if excess[*worst, joint] > IMPOSSIBLE:
        message = (
            f"{label}start posture: {name} = {value:.4g} cannot be in radians, its limits are "
            f"{lower[joint]:.4g} to {upper[joint]:.4g}"
        )
        remedy = "Is the posture in degrees? Convert all of it (np.deg2rad)"
        findings.append(Finding("units", message, remedy, (name,), impossible=True))
    elif summary is not None:
        here = {name: frame.expand(batch)[worst] for name, frame in poses.items()}
        start = None if starts is None else starts[worst]
        findings += summary.findings(start, here, label)
    subject = f"{batch[0]} situations" if label else "the situation"
    return Report.of(findings, subject)
