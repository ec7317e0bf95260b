"""Demonstrations at another rate; idle starts and ends cut off."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import torch
from torch import Tensor

from tpgmm_datasets.errors import DatasetError
from tpgmm_torch import quaternions
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.pose_names import quaternion_groups

__all__ = ["resample", "trim"]


def resample(demonstration: Demonstration, rate: float) -> Demonstration:
    """Resample a demonstration at another rate; it starts at 0 then.

    Joints and positions are interpolated linearly, quaternions (those among the joints too,
    known by their names ``*.qw`` ... ``*.qz``) along the great arc. Nothing is smoothed.

    Parameters
    ----------
    demonstration : Demonstration
        It stays as it is.
    rate : float
        Steps per second.

    Raises
    ------
    DatasetError
        If ``rate`` is not a positive number.

    Examples
    --------
    >>> shown = Demonstration([0.0, 0.5, 1.0], [[0.0], [1.0], [2.0]])
    >>> resample(shown, rate=4).joints[:, 0].tolist()
    [0.0, 0.5, 1.0, 1.5, 2.0]
    """
    if not 0 < rate < float("inf"):
        raise DatasetError(f"the rate is a number > 0, got {rate!r}")
    source = demonstration.time - demonstration.time[0]
    # the last step counts if it is on the new grid up to rounding
    steps = int(float(source[-1]) * rate + 1e-6) + 1
    target = torch.arange(steps, dtype=source.dtype) / rate
    if len(source) == 1:
        events = dict.fromkeys(demonstration.events, 0.0)
        return replace(demonstration, time=target, events=events)
    right = torch.searchsorted(source, target).clamp(1, len(source) - 1)
    width = source[right] - source[right - 1]
    fraction = ((target - source[right - 1]) / width).clamp(0, 1)

    def linear(values: Tensor) -> Tensor:
        return torch.lerp(values[right - 1], values[right], fraction[:, None])

    def arc(values: Tensor) -> Tensor:
        return quaternions.slerp(values[right - 1], values[right], fraction)

    joints = linear(demonstration.joints)
    for group in map(list, quaternion_groups(demonstration.joint_names)):
        unit = quaternions.normalize(quaternions.continuous(demonstration.joints[:, group]))
        joints[:, group] = quaternions.continuous(arc(unit))
    frames = {
        name: frame.between(right - 1, fraction) if frame.batch_shape else frame
        for name, frame in demonstration.frames.items()
    }
    first, last = float(demonstration.time[0]), float(target[-1])
    events = {name: min(at - first, last) for name, at in demonstration.events.items()}
    commands = None if demonstration.commands is None else linear(demonstration.commands)
    wrenches = {link: linear(wrench) for link, wrench in demonstration.wrenches.items()}
    return replace(
        demonstration, time=target, joints=joints, frames=frames, events=events,
        wrenches=wrenches, commands=commands
    )  # fmt: skip


def trim(demonstration: Demonstration, speed: float, **where: Any) -> Demonstration:
    """Cut off the start and end in which nothing moves; time starts at 0 then.

    Parameters
    ----------
    demonstration : Demonstration
        It stays as it is.
    speed : float
        Idle is where every joint is slower than this [rad/s or m/s]. Events are kept in.
    **where
        File and episode, for errors.

    Raises
    ------
    DatasetError
        If it is idle throughout.

    Examples
    --------
    >>> shown = Demonstration([0.0, 1.0, 2.0, 3.0], [[0.0], [0.0], [1.0], [2.0]])
    >>> trim(shown, speed=0.1).time.tolist()
    [0.0, 1.0, 2.0]
    """
    time, holds = demonstration.time, demonstration.holds
    speeds = (demonstration.joints.diff(dim=0) / time.diff()[:, None]).abs().amax(dim=1)
    moving = torch.nonzero(speeds > speed).flatten()
    if not len(moving):
        fastest = float(speeds.max()) if len(speeds) else 0.0
        message = f"nothing moves faster than trim = {speed:g}; the fastest is {fastest:.3g}"
        raise DatasetError(message, **where)
    events = [int((time - at).abs().argmin()) for at in demonstration.events.values()]
    start = min([int(moving[0]), *events])
    stop = max([int(moving[-1]) + 1, *events]) + 1
    kept = slice(start, stop)
    first, last = float(time[start]), float(time[stop - 1])
    return replace(
        demonstration.at_steps(kept),
        time=time[kept] - first,
        holds=holds and tuple(hold.retime(lambda at: at - first) for hold in holds),
        events={n: min(max(at, first), last) - first for n, at in demonstration.events.items()},
    )
