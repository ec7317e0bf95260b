"""What servos need: how far commands were from measured joints, learned from demonstrations.

A robot stands where its servos leave it, not where it is commanded: gravity makes joints sag,
a gripper closes on an object, a hand presses, and all of them are late while they move. Where
demonstrations hold both, commands and measured joints, the gap between them is known:

    u(t) - q(t) = lag * dq/dt + g(t) + noise

``lag`` [s] is one of each joint. ``g``, the gap that is left where a joint rests against its
command, is a function of the skill's time.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d, maximum_filter1d
from torch import Tensor

from tpgmm_torch.data.arrays import Array, as_array
from tpgmm_torch.data.demonstrations import Demonstration

#: Instants of a skill at which gaps are known.
INSTANTS = 200
#: Width by which gaps are smoothed [s].
SMOOTHING = 0.1
#: Demonstrations that are aligned still differ by about as much in time [s].
TIMING = 0.5
#: What a lag may be wrong by, and what it may then change a gap by at rest [rad or m].
LAG_ERROR, RESTING = 0.3, 0.01
#: Time constants after which a joint has come to rest.
SETTLED = 3.0
#: The longest lag of a position servo [s].
LONGEST_LAG = 0.5
#: Gaps at rest that are mentioned [rad or m].
NOTICED = 0.02
#: What tells joints of two arms apart.
SIDE = re.compile(r"(^|_)(left|right|l|r)(_|$)", re.IGNORECASE)
#: Words that end so have a longer plural.
HISSING = ("s", "x", "h")
#: Share of its largest speed above which a joint moves, and rows that tell its lag.
MOVING, FEWEST = 0.05, 10


@dataclass(frozen=True, eq=False)
class CommandGaps:
    """Gaps between commands and measured joints, by the time of a skill.

    Parameters
    ----------
    time : Tensor of shape (T,)
        In the skill [s].
    gap : Tensor of shape (T, n_joints)
        What a command has to be beyond the posture that is wanted, at rest [rad or m].
    extent : Tensor of shape (T, n_joints)
        Size of the largest gap at rest of any demonstration, half a second around [rad or m].
    lag : Tensor of shape (n_joints,)
        How late joints are [s].
    """

    time: Tensor
    gap: Tensor
    extent: Tensor
    lag: Tensor

    @classmethod
    def learn(cls, episodes: Sequence[Array | None], time: Tensor) -> Self | None:
        """Learn from the gaps of demonstrations; None where there are none.

        Parameters
        ----------
        episodes : sequence of array of shape (3, INSTANTS, n_joints), or None
            :func:`episode_gaps` of each demonstration.
        time : Tensor of shape (T,)
            Of the skill [s].
        """
        known = [one for one in episodes if one is not None]
        if not known:
            return None
        gaps, resting, lags = np.stack(known, 1)
        gaps = np.where(np.abs(gaps * resting).max((0, 1)) > RESTING, gaps, 0.0)
        if not gaps.any():
            return None
        begin, end = float(time[0]), float(time[-1])
        width = max(1, round(2 * TIMING * (INSTANTS - 1) / (end - begin))) | 1
        extent = maximum_filter1d((np.abs(gaps) * resting).max(0), width, 0, mode="nearest")
        grid = np.linspace(begin, end, INSTANTS)
        arrays = grid, np.median(gaps, 0), extent, np.median(lags[:, 0], 0)
        return cls(*(torch.from_numpy(np.ascontiguousarray(one)).to(time) for one in arrays))

    def at(self, time: Array) -> tuple[Array, Array]:
        """Interpolate gaps and extents (B, n_joints) at times (B,) of the skill."""
        grid = as_array(self.time)
        place = np.interp(time, grid, np.arange(len(grid)))
        lower = np.minimum(place.astype(int), len(grid) - 2)
        share = (place - lower)[:, None]
        gap, extent = (
            rows[lower] + share * (rows[lower + 1] - rows[lower])
            for rows in (as_array(self.gap), as_array(self.extent))
        )
        return gap, extent

    def describe(self, joint_names: Sequence[str], lengths: Collection[int] = ()) -> str:
        """Say in a sentence what was learned, the largest gaps first.

        A joint whose gap comes and goes meets something, as a gripper does; one that always
        has a gap sags. Joints that are called alike, left and right, are told of together.

        Parameters
        ----------
        joint_names : sequence of str
            Names of the joints, in their order.
        lengths : collection of int
            Numbers of those that are in metres.

        Examples
        --------
        >>> time = torch.linspace(0, 1, 5, dtype=torch.float64)
        >>> gap = torch.zeros(5, 3, dtype=torch.float64)
        >>> gap[:, 0], gap[2:, 1:] = -0.06, 0.6
        >>> gaps = CommandGaps(time, gap, gap.abs(), gap[0].abs())
        >>> gaps.describe(["lift", "left_gripper", "right_gripper"])
        'grippers are commanded 0.6 rad beyond; lift sags 0.06 rad'
        """
        size = np.abs(as_array(self.gap))
        most, least = size.max(0), np.quantile(size, 0.1, axis=0)
        alike: dict[tuple[str, bool], list[int]] = {}
        for joint in np.flatnonzero(most > NOTICED).tolist():
            called = SIDE.sub("", joint_names[joint]) or joint_names[joint]
            alike.setdefault((called, bool(least[joint] > NOTICED / 2)), []).append(joint)
        said = []
        for (called, sags), joints in sorted(alike.items(), key=lambda one: -max(most[one[1]])):
            name, be, sag = joint_names[joints[0]], "is", "sags"
            if len(joints) > 1:
                name, be, sag = (
                    f"{called}{'es' if called.endswith(HISSING) else 's'}",
                    "are",
                    "sag",
                )
            unit = "m" if joints[0] in lengths else "rad"
            far = f"{round(max(most[joints]), 2):g} {unit}"
            said.append(
                f"{name} {sag} {far}" if sags else f"{name} {be} commanded {far} beyond"
            )
        return "; ".join(said) or f"no joint rests more than {NOTICED} rad from its command"


def episode_gaps(demonstration: Demonstration) -> Array | None:
    """Compute what commands were beyond joints, at instants of equal phase.

    Parameters
    ----------
    demonstration : Demonstration
        With commands, or without.

    Returns
    -------
    array of shape (3, INSTANTS, n_joints), or None
        Gaps that are left where joints rest, and between [rad or m]; whether they rest; lags
        [s].
        None without commands, or where there are too few instants.
    """
    if demonstration.commands is None or len(demonstration) < FEWEST:
        return None
    time, joints = as_array(demonstration.time), as_array(demonstration.joints)
    commands = as_array(demonstration.commands)
    speed, command_speed = (_speeds(rows, time) for rows in (joints, commands))
    gap = commands - joints
    lag = _find_lags(gap, speed, command_speed, float(np.median(np.diff(time))))
    slow, resting = _find_resting(time, speed, command_speed, lag)
    phases = np.linspace(time[0], time[-1], INSTANTS)
    found = np.zeros((3, INSTANTS, joints.shape[1]))
    for joint, rests in enumerate(resting.T):
        if rests.any():
            left = _fill_motion(
                gap[:, joint] - lag[joint] * speed[:, joint], slow[:, joint], rests
            )
            found[0, :, joint] = np.interp(phases, time, left)
            found[1, :, joint] = np.interp(phases, time, rests) > 0.5
    smoothing = SMOOTHING / (phases[1] - phases[0])
    found[0] = gaussian_filter1d(found[0], smoothing, axis=0, mode="nearest")
    found[2] = lag
    return found


def _speeds(rows: Array, time: Array) -> Array:
    """Compute speeds (T, n_joints) of central differences."""
    return np.asarray(np.gradient(rows, time, axis=0))


def _find_lags(gap: Array, speed: Array, command_speed: Array, shortest: float) -> Array:
    """Find how late joints are [s]: median of gaps over speeds, weighted by speeds.

    Rows count in which joint and command move alike. Where a command only leaps, the lag is
    what the gap adds up to over time, as a share of the way.
    """
    lags = np.full(gap.shape[1], shortest)
    for joint in range(gap.shape[1]):
        g, v, w = gap[:, joint], speed[:, joint], command_speed[:, joint]
        least = MOVING * np.abs(v).max()
        rests = np.abs(v) <= least
        g = g - (np.median(g[rests]) if rests.any() else 0.0)
        moves = ~rests & (np.abs(w - v) < 0.5 * np.abs(v))
        if moves.sum() < FEWEST:
            if not rests.all():
                lags[joint] = (g * np.sign(v))[~rests].sum() / np.abs(v[~rests]).sum()
            continue
        ratio = g[moves] / v[moves]
        order, weight = np.argsort(ratio), np.abs(v[moves])
        total = np.cumsum(weight[order])
        lags[joint] = ratio[order][np.searchsorted(total, total[-1] / 2)]
    return np.clip(lags, shortest, LONGEST_LAG)


def _fill_motion(gap: Array, slow: NDArray[np.bool_], rests: NDArray[np.bool_]) -> Array:
    """Replace the gaps (T,) of a joint that does not rest by those of rests before and after.

    While it comes to rest it is the next one. In motion it is the smaller one: a gripper
    presses from when it has met an object until it begins to open.
    """
    rows, at = np.arange(len(gap)), np.flatnonzero(rests)
    place = np.searchsorted(at, rows)
    following, before = at[place.clip(max=len(at) - 1)], at[(place - 1).clip(min=0)]
    moving = np.append(np.flatnonzero(~slow), len(gap))
    comes = slow & (place < len(at)) & (moving[np.searchsorted(moving, rows)] > following)
    smaller = np.where(np.abs(gap[before]) < np.abs(gap[following]), before, following)
    return gap[np.where(rests, rows, np.where(comes, following, smaller))]


def _find_resting(
    time: Array, speed: Array, command_speed: Array, lag: Array
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Find rows (T, n_joints) in which joints are slow, and rest against their commands.

    They are so slow that a lag which is not quite right changes nothing; they rest when they
    have been for as long as it takes to come to rest.
    """
    fastest = np.maximum(np.abs(speed), np.abs(command_speed))
    slow = LAG_ERROR * lag * fastest < RESTING
    moved = np.where(slow, time[0] - SETTLED * LONGEST_LAG, time[:, None])
    resting: NDArray[np.bool_] = slow & (
        time[:, None] - np.maximum.accumulate(moved, 0) > SETTLED * lag
    )
    return slow, resting
