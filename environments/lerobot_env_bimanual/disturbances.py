"""Disturbances of an episode: stops, shoves, moved objects, failing eyes and clocks.

A condition is some disturbances at once, or none, ``"nominal"``. As text they are joined by
``+``: ``"stopped-3+live"``.
"""

from __future__ import annotations

import dataclasses
import math
import re
import zlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from tpgmm_torch.exceptions import DataError, UnknownNameError

__all__ = ["parse_condition"]

Vector = NDArray[np.float64]
Rng = np.random.Generator
#: Whether an object that is displaced so (6,) stands where the task is meant for.
Usual = Callable[[Vector], bool]
#: The condition without disturbances.
NOMINAL = "nominal"
#: No disturbance begins before [s].
FIRST = 0.5
#: So long before the grasp an object has stopped to move [s].
APPROACH = 1.5
#: For so long somebody holds a robot where it was put [s].
HELD = 0.3
POSE = 7


@dataclass(frozen=True)
class Course:
    """When what happens in an episode that nothing disturbs [s].

    Parameters
    ----------
    grasp : float
        The hands are where they hold the object.
    latest : float
        From here on there is enough of the task left to judge it.
    end : float
        The task is done.
    """

    grasp: float
    latest: float
    end: float


@dataclass(frozen=True)
class Disturbance:
    """Something that goes wrong; this one does nothing.

    A ``moment`` that is NaN is drawn for each episode. Times count from its beginning.
    """

    #: Whether the present poses of the objects are observed, not those of the beginning.
    live: ClassVar[bool] = False
    #: Whether an episode becomes longer by the ``seconds`` that it takes.
    delays: ClassVar[bool] = False

    @property
    def delay(self) -> float:
        """By how much an episode becomes longer for it [s]."""
        return vars(self)["seconds"] if self.delays else 0.0

    def window(self, course: Course) -> tuple[float, float] | None:
        """Between which times its ``moment`` is drawn [s]; None without a moment."""
        return None

    def draw(self, rng: Rng, course: Course, usual: Usual) -> Self:
        """Draw everything that is random about the disturbance."""
        window = self.window(course)
        if window is None:
            return self
        first, last = window
        moment, given = rng.uniform(first, max(first, last)), vars(self)["moment"]
        return dataclasses.replace(self, **{"moment": moment if math.isnan(given) else given})

    def stops(self, time: float) -> bool:
        """Check whether the robot is stopped."""
        return False

    def period(self, rng: Rng) -> float:
        """Return the time to the next tick, in multiples of what it should be."""
        return 1.0

    def observe(self, poses: Vector, last: Vector, time: float, rng: Rng) -> Vector:
        """Observe the poses of the objects.

        Parameters
        ----------
        poses, last : ndarray of shape (7 * n_objects,)
            What there is to observe, and what was observed before.
        """
        return poses

    def displacement(self, time: float) -> Vector | None:
        """Return how far somebody has moved the first object, shape (6,): [m], then [rad].

        None where nobody touches it.
        """
        return None

    def shove(self, begin: float, end: float) -> float:
        """Return the seconds of the task by which the robot is displaced between two times."""
        return 0.0

    def start(self) -> float:
        """Return the instant of the task at which the episode begins [s]."""
        return 0.0

    def sag(self, n_joints: int) -> Vector:
        """By how much each joint stands off its reference (n_joints,) [rad]."""
        return np.zeros(n_joints)


@dataclass(frozen=True)
class Stopped(Disturbance):
    """The drives stop, and hold the joints where they are: a protective stop.

    Actions are not listened to and the hands do not close until the robot goes on, from the
    reference at which it was stopped. The policy is called at each tick as usual; what it can
    notice is in ``observation.state``. The rhythm is judged in the time without the stop.

    Parameters
    ----------
    seconds : float, default=3.0
    moment : float, default=NaN
    """

    delays: ClassVar[bool] = True
    seconds: float = 3.0
    moment: float = math.nan

    def window(self, course: Course) -> tuple[float, float]:
        """At any moment, all equally likely, until the task is done."""
        return FIRST, course.end

    def stops(self, time: float) -> bool:
        """For ``seconds`` from ``moment`` on."""
        return self.moment <= time < self.moment + self.seconds


