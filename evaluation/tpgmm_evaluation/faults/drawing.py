"""Runs that are drawn: a robot, its servo, a rate, and faults."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from tpgmm_evaluation.faults.servos import Servo
from tpgmm_evaluation.faults.skills import ROBOTS, Scenario, situations

Array = NDArray[np.float64]
#: Of the seeds; constants are chosen on the first one alone.
HALVES = ("development", "held-out")
#: How much longer than its skill a run may be [s].
GRACE = 10.0
#: Durations that a tick may have, in usual ones, and memory of these in ticks.
LONGEST, MEMORY = 1.5, 10


@dataclass
class Fault:
    """Something that goes wrong for some time.

    Parameters
    ----------
    kind : str
        Key of ``KINDS``.
    begin, end : float
        Since the start of the run [s].
    joints : ndarray of shape (n_joints,)
        0, or a sign for joints that are concerned.
    size : float
        In the unit of the kind.
    kept : ndarray, optional
        What was found when it began.
    surface : float
        Stiffness of what is touched, in units of the drives'.
    """

    kind: str
    begin: float
    end: float
    joints: Array
    size: float = 1.0
    kept: Array | None = None
    surface: float = np.inf

    def __str__(self) -> str:
        joints, size = np.flatnonzero(self.joints).tolist(), f"{self.size:.3g}"
        on = f" on {self.surface:.2g}" if self.surface < np.inf else ""
        return f"{self.kind} {size}{on} of {joints}, {self.begin:.2f} to {self.end:.2f} s"

    def active(self, time: Array | float) -> NDArray[np.bool_]:
        """Return whether it lasts at these times."""
        return (time >= np.array(self.begin)) & (time < np.array(self.end))


def _freeze(reading: Array, fault: Fault, last: Array, rng: np.random.Generator) -> Array:
    if fault.kept is None:
        fault.kept = reading
    return fault.kept


def _swap(reading: Array, fault: Fault, last: Array, rng: np.random.Generator) -> Array:
    order, concerned = np.arange(len(reading)), np.flatnonzero(fault.joints)
    order[concerned] = np.roll(concerned, 1)
    return reading[order]


#: What is read in place of a reading y, given the last one.
READINGS: Mapping[str, Callable[[Array, Fault, Array, np.random.Generator], Array]] = {
    "offset": lambda y, fault, last, rng: y + fault.size * fault.joints,
    "noise": lambda y, fault, last, rng: y + fault.size * rng.standard_normal(len(y)),
    "dropped": lambda y, fault, last, rng: np.full_like(y, np.nan),
    "repeated": lambda y, fault, last, rng: last if rng.random() < fault.size else y,
    "frozen": _freeze,
    "zeros": lambda y, fault, last, rng: np.zeros_like(y),
    "swapped": _swap,
    "units": lambda y, fault, last, rng: np.rad2deg(y) if fault.size > 0 else np.deg2rad(y),
    "flipped": lambda y, fault, last, rng: np.where(fault.joints != 0, -y, y),
    "outliers": lambda y, fault, last, rng: (
        y + (rng.random() < 0.1) * fault.size * fault.joints
    ),
}
#: Smallest and largest size, longest duration [s], and how often all joints are concerned.
#: What may last for ever does so in half of the runs.
KINDS: Mapping[str, tuple[float, float, float, float]] = {
    "offset": (0.05, 0.35, np.inf, 0.0),  # rad
    "noise": (0.001, 0.03, np.inf, 1.0),  # rad, standard deviation
    "dropped": (1, 1, 1.5, 1.0),
    "repeated": (0.1, 0.9, np.inf, 1.0),  # share of the ticks
    "frozen": (1, 1, 2.5, 1.0),
    "zeros": (1, 1, 1.5, 1.0),
    "swapped": (1, 1, 1.5, 0.5),
    "units": (-1, 1, 1.5, 1.0),  # degrees, or radians taken for degrees
    "flipped": (1, 1, 1.5, 0.5),
    "outliers": (0.05, 1.0, np.inf, 0.0),  # rad
    "stall": (-0.3, 0.9, 3.0, 1.0),  # s, each second; if negative, the controller is not told
    "jitter": (0.1, 0.8, np.inf, 1.0),  # standard deviation of the logarithm of dt
    "clock": (0.02, 0.2, 1.5, 1.0),  # share of ticks whose dt is 0, negative or NaN
    "payload": (0.05, 0.35, np.inf, 0.0),  # rad
    "rub": (0.02, 0.1, np.inf, 0.0),  # rad, friction of a joint on both its sides
    "stop": (1, 1, 3.0, 0.7),
    "hold": (1, 1, 6.0, 0.0),
    "block": (1, 1, np.inf, 0.0),
    "drag": (0.1, 0.6, 3.0, 0.0),  # rad
    "push": (-2, 2, 0.5, 1.0),  # s along the undisturbed path
    "teleport": (0.05, 0.4, 0.1, 0.7),  # rad
    "contact": (0.02, 0.2, 6.0, 0.0),  # rad before where a joint would come to
    "grasp": (0.3, 1.2, 2.0, 0.0),  # the same of the last one, a gripper
    "pose lost": (1, 1, 2.0, 1.0),
    "pose noise": (0.001, 0.01, np.inf, 1.0),  # m, and three times that in quaternions
    "pose flipped": (1, 1, 2.0, 1.0),
}
#: Joints that do not move; what takes the time of a skill.
STOPS = ("stop", "hold", "block")
#: What is seen of a pose (7,), position and quaternion.
POSES: Mapping[str, Callable[[Array, Fault, np.random.Generator], Array]] = {
    "pose lost": lambda pose, fault, rng: np.full(7, np.nan),
    "pose noise": lambda pose, fault, rng: (
        pose + fault.size * np.repeat((1, 3), (3, 4)) * rng.standard_normal(7)
    ),
    "pose flipped": lambda pose, fault, rng: np.append(pose[:3], pose[[5, 6, 3, 4]]),
}


@dataclass(eq=False)
class Run:
    """One run, to be simulated once.

    Parameters
    ----------
    robot : str
        Key of :data:`~tpgmm_evaluation.faults.skills.ROBOTS`.
    rate : float
        [Hz].
    servo : Servo
        Of all joints.
    faults : sequence of Fault
        In the order in which they have an effect.
    number : int
        Of the situation.
    rng : numpy.random.Generator
        Of noise.
    seed : int
        With which it was drawn.
    true, given : ndarray of shape (n_ticks,)
        Durations that pass, and that the controller is given [s].
    """

    robot: str
    rate: float
    servo: Servo
    faults: Sequence[Fault]
    number: int
    rng: np.random.Generator
    seed: int = 0
    true: Array = field(init=False)
    given: Array = field(init=False)

    def __post_init__(self) -> None:
        usual = 1 / self.rate
        self.true = np.full(int((self.situation.skill.end + GRACE) * self.rate), usual)
        now, rng, n = np.cumsum(self.true), self.rng, len(self.true)
        unnoticed, wrong = np.zeros((2, n), dtype=bool)
        for fault in self.faults:
            inside = fault.active(now)
            if fault.kind == "stall":
                stall = np.searchsorted(now, np.arange(fault.begin, fault.end + 1e-9))
                stall = stall[stall < n]
                self.true[stall] += max(0.1, abs(fault.size))
                unnoticed[stall] = fault.size < 0
            elif fault.kind == "jitter":
                factor = np.exp(fault.size * rng.standard_normal(n)).clip(0.2, 5)
                self.true *= np.where(inside, factor, 1.0)
            elif fault.kind == "clock":
                wrong |= inside & (rng.random(n) < fault.size)
        self.given = np.where(unnoticed, usual, self.true)
        self.given[wrong] = rng.choice([0, -usual, np.nan], wrong.sum())

    @property
    def labels(self) -> Sequence[str]:
        """Faults, what is special in its servo, robot and rate, in words."""
        servo, kinds = self.servo, sorted({fault.kind for fault in self.faults})
        special = {"underdamped": np.min(servo.damping) < 0.6, "encoders": servo.noise > 0}
        special |= {"sags": np.abs(servo.sag).max() > 0.01}
        words = [name for name, is_so in special.items() if is_so]
        return [*(kinds or ["no faults"]), *words, self.robot, f"{self.rate:g} Hz"]

    @property
    def drive(self) -> Array:
        """Durations in which references may move (n_ticks,): a loop that stood is no licence.

        At most 1.5 usual ones [s], of which each tick counts at most twice.
        """
        usual, found = 1 / self.rate, []
        for dt in np.where(self.given > 0, self.given, 0.0):
            found.append(min(dt, LONGEST * usual))
            usual += (dt > 0) * (min(dt, 2 * usual) - usual) / MEMORY
        return np.array(found)

    @property
    def situation(self) -> Scenario:
        """The situation in which it begins."""
        return situations(self.robot)[self.number]

    def __str__(self) -> str:
        most = {k: f"{np.abs(v).max():.3g}" for k, v in vars(self.servo).items()}
        servo = ", ".join(f"{name} {value}" for name, value in most.items())
        faults = "; ".join(map(str, self.faults)) or "no faults"
        return f"{self.seed}: {self.robot} at {self.rate:g} Hz; {servo}; {faults}"

    @classmethod
    def draw(
        cls, half: str, seed: int, rates: Sequence[float], robots: Sequence[str] = tuple(ROBOTS)
    ) -> Run:
        """Draw the run of a seed of one half."""
        rng = np.random.default_rng((HALVES.index(half), seed))
        robot, rate = str(rng.choice(robots)), float(rng.choice(rates))
        number = int(rng.integers(len(situations(robot))))
        situation = situations(robot)[number]
        servo = Servo.draw(rng, situation.limits[2])
        shown = situation.skill.command_gaps(np.array([situation.skill.begin]))
        if shown is not None:  # drives as in the demonstrations, or nearly so
            servo = replace(servo, sag=shown[0][0] * rng.uniform(0.7, 1.3))
        faults = [_draw(rng, situation) for _ in range(rng.choice([0, 1, 1, 1, 2, 3]))]
        # offsets and noise before what replaces readings
        faults.sort(key=lambda fault: (list(KINDS).index(fault.kind), fault.begin))
        return cls(robot, rate, servo, faults, number, rng, seed)


def _draw(rng: np.random.Generator, situation: Scenario) -> Fault:
    """Draw any fault, some time in the skill."""
    kind, n = str(rng.choice(list(KINDS))), len(situation.joints)
    least, most, longest, share = KINDS[kind]
    begin = rng.uniform(0.2, situation.skill.end)
    lasting = rng.uniform(0.05, longest if longest < np.inf else 3.0)
    if longest == np.inf and rng.random() < 0.5:
        lasting = np.inf
    several = n if rng.random() < share else min(n, 1 + (kind == "swapped"))
    chosen = np.array([n - 1]) if kind == "grasp" else rng.choice(n, several, replace=False)
    joints = np.zeros(n)
    joints[chosen] = rng.choice([-1, 1], len(chosen))
    fault = Fault(kind, begin, begin + lasting, joints, rng.uniform(least, most))
    if kind == "contact" and rng.random() < 0.5:
        fault.surface = np.exp(rng.uniform(np.log(0.3), np.log(30)))
    return fault
