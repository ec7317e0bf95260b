"""Servos of several robots at once: lag, dead time, saturation, friction, backlash, sag."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
#: Longest step of the integration [s].
LONGEST_STEP = 0.004
#: A joint that is slower stands [rad/s or m/s].
STANDING = 1e-3


@dataclass(frozen=True)
class Servo:
    """The drives of a robot; each value of all joints, or of each.

    Parameters
    ----------
    lag : float or ndarray
        How late a joint is at constant speed [s].
    damping : float or ndarray
        Damping ratio.
    delay : float
        Until a reference has an effect [s].
    speed : float or ndarray
        The greatest [rad/s].
    stiction : float or ndarray
        Gap at which a standing joint begins to move [rad].
    backlash : float or ndarray
        Play between the motor and the joint [rad].
    sag : float or ndarray
        How far a joint stays below its reference [rad].
    resolution, noise : float
        Of the readings; the latter is a standard deviation [rad].
    """

    lag: float | Array = 0.08
    damping: float | Array = 1.0
    delay: float = 0.0
    speed: float | Array = 6.0
    stiction: float | Array = 0.0
    backlash: float | Array = 0.0
    sag: float | Array = 0.0
    resolution: float = 1e-9
    noise: float = 0.0

    @classmethod
    def draw(cls, rng: np.random.Generator, fastest: Array) -> Self:
        """Draw any servo, for joints with these limits of speed."""
        n = len(fastest)

        def some(share: float, most: float) -> Array:
            """Draw zero, but for a share of the robots up to a bound in each joint."""
            return (rng.random() < share) * rng.uniform(0, most) * rng.uniform(0, 1, n)

        usual = np.exp(rng.uniform(np.log(0.02), np.log(0.4)))
        lag = np.clip(usual * np.exp(0.2 * rng.standard_normal(n)), 0.02, 0.4)
        damping = rng.uniform(0.3, 1.3)
        return cls(
            lag=lag * min(1.0, damping),  # what swings is no slower for it
            damping=damping,
            delay=(rng.random() < 0.5) * rng.uniform(0, 0.06),
            speed=np.minimum(fastest, 10.0) * rng.uniform(0.7, 3.0),
            stiction=some(0.3, 0.04),
            backlash=some(0.3, 0.01),
            sag=some(0.4, 0.1) * rng.choice([-1, 1], n),
            resolution=rng.choice([1e-9, 2 * np.pi / 4096]),
            noise=(rng.random() < 0.3) * np.exp(rng.uniform(np.log(5e-4), np.log(0.015))),
        )


class Servos:
    """Robots that follow references; beside each, its shadow, which nothing disturbs.

    Parameters
    ----------
    servos : sequence of Servo
        Of each robot.
    joints : ndarray of shape (n_robots, n_joints)
        Where they begin, which is the first reference.
    limits : tuple of two ndarray of shape (n_joints,)
        Where they are stopped mechanically.
    most : int
        How many references are sent at most.

    Attributes
    ----------
    joints : ndarray of shape (2, n_robots, n_joints)
        Of the robots and of their shadows [rad].
    """

    def __init__(
        self, servos: Sequence[Servo], joints: Array, limits: tuple[Array, ...], most: int
    ) -> None:
        names = ("lag", "damping", "speed", "stiction", "backlash", "sag")
        values = [[getattr(s, n) + np.zeros(len(joints[0])) for s in servos] for n in names]
        lag, damping, self._fastest, self._friction, backlash, self._sag = map(np.array, values)
        self._stiffness, self._play = (2 * damping / lag) ** 2, backlash / 2
        self._damping = 4 * damping**2 / lag
        self._delay, self._limits = np.array([servo.delay for servo in servos]), limits
        self.joints = np.stack((joints - self._sag,) * 2).clip(*limits)
        self._motor, self._speed = self.joints.copy(), np.zeros_like(self.joints)
        self._robots = np.arange(len(joints))
        self._now: Array = np.zeros(len(joints))
        self._sent = np.full((most + 2, len(joints)), np.inf)  # times of references
        self._references, self._last = np.zeros((most + 2, *joints.shape)), 0
        self._references[0], self._effective = joints, self._robots * 0

    def send(self, references: Array) -> None:
        """Send new references."""
        self._last += 1
        self._sent[self._last], self._references[self._last] = self._now, references

    def place(self, robot: int, joints: Array, moved: NDArray[np.bool_]) -> None:
        """Put some joints (n_joints,) of a robot somewhere else; its shadow stays."""
        self._motor[0, robot, moved] = self.joints[0, robot, moved] = joints[moved]
        self._speed[0, robot, moved] = 0

    def advance(
        self,
        dt: Array,
        held: NDArray[np.bool_],
        load: Array,
        walls: Array,
        surface: Array | float = np.inf,
        rubs: Array | float = 0.0,
    ) -> None:
        """Let some time pass for each robot.

        Parameters
        ----------
        dt : ndarray of shape (n_robots,)
            How much [s].
        held : ndarray of bool of shape (n_robots, n_joints)
            Joints that somebody holds.
        load : ndarray of shape (n_robots, n_joints)
            What is added to the sag.
        walls : ndarray of shape (2, n_robots, n_joints)
            Between which the joints stay.
        surface : float or ndarray of shape (n_robots, n_joints)
            Stiffness of the walls, in units of the drives'.
        rubs : float or ndarray of shape (n_robots, n_joints)
            What is added to the friction, of joints that stand and of those that move [rad].
        """
        soft = np.where(np.isfinite(surface), surface, 0.0) + np.zeros_like(load)
        yielding, walls = walls, np.where(soft > 0, np.array([[[-np.inf]], [[np.inf]]]), walls)
        soft, friction = (
            np.stack((soft, 0 * soft)),
            np.stack((self._friction + rubs, self._friction)),
        )
        lower, upper = (limit + np.zeros_like(load) for limit in self._limits)
        # a wall pushes nobody away
        low = np.minimum(np.stack((np.maximum(walls[0], lower), lower)), self._motor)
        high = np.maximum(np.stack((np.minimum(walls[1], upper), upper)), self._motor)
        free = ~np.stack((held, np.zeros_like(held)))
        steps = max(1, int(np.ceil(dt.max() / LONGEST_STEP)))
        h = (dt / steps)[:, None]
        for _ in range(steps):
            self._now = self._now + h[:, 0]
            gap = self._effective_references() - self._sag - load - self._motor
            gap -= soft * (self._motor - self._motor.clip(*yielding))
            self._speed = free * self._accelerate(gap, h, friction, soft)
            moved = self._motor + h * self._speed
            self._motor = moved.clip(low, high)
            self._speed = self._speed * (moved == self._motor)
            self.joints = self.joints.clip(self._motor - self._play, self._motor + self._play)

    def _effective_references(self) -> Array:
        """Return the last references that were sent the delay ago."""
        latest = self._now - self._delay + 1e-9
        while (due := self._sent[self._effective + 1, self._robots] <= latest).any():
            self._effective = self._effective + due
        return self._references[self._effective, self._robots]

    def _accelerate(self, gap: Array, h: Array, friction: Array, soft: Array) -> Array:
        """Compute speeds after a step, implicitly, so that no step is too long."""
        speed = self._speed
        stands = np.abs(speed) <= STANDING
        way = np.sign(np.where(stands, gap, speed))
        force = self._stiffness * (gap - friction * way)
        stiffness = self._stiffness * (1 + soft)
        new = (speed + h * force) / (1 + h * self._damping + h * h * stiffness)
        stuck = (stands & (np.abs(gap) <= friction)) | (new * way < 0)
        return np.where(stuck & (friction > 0), 0.0, new).clip(-self._fastest, self._fastest)