@dataclass(frozen=True)
class Displaced(Disturbance):
    """The robot is put to where it was, or will be, held there for a moment, and left at rest.

    Back is the state of the world in this very episode: whatever was grasped since then is as
    it was, and the table as high. Ahead is the posture on the generator's path for this start
    posture and this object, counted from the posture of that path that is nearest to the
    present one; an object that is held there is held in the hands as they hold it there, or as
    it is held already. What is skipped is given: success is that of what remains.

    Parameters
    ----------
    seconds : float, default=-2.0
        Negative for back.
    moment : float, default=NaN
    """

    seconds: float = -2.0
    moment: float = math.nan

    @property
    def delay(self) -> float:
        """Motion that has to be repeated, and time that passes while the robot is held."""
        return HELD + max(0.0, -self.seconds)

    def stops(self, time: float) -> bool:
        """While somebody holds the robot where it was put."""
        return self.moment <= time < self.moment + HELD

    def window(self, course: Course) -> tuple[float, float]:
        """While there is such a past, or enough future to judge."""
        if self.seconds < 0:
            return FIRST - self.seconds, course.end
        return FIRST, course.latest - self.seconds

    def shove(self, begin: float, end: float) -> float:
        """``seconds``, at ``moment``."""
        return self.seconds if begin < self.moment <= end else 0.0


@dataclass(frozen=True)
class StartedMidway(Disturbance):
    """The episode begins in the middle of the task, at rest on the generator's path.

    An object that is held there is held in the hands as they hold it there. Without ``live``
    poses it is observed where it stood before. What is skipped is given.

    Parameters
    ----------
    moment : float, default=NaN
        Of the nominal task.
    """

    moment: float = math.nan

    def window(self, course: Course) -> tuple[float, float]:
        """Between a second after the beginning and the last moment that leaves enough."""
        return 2 * FIRST, course.latest

    def start(self) -> float:
        """``moment``."""
        return self.moment


@dataclass(frozen=True)
class Moved(Disturbance):
    """Somebody moves the object while the robot is on its way to it.

    Parameters
    ----------
    distance : float, default=0.04
        On the table, in a random direction [m].
    angle : float, default=20 degrees
        About the vertical, to either side [rad]. Of the directions and sides those are taken
        that leave the object where the task is meant for; if none does, both are
        shortened by tenths until some do.
    seconds : float, default=0
        How long it takes; 0 is a jump.
    moment : float, default=NaN
        When it begins. It is over 1.5 s before the nominal grasp.
    step : ndarray of shape (6,), optional
        The displacement: [m], then [rad].
    """

    live: ClassVar[bool] = True
    distance: float = 0.04
    angle: float = math.radians(20)
    seconds: float = 0.0
    moment: float = math.nan
    step: Vector | None = dataclasses.field(default=None, compare=False)

    def window(self, course: Course) -> tuple[float, float]:
        """On the way to the object."""
        return FIRST, course.grasp - APPROACH - self.seconds

    def draw(self, rng: Rng, course: Course, usual: Usual) -> Self:
        """On the way to the object, and within its usual places if it is in one of them."""
        drawn = super().draw(rng, course, usual)
        anywhere = not usual(np.zeros(6))
        # where its usual places are narrower than the step, none of whole length may be left
        for share in np.repeat(np.linspace(1, 0.1, 10), 1000):
            way = rng.uniform(-math.pi, math.pi)
            turn = self.angle * rng.choice((-1, 1))
            level = self.distance * np.array((math.cos(way), math.sin(way), 0.0))
            step = share * np.concatenate((level, (0.0, 0.0, turn)))
            if anywhere or usual(step):
                break
        return drawn if self.step is not None else dataclasses.replace(drawn, step=step)

    def displacement(self, time: float) -> Vector | None:
        """Evenly, from ``moment`` on for ``seconds``."""
        if self.step is None:
            return None
        passed = time - self.moment
        if not 0 <= passed <= self.seconds + 0.1:  # it lets go a little later
            return None
        return self.step * (min(passed / self.seconds, 1.0) if self.seconds else 1.0)


