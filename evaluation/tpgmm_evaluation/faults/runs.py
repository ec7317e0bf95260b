"""Runs of controllers beside simulated servos, tick by tick."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from tpgmm_control.loop.controller import Controller
from tpgmm_evaluation.faults.drawing import POSES, READINGS, STOPS, Fault, Run
from tpgmm_evaluation.faults.servos import Servos
from tpgmm_evaluation.faults.skills import PATH_RATE

Array = NDArray[np.float64]
#: Seconds for which a robot is looked at after it has finished.
AFTER_END = 1.0


class Tick(NamedTuple):
    """One tick, or, stacked, all of a run.

    ``joints`` and ``shadow`` are those of the servos, and of servos that follow the same
    references undisturbed; ``expected`` is read by sensors that have an offset and noise at
    most, ``reading`` is what the controller was given; ``progress`` [s], ``status`` and
    whether a reason was ``said`` are its answer.
    """

    given: Any
    time: Any
    reference: Any
    joints: Any
    shadow: Any
    load: Any
    expected: Any
    reading: Any
    progress: Any
    status: Any
    said: Any


@dataclass(eq=False)
class Log:
    """One robot with its controller: what became of a run.

    Parameters
    ----------
    run : Run
        As it was drawn.
    done : float
        When it finished [s].
    error : str
        An exception, which ends the run.
    reason : str
        Of the last status.

    Attributes
    ----------
    reference, reading : ndarray of shape (n_joints,)
        The last ones.
    """

    run: Run
    done: float = np.inf
    error: str = ""
    reason: str = ""
    rows: list[Tick] = field(default_factory=list)

    def __post_init__(self) -> None:
        at = self.run.situation
        self.reference = self.reading = at.joints
        self._controller = Controller(at.skill, at.joints, at.frames)

    @property
    def ticks(self) -> Tick:
        """All ticks as arrays of shape (n_ticks, ...)."""
        return Tick(*(np.array(column) for column in zip(*self.rows, strict=True)))

    def is_over(self, now: float) -> bool:
        """Return whether nothing happens any more."""
        return bool(self.error) or now > self.done + AFTER_END

    def step(self, given: float, now: float, joints: Array, load: Array) -> None:
        """Take the next reference; nothing happens after the end."""
        if self.is_over(now):
            return
        expected, self.reading = _read(self.run, joints[0], self.reading, now)
        try:
            command = self._controller.step(given, self.reading, _seen(self.run, now))
        except Exception as error:
            self.error, self.done = f"{type(error).__name__}: {error}", now
            return
        self.reference, self.reason = command.reference.numpy(), command.reason()
        self.done = min(self.done, now if self._controller.finished else np.inf)
        ours = self.reference, joints[0], joints[1], load, expected
        said = bool(self.reason)
        answer = self.reading, float(command.time), str(command.status), said
        self.rows.append(Tick(given, now, *ours, *answer))


def simulate(runs: Sequence[Run]) -> list[Log]:
    """Run controllers, each alone, beside servos that are simulated together.

    Parameters
    ----------
    runs : sequence of Run
        Of one robot and one rate.
    """
    logs = [Log(run) for run in runs]
    starts, limits = np.array([log.reference for log in logs]), runs[0].situation.limits
    n_ticks = len(runs[0].true)
    servos = Servos([run.servo for run in runs], starts, limits[:2], n_ticks)
    now = np.zeros(len(runs))
    for k in range(n_ticks):
        dt = np.array([run.true[k] for run in runs])
        now = now + dt
        load = _disturb(runs, now, servos, dt)
        for i, log in enumerate(logs):
            log.step(log.run.given[k], now[i], servos.joints[:, i], load[i])
        if all(log.is_over(at) for log, at in zip(logs, now, strict=True)):
            break
        servos.send(np.array([log.reference for log in logs]))
    return logs


def _read(run: Run, joints: Array, last: Array, now: float) -> tuple[Array, Array]:
    """Read joints with an offset and noise at most, and with all faults."""
    step = run.servo.resolution
    noisy = joints + run.servo.noise * run.rng.standard_normal(len(joints))
    expected = reading = np.round(noisy / step) * step
    for fault in run.faults:
        if fault.kind in READINGS and fault.active(now):
            reading = READINGS[fault.kind](reading, fault, last, run.rng)
            expected = reading if fault.kind in ("offset", "noise") else expected
    return expected, reading


def _seen(run: Run, now: float) -> Mapping[str, Array] | None:
    """Return poses of the objects, where a camera sees them."""
    faults = [fault for fault in run.faults if fault.kind in POSES]
    if not faults:
        return None
    seen = {}
    for name, frame in run.situation.frames.items():
        pose = np.append(frame.position, frame.orientation)
        for fault in faults:
            pose = POSES[fault.kind](pose, fault, run.rng) if fault.active(now) else pose
        seen[name] = pose / np.append(np.ones(3), np.full(4, np.linalg.norm(pose[3:])))
    return seen


def _disturb(runs: Sequence[Run], now: Array, servos: Servos, dt: Array) -> Array:
    """Advance the servos by a tick, disturbed by somebody; return the loads."""
    shape = servos.joints.shape[1:]
    held, (load, rubs) = np.zeros(shape, dtype=bool), np.zeros((2, *shape))
    surface = np.full(shape, np.inf)
    walls = np.stack((np.full(shape, -np.inf), np.full(shape, np.inf)))
    for i, run in enumerate(runs):
        for fault in run.faults:
            if fault.kind == "payload":
                load[i] += fault.size * fault.joints * fault.active(now[i])
            elif fault.kind == "rub":
                rubs[i] += fault.size * np.abs(fault.joints) * fault.active(now[i])
            elif fault.kind in STOPS:
                held[i] |= (fault.joints != 0) & fault.active(now[i])
            elif fault.kind in ("contact", "grasp") and fault.active(now[i]):
                _block(run, fault, walls[:, i], servos.joints[0, i])
                surface[i][fault.joints != 0] = fault.surface
            elif fault.kind in ("push", "teleport", "drag") and fault.active(now[i]):
                moved = (fault.joints != 0) | (fault.kind != "drag")
                servos.place(i, _carry(run, fault, servos.joints[0, i], now[i]), moved)
                held[i] |= moved
    servos.advance(dt, held, load, walls, surface, rubs)
    return load


def _block(run: Run, fault: Fault, walls: Array, joints: Array) -> None:
    """Put a wall before where a joint would come to in the meantime; it pushes nobody away."""
    fault.kept = joints if fault.kept is None else fault.kept
    [joint] = np.flatnonzero(fault.joints)
    part = run.situation.path[:, joint]
    part = part[int(fault.begin * PATH_RATE) : int(min(fault.end, 100) * PATH_RATE)]
    if len(part) and fault.joints[joint] > 0:
        walls[1, joint] = max(part.max() - fault.size, fault.kept[joint])
    elif len(part):
        walls[0, joint] = min(part.min() + fault.size, fault.kept[joint])


def _carry(run: Run, fault: Fault, joints: Array, now: float) -> Array:
    """Carry a robot: at once to anywhere, a joint slowly, or all of them along their way."""
    path = run.situation.path
    if fault.kept is None:
        fault.kept = joints
    if fault.kind == "teleport":
        return fault.kept + fault.size * fault.joints
    share = min(1.0, 2 * (now - fault.begin) / (fault.end - fault.begin))
    if fault.kind == "drag":
        low, high = run.situation.limits[:2]
        return (fault.kept + share * fault.size * fault.joints).clip(low, high)
    goal = path[int(np.clip((fault.begin + fault.size) * PATH_RATE, 0, len(path) - 1))]
    return fault.kept + share * (goal - fault.kept)
