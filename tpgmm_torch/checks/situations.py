"""Check of new situations and of the first control tick: units, clock, novelty."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from tpgmm_torch.checks.report import Finding, Report
from tpgmm_torch.checks.summary import TrainingSummary
from tpgmm_torch.checks.training import IMPOSSIBLE
from tpgmm_torch.data.arrays import as_array
from tpgmm_torch.data.frames import Frames
from tpgmm_torch.robots.kinematics import Kinematics

#: Within this share of a skill's duration from its begin, a posture is a start.
START = 0.02


def check_situations(
    joints: Tensor,
    frames: Frames,
    times: Tensor,
    kinematics: Kinematics,
    learned: Tensor,
    summaries: Sequence[TrainingSummary] = (),
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
        Whose limits count.
    learned : Tensor of shape (T,)
        The model's time grid [s].
    summaries : sequence of TrainingSummary, optional
        Of the demonstrations; of several ways of a skill the nearest one counts.
    """
    findings = list(_time(times, learned))
    shapes = [frame.batch_shape for frame in frames.values()]
    batch = np.broadcast_shapes(joints.shape[:-1], *shapes)
    rows = joints.expand(*batch, kinematics.n_joints)
    values, lower, upper = map(as_array, (rows, kinematics.lower, kinematics.upper))
    excess = np.maximum(lower - values, values - upper)
    begin, end = float(learned[0]), float(learned[-1])
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


def _time(times: Tensor, learned: Tensor) -> Iterator[Finding]:
    """Find times that lie before or after the skill by more than it lasts."""
    begin, end = float(learned[0]), float(learned[-1])
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