@dataclass(frozen=True)
class NoisyPose(Disturbance):
    """The objects' poses are observed with an error of their own at each tick.

    Parameters
    ----------
    distance, angle : float
        Standard deviations, along and about each axis [m, rad].
    """

    live: ClassVar[bool] = True
    distance: float = 0.005
    angle: float = math.radians(2)

    def observe(self, poses: Vector, last: Vector, time: float, rng: Rng) -> Vector:
        """With independent normal errors."""
        noisy = poses.copy()
        spread = np.repeat((self.distance, self.angle), 3)
        for pose in noisy.reshape(-1, POSE):
            pose[:] = displace_pose(pose, spread * rng.standard_normal(6))
        return noisy


@dataclass(frozen=True)
class _Lasting(Disturbance):
    """Something that stays as it is for an episode.

    Parameters
    ----------
    seed : int, default=0
        Of what is random about it.
    """

    seed: int = 0

    def draw(self, rng: Rng, course: Course, usual: Usual) -> Self:
        """With a seed of the episode."""
        return dataclasses.replace(self, seed=int(rng.integers(2**32)))


@dataclass(frozen=True)
class Biased(_Lasting):
    """Each object's pose is observed with an error of its own that stays: a wrong calibration.

    Parameters
    ----------
    distance, angle : float
        Along and about random axes [m, rad].
    """

    distance: float = 0.005
    angle: float = math.radians(2)

    def observe(self, poses: Vector, last: Vector, time: float, rng: Rng) -> Vector:
        """With the errors of the episode."""
        biased, own = poses.copy(), np.random.default_rng(self.seed)
        for pose in biased.reshape(-1, POSE):
            axes = own.standard_normal((2, 3))
            axes /= np.linalg.norm(axes, axis=1, keepdims=True)
            error = (self.distance * axes[0], self.angle * axes[1])
            pose[:] = displace_pose(pose, np.concatenate(error))
        return biased


