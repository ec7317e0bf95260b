"""Measures of faults in a run: bounds, status, end, gap, runaway."""

from __future__ import annotations

import warnings
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import batched, chain

import numpy as np
import torch
from numpy.typing import NDArray

from tpgmm_evaluation.faults.drawing import KINDS, POSES, STOPS, Run
from tpgmm_evaluation.faults.runs import Log, Tick, simulate
from tpgmm_evaluation.processes import call_all

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Measures = Mapping[str, float]
#: Share by which rounding may exceed a bound.
ROOM = 1.01
#: Time in which a skill that goes on has gone on [s].
STANDS = 0.2
#: Robots whose servos are simulated together.
TOGETHER = 16


def measure_runs(runs: Sequence[Run], workers: int = 1) -> list[tuple[Run, Measures]]:
    """Simulate runs in several processes, and measure them."""
    groups = defaultdict(list)
    for run in runs:
        groups[run.robot, run.rate].append(run)
    parts = [part for group in groups.values() for part in batched(group, TOGETHER)]
    if workers == 1:
        found = [_measure_part(part) for part in parts]
    else:
        found = call_all(_measure_part, [(part,) for part in parts], workers)
    return list(chain.from_iterable(found))


def _measure_part(runs: Sequence[Run]) -> list[tuple[Run, Measures]]:
    torch.set_num_threads(1)
    with warnings.catch_warnings(action="ignore"):
        return [(log.run, measure(log)) for log in simulate(runs)]


def measure(log: Log) -> Measures:
    """Measure one run.

    Returns
    -------
    mapping of str to float
        ``ticks``; ticks beyond ``position``, ``speed``, ``acceleration`` and ``jerk``, over
        the durations in which references may move (:attr:`Run.drive`), ``infinite`` ones, and
        those with a ``false`` status; ``step``, the largest change in units of what its bound
        allows in a usual period; ``raised``, whether there was an exception; ``ended``;
        ``open``, whether it neither finished, nor waits at last and names a joint, nor holds
        for readings that last; ``stuck``, whether it did not finish with nothing in its way;
        ``mute``, for how long its status was running or its reason empty while it stood [s];
        ``late``, seconds after the skill and all interruptions; ``gap``, between reference and
        joints while stopped, on top of what it was at that moment or would be with its lag
        [rad]; ``runaway``, the distance of the reference from the undisturbed path, on top of
        1.5 times what readings, sag and load are off [rad]. What does not apply is NaN.
    """
    ticks, at, done = log.ticks, log.run.situation, log.done < np.inf
    moved = np.diff(ticks.reference, axis=0) * log.run.rate / at.limits[2]
    low, high = at.limits[0] - 1e-9, at.limits[1] + 1e-9
    drive = log.run.drive[: len(ticks.time)]
    rates = _rates(ticks.reference, drive, at.joints, at.limits[2:])
    beyond = [float((rate > ROOM).sum()) for rate in rates]
    return {
        "ticks": len(ticks.time),
        "position": float(((ticks.reference < low) | (ticks.reference > high)).any(-1).sum()),
        **dict(zip(("speed", "acceleration", "jerk"), beyond, strict=True)),
        "step": float(np.nanmax(np.abs(moved), initial=0)),
        "infinite": float((~np.isfinite(ticks.reference)).any(-1).sum()),
        "raised": float(bool(log.error)),
        "false": float(false_status(log).sum()),
        "ended": float(done and not log.error),
        "open": float(_open(log, ticks)),
        "stuck": float(not done and all(f.end < ticks.time[-1] - 4 for f in log.run.faults)),
        "mute": float(_mute(log, ticks).max()),
        "late": _late(log, ticks),
        "gap": _gap(log, ticks),
        "runaway": _runaway(log, ticks),
    }


def _rates(
    references: Array, drive: Array, start: Array, limits: tuple[Array, ...]
) -> list[Array]:
    """Compute speed, acceleration and jerk of each tick, in units of their limits."""
    timed = drive > 0
    reference = np.concatenate((start[None], references))
    jumped = (np.diff(reference, axis=0)[~timed] != 0).any(-1)  # in no time
    dt = drive[timed]
    before = np.concatenate((dt[:1], dt[:-1]))
    earlier = np.concatenate((before[:1], before[:-1]))
    change = np.diff(np.concatenate((start[None], references[timed])), axis=0)
    rates = []
    for span, limit in zip(
        (dt, (dt + before) / 2, (dt + before + earlier) / 3), limits, strict=True
    ):
        rate = change / span[:, None]
        rates.append(np.abs(rate / limit).max(-1))
        change = np.diff(rate, axis=0, prepend=0)
    return [np.concatenate((rates[0], np.where(jumped, np.inf, 0.0))), *rates[1:]]


def _lasting(mask: Mask, time: Array) -> Array:
    """Compute for how long something has been so at each tick [s]; 0 where it is not."""
    return time - np.maximum.accumulate(np.where(mask, 0.0, time))


def _readings(log: Log, ticks: Tick) -> tuple[Mask, Mask]:
    """Find ticks with readings that cannot be right, and with readings that are off."""
    off = np.abs(ticks.reading - ticks.expected)
    lost = np.isnan(off).any(-1)
    off = np.nan_to_num(off).max(-1)
    zero = (ticks.reading == 0).all(-1) & (off > 0.1)
    kinds = ("units", "swapped", "flipped", "frozen")
    wrong, unseen = (
        [fault.active(ticks.time) for fault in log.run.faults if fault.kind in names]
        for names in (kinds, ("pose lost", "pose flipped"))
    )
    jump = 0.1 + 1.5 * log.run.situation.limits[2].min() / log.run.rate
    far = np.any(wrong, axis=0) & (off > max(0.5, jump))
    return lost | zero | far, lost | (off > 0.02) | np.any(unseen, axis=0)


def false_status(log: Log) -> Mask:
    """Find ticks with a status that is not so.

    A robot has to *hold* while readings are impossible for more than 0.3 s; to *wait* (or be
    *displaced*) while it is away from where its servos would be if nothing had disturbed them,
    for longer than they need to come there; to *run* (or be *finished*) while it is there for
    that long, nobody holds it, its readings are right, and no offset or load has changed.
    Between these, it may have any status, but neither runs while progress stands, nor runs or
    has finished while a joint is held more than 0.1 rad off, for half a second.
    """
    ticks, servo, few = log.ticks, log.run.servo, 2 / log.run.rate
    swings = max(1.0, (0.6 / np.min(servo.damping)) ** 2)
    settle = 0.5 + 2 * (swings * np.max(servo.lag) + servo.delay) + few
    slack = np.max(2 * servo.stiction + servo.backlash) + 3 * servo.noise
    slack += max((fault.size for fault in log.run.faults if fault.kind == "rub"), default=0.0)
    apart = np.abs(ticks.joints - ticks.shadow)
    impossible, off = _readings(log, ticks)
    holds = _holds(log, ticks)
    running, waiting, ended, holding = (
        np.isin(ticks.status, names)
        for names in (("running",), ("waiting", "displaced"), ("finished",), ("holding",))
    )
    lag = np.abs(ticks.reference - servo.sag - ticks.load - ticks.shadow).max(-1)
    changed = np.abs(np.diff(_offset(log, ticks), axis=0, prepend=0)).max(-1) > 1e-3
    calm = (apart.max(-1) < 0.01 + slack) & ~off & (lag < 0.1) & ~changed & ~holds.any(-1)
    held = (apart * holds * _arm(log) > 0.1 + slack).any(-1) & (running | ended)
    wrong = ((_mute(log, ticks) > 0.5) | (_lasting(held, ticks.time) > 0.5)) & ~off
    wrong |= (_lasting(calm, ticks.time) > settle) & ~(running | ended)
    room = 0.1 if any(fault.surface < np.inf for fault in log.run.faults) else 0.03
    away = (apart[:, _arm(log)].max(-1) > room + slack) & ~off
    wrong = np.where(_lasting(away, ticks.time) > settle, ~waiting, wrong)
    lost = (_lasting(impossible, ticks.time) > 0.3 + few) | ~(ticks.given > 0)
    frozen = waiting & any(fault.kind == "frozen" for fault in log.run.faults)
    return np.where(lost, ~(holding | ended | frozen), wrong)