@dataclass(frozen=True)
class Misplaced(_Lasting):
    """Each object is not where it is observed: a table that was measured badly.

    Parameters
    ----------
    height : float, default=0
        How much higher it is, along its own z axis [m].
    angle : float, default=0
        How far it is tilted, about an axis in its own plane that is drawn [rad].
    """

    height: float = 0.0
    angle: float = 0.0

    def observe(self, poses: Vector, last: Vector, time: float, rng: Rng) -> Vector:
        """Observe it above or below its place, or tilted."""
        thought, way = poses.copy(), np.random.default_rng(self.seed).uniform(0, 2 * math.pi)
        tilt = self.angle * np.array((math.cos(way), math.sin(way), 0.0))
        for pose in thought.reshape(-1, POSE):
            w, x, y, z = pose[3:]
            upwards = np.array(
                (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
            )
            pose[:] = displace_pose(pose, np.concatenate((-self.height * upwards, tilt)))
        return thought


@dataclass(frozen=True)
class Sagging(_Lasting):
    """Each joint stands off its reference, to a side that is drawn: drives under load.

    Parameters
    ----------
    angle : float
        How far off [rad].
    """

    angle: float = math.radians(2)

    def sag(self, n_joints: int) -> Vector:
        """To the sides of the episode."""
        return self.angle * np.random.default_rng(self.seed).choice((-1.0, 1.0), n_joints)


@dataclass(frozen=True)
class PoseLost(Disturbance):
    """The objects are not seen for a while, before the grasp.

    Parameters
    ----------
    seconds : float, default=0.5
    stale : bool, default=False
        Whether the last poses are repeated. By default all their entries are NaN, which says
        "not known" and lies outside the observation space on purpose.
    moment : float, default=NaN
    """

    live: ClassVar[bool] = True
    delays: ClassVar[bool] = True
    seconds: float = 0.5
    stale: bool = False
    moment: float = math.nan

    def window(self, course: Course) -> tuple[float, float]:
        """At any moment before the grasp, after which the poses would matter less."""
        return FIRST, course.grasp

    def observe(self, poses: Vector, last: Vector, time: float, rng: Rng) -> Vector:
        """NaN, or what was seen last."""
        if not self.moment <= time < self.moment + self.seconds:
            return poses
        return last.copy() if self.stale else np.full_like(poses, math.nan)


@dataclass(frozen=True)
class IrregularTicks(Disturbance):
    """The control runs on a computer with other things to do.

    The drives get a reference and interpolate towards it for the usual period; if the next
    tick comes early they have not arrived, if it comes late they wait. The policy can see how
    much time has passed in ``observation.timestamp``.

    Parameters
    ----------
    jitter : float, default=0.5
        Periods differ by up to this share, evenly.
    lost : float, default=0.1
        Probability that a tick is left out, so that the next comes a whole period later.
    """

    jitter: float = 0.5
    lost: float = 0.1

    def period(self, rng: Rng) -> float:
        """Between half of it and three halves, or one more."""
        return float(1 + self.jitter * rng.uniform(-1, 1) + (rng.random() < self.lost))


@dataclass(frozen=True)
class Live(Disturbance):
    """The present poses are observed at all ticks, of an object that the robot holds, too."""

    live: ClassVar[bool] = True


@dataclass(frozen=True)
class Spoilt(Disturbance):
    """The first grasp of the first object fails: it slips out of the hand when it is lifted.

    Parameters
    ----------
    distance : float, default=0
        Above 0 the hand pushes it aside by this as it closes, and does not take it [m].
    seconds : float, default=15.0
        How much longer an episode is for it.
    step : ndarray of shape (6,), optional
        The displacement: [m], then [rad].
    """

    live: ClassVar[bool] = True
    delays: ClassVar[bool] = True
    distance: float = 0.0
    seconds: float = 15.0
    step: Vector | None = dataclasses.field(default=None, compare=False)

    def draw(self, rng: Rng, course: Course, usual: Usual) -> Self:
        """With the displacement of the episode, as of :class:`Moved`."""
        if not self.distance:
            return self
        moved = Moved(self.distance, 0.0, step=self.step).draw(rng, course, usual)
        return dataclasses.replace(self, step=moved.step)


_KINDS: Mapping[str, Disturbance] = MappingProxyType(
    {
        "stopped": Stopped(),
        "pushed-back": Displaced(-2.0),
        "pushed-ahead": Displaced(2.0),
        "started-midway": StartedMidway(),
        "moved": Moved(),
        "moved-slowly": Moved(seconds=1.0),
        "live": Live(),
        "pose-noise": NoisyPose(),
        "biased": Biased(),
        "sagging": Sagging(),
        "pose-lost": PoseLost(),
        "pose-stale": PoseLost(stale=True),
        "irregular-ticks": IrregularTicks(),
        "lower": Misplaced(height=-0.005),
        "higher": Misplaced(height=0.005),
        "tilted": Misplaced(angle=math.radians(3)),
        "slips": Spoilt(),
        "knocked": Spoilt(distance=0.04),
    }
)
#: Those of one task.
OF_ONE_TASK = ("lower", "higher", "tilted", "slips", "knocked")
_NUMBER = r"(\d+(?:\.\d+)?)"
#: Those that a comparison runs through. At 3 s a stop keeps the hands from the grasp.
CONDITIONS = (
    *(NOMINAL, "stopped-1", "stopped-2", "stopped-3", "stopped-5", "stopped-10", "stopped-3@3"),
    *(name for name in _KINDS if name not in ("stopped", *OF_ONE_TASK)),
)


def parse_condition(condition: str | Sequence[Disturbance]) -> tuple[Disturbance, ...]:
    """Parse the disturbances that a text names, always in the same order.

    Parameters
    ----------
    condition : str or sequence of Disturbance
        ``"nominal"``, or names joined by ``+``: ``stopped``, ``pushed-back``,
        ``pushed-ahead``, ``started-midway``, ``moved``, ``moved-slowly``, ``live``,
        ``pose-noise``, ``biased``, ``sagging``, ``pose-lost``, ``pose-stale``,
        ``irregular-ticks``, ``lower``, ``higher``, ``tilted``, ``slips``, ``knocked``. A number
        behind a name says how many seconds, ``stopped-3``, and one behind ``@`` when it
        happens, if that is not to be drawn: ``pushed-back-1.5@6``.

    Raises
    ------
    UnknownNameError
        If a name does not exist.
    DataError
        If a number stands behind a name that takes none, or a kind is named twice.

    Examples
    --------
    >>> parse_condition("live+stopped-5")
    (Stopped(seconds=5.0, moment=nan), Live())
    """
    if not isinstance(condition, str):
        return tuple(condition)
    found: dict[str, Disturbance] = {}
    for text in () if condition == NOMINAL else condition.split("+"):
        kind, numbers = _split(text)
        if kind in found:
            raise DataError(f"{condition!r} names {kind} twice")
        found[kind] = _with(kind, numbers)
    return tuple(found[kind] for kind in _KINDS if kind in found)


def _split(text: str) -> tuple[str, dict[str, float]]:
    """Split the text of one disturbance into its kind and the numbers behind it."""
    match = re.fullmatch(rf"([a-z]+(?:-[a-z]+)*)(?:-{_NUMBER})?(?:@{_NUMBER})?", text)
    kind, *numbers = match.groups() if match else (text,)
    if kind not in _KINDS:
        where = "the conditions of the environment"
        raise UnknownNameError("disturbance", text, where, (NOMINAL, *_KINDS))
    given = zip(("seconds", "moment"), numbers, strict=True)
    return kind, {name: float(number) for name, number in given if number}


def _with(kind: str, numbers: Mapping[str, float]) -> Disturbance:
    usual = _KINDS[kind]
    for name, number in numbers.items():
        if name not in vars(usual):
            raise DataError(f"{kind} takes no {name}, got {number:g}")
        if not number > 0:
            raise DataError(f"the {name} of {kind} is above 0, got {number:g}")
    signed = {name: math.copysign(size, vars(usual)[name]) for name, size in numbers.items()}
    return dataclasses.replace(usual, **signed)


def generators(disturbances: Sequence[Disturbance], rng: Rng) -> list[Rng]:
    """Random numbers for each disturbance, the same whatever else disturbs the episode.

    Parameters
    ----------
    rng : Generator
        Of the episode; what it draws later stays as it is.
    """
    [own] = rng.spawn(1)
    key = int(own.integers(2**32))
    names = [type(disturbance).__name__ for disturbance in disturbances]
    return [np.random.default_rng((key, zlib.crc32(name.encode()))) for name in names]


def displace_pose(pose: Vector, error: Vector) -> Vector:
    """Displace a pose (7,) by ``error`` (6,).

    The error is a displacement [m] and, about the axes of the pose, a rotation vector [rad].
    """
    angle = math.sqrt(error[3:] @ error[3:])
    w, v = math.cos(angle / 2), error[3:] * (math.sin(angle / 2) / angle if angle else 0.5)
    a, b = pose[3], pose[4:]
    turned = np.array((a * w - b @ v, *(a * v + w * b + np.cross(b, v))))
    return np.concatenate((pose[:3] + error[:3], turned / math.sqrt(turned @ turned)))