def _holds(log: Log, ticks: Tick) -> Mask:
    """Find joints that are held, dragged or touched, (n_ticks, n_joints)."""
    held = np.zeros(ticks.joints.shape, dtype=bool)
    for fault in log.run.faults:
        if fault.kind in (*STOPS, "drag", "contact"):
            held |= np.outer(fault.active(ticks.time), fault.joints != 0)
    return held


def _mute(log: Log, ticks: Tick) -> Array:
    """Compute for how long a robot has stood without a word, of its drives' time [s]."""
    lived = np.cumsum(log.run.drive[: len(ticks.time)])
    passed = ticks.progress - np.interp(lived - STANDS, lived, ticks.progress)
    last = np.searchsorted(lived, lived - STANDS)
    moved = np.abs(ticks.reference - ticks.reference[last]).max(-1) > 2e-3
    stands = (passed < 0.1 * STANDS) & (lived > STANDS)
    stands &= ~(moved & (ticks.progress >= log.run.situation.skill.end))  # what is last fades
    mute = (ticks.status == "running") | (~ticks.said & (ticks.status != "finished"))
    return _lasting(stands & mute, lived)


def _arm(log: Log) -> Mask:
    """Find joints that are waited for: no gripper, which closes on something."""
    return np.array(log.run.situation.skill.kinematics.joint_names) != "gripper"


def _offset(log: Log, ticks: Tick) -> Array:
    """Compute the offset of readings and load (n_ticks, n_joints)."""
    offset = ticks.load
    for fault in log.run.faults:
        if fault.kind == "offset":
            offset = offset + np.outer(fault.active(ticks.time), fault.size * fault.joints)
    return offset


def _open(log: Log, ticks: Tick) -> bool:
    names = log.run.situation.skill.kinematics.joint_names
    waits = ticks.status[-1] in ("waiting", "displaced") and any(
        name in log.reason for name in names
    )
    held = ticks.status[-1] == "holding" and _readings(log, ticks)[0][-1]
    return bool(log.error) or not (log.done < np.inf or waits or held)


def _late(log: Log, ticks: Tick) -> float:
    if not log.done < np.inf or log.error:
        return np.nan
    late = log.done - log.run.situation.skill.end
    for fault in log.run.faults:
        if KINDS[fault.kind][2] < np.inf:
            late -= max(0.0, min(fault.end, log.done) - fault.begin)
        if fault.kind in ("push", "stall"):
            late -= abs(fault.size)  # of the skill, and of real time
    return float(late)


def _gap(log: Log, ticks: Tick) -> float:
    gaps, gap = [], np.abs(ticks.reference - ticks.joints)
    usual = np.abs(ticks.reference - ticks.shadow)
    for fault in log.run.faults:
        inside = np.flatnonzero(fault.active(ticks.time))
        if fault.kind in STOPS and len(inside):
            before = gap[max(0, inside[0] - 1)]
            usual[inside] = np.maximum.accumulate(np.maximum(usual[inside], before))
            grown = gap[inside] - usual[inside]
            gaps.append(float((grown * (fault.joints != 0))[:, _arm(log)].max()))
    return max(gaps, default=np.nan)


def _runaway(log: Log, ticks: Tick) -> float:
    at, sag = log.run.situation, log.run.servo.sag
    if any(fault.kind in POSES for fault in log.run.faults):
        return 0.0  # there is another path to another pose
    every = slice(None, None, max(1, int(log.run.rate / 20)))
    distance = np.abs(ticks.reference[every, None] - at.path).max(-1).min(-1)
    away = np.abs(ticks.reading - ticks.shadow - sag).max(-1)
    away = np.where(_readings(log, ticks)[0], 0.0, away) + np.abs(ticks.load).max(-1)
    allowed = np.maximum.accumulate(np.nan_to_num(away)) + np.abs(sag).max()
    return float((distance - 1.5 * allowed[every]).max(initial=0))
