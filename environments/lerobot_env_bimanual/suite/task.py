"""A task of the suite, and demonstrations as people would give them.

A scripted expert knows where everything is, and moves both hands along ways that it fixes
beforehand. Nobody does it twice in the same manner: durations, ways through free space, the
places where hands wait, the posture in the null space all differ, within the bounds below.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar, NamedTuple

import mujoco
import numpy as np
import torch
from torch import Tensor

from lerobot_env_bimanual.base import Array
from lerobot_env_bimanual.bottle.measures import Figure
from lerobot_env_bimanual.eyes.carriers import Carrier
from lerobot_env_bimanual.robot_scene import Hold, RobotScene
from lerobot_env_bimanual.suite.names import UPPER_BODY, tasks_of
from lerobot_env_bimanual.suite.robots.embodiments import Embodiment
from tpgmm_datasets.bottle.phases import Phases
from tpgmm_datasets.bottle.skill import HANDS, between, follow_hands, place_hand
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Robot,
    Stack,
)
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.operators import Operator

__all__ = ["Judge", "SuiteTask"]

Pose = Array
#: Durations differ by up to this share.
STRETCH = 0.2
#: Start postures differ by up to this in each joint, and the posture that the null space seeks
#: [rad].
START, POSTURE = 0.05, 0.08
#: Standard deviations of how far ways through free space bend aside, and of where hands wait
#: [m].
BOW, AIM = 0.015, 0.008


@dataclass(frozen=True)
class Style:
    """How ``n`` demonstrations differ from what the expert would do at best.

    Parameters
    ----------
    posture : Tensor of shape (n, n_joints)
        Added to the posture that the null space seeks [rad].
    bow : Tensor of shape (n, 2, 3)
        By how much the ways of both hands bend aside [m].
    aim : Tensor of shape (n, 2, 3)
        By how much places are missed where nothing depends on it [m].
    free : Tensor of shape (n, 3)
        Whatever else a task leaves free, between -1 and 1.
    """

    posture: Tensor
    bow: Tensor
    aim: Tensor
    free: Tensor

    @classmethod
    def draw(cls, n: int, joints: int, rng: np.random.Generator) -> Style:
        """Draw the styles of ``n`` people."""
        return cls(
            torch.from_numpy(rng.uniform(-POSTURE, POSTURE, (n, joints))),
            torch.from_numpy(BOW * rng.standard_normal((n, 2, 3))),
            torch.from_numpy(AIM * rng.standard_normal((n, 2, 3))),
            torch.from_numpy(rng.uniform(-1, 1, (n, 3))),
        )

    def __getitem__(self, chosen: Sequence[int]) -> Style:
        """Choose the styles of some people."""
        rows = list(chosen)
        return Style(self.posture[rows], self.bow[rows], self.aim[rows], self.free[rows])

    @classmethod
    def none(cls, n: int, joints: int) -> Style:
        """Motion of the expert without noise."""
        aside, free = (n, 2, 3), (n, 3)
        shapes = ((n, joints), aside, aside, free)
        return cls(*(torch.zeros(shape, dtype=torch.float64) for shape in shapes))


@dataclass(frozen=True)
class Leg:
    """A part of a hand's way.

    Parameters
    ----------
    phase : str
        During which the hand goes there.
    target : Frame or callable
        Poses (n,) where it arrives; or the way, a function of the share (..., n) that is done
        of the phase, which begins where the leg before it ended.
    free : bool, default=False
        Whether it leads through free space, where ways bend aside.
    """

    phase: str
    target: Frame | Callable[[Tensor], Frame]
    free: bool = False


#: Poses by names, and the ways of both hands.
Frames = Mapping[str, Frame]
Legs = Mapping[str, Sequence[Leg]]


class Judge(ABC):
    """Follows an episode, opens hands, and says in the end how well it was done.

    It is copied when an episode is set back: it keeps plain values only.
    """

    @abstractmethod
    def note(self, scene: RobotScene, seconds: float) -> None:
        """Look at the world after a tick in which the robot was not stopped.

        Parameters
        ----------
        seconds : float
            How long it took.
        """

    def lets_go(self, scene: RobotScene) -> Sequence[Hold]:
        """Choose the hands that open now."""
        return ()

    @abstractmethod
    def figures(self, scene: RobotScene) -> dict[str, float]:
        """Measure how well it goes, so far."""


class SuiteTask(ABC):
    """A task of the suite: its objects, its expert, its judge.

    Parameters
    ----------
    embodiment : Embodiment
        The robot that does it.
    """

    #: The name, ``--env.task`` of LeRobot, and what data sets call it.
    name: ClassVar[str]
    description: ClassVar[str]
    #: How high the first object's origin is above the table [m].
    foot: ClassVar[float]
    #: Nominal seconds of each phase.
    phases: ClassVar[Mapping[str, float]]
    #: The phase at whose end the first object is first touched, and the last one in which a
    #: stop still matters.
    grasp: ClassVar[str]
    #: Which hand may take hold of what.
    holds: ClassVar[tuple[Hold, ...]]
    #: Which tags the objects carry, where they are in no hand's way.
    carriers: ClassVar[Mapping[str, Carrier]]
    #: What a judge finds, and what a success needs of it.
    figures: ClassVar[Mapping[str, Figure]]
    #: Where the first object may be.
    box: ClassVar[Box]
    #: Where palms touch what they take, and where they wait, in its frame [m].
    grip: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    wait: ClassVar[Mapping[str, tuple[float, ...]]] = {}
    #: What is seen from what; and of two things that come together, one from the other, and
    #: which hand from the other one where held things are left out.
    pairs: ClassVar[Sequence[tuple[str, str]]] = ()
    together: ClassVar[tuple[tuple[str, str], tuple[str, str]] | None] = None

    def __init__(self, embodiment: Embodiment) -> None:
        self.embodiment = embodiment

    @property
    def objects(self) -> tuple[str, ...]:
        """Name what is observed, in this order; the first one can be moved by others."""
        return tasks_of(UPPER_BODY)[self.name]

    @property
    def robot(self) -> Robot:
        """The embodiment's kinematics."""
        return self.embodiment.robot

    @abstractmethod
    def furnish(self, spec: mujoco.MjSpec) -> None:
        """Add the objects' bodies, by their names, and the geoms that can be held."""

    @abstractmethod
    def draw(self, rng: np.random.Generator) -> dict[str, Pose]:
        """Draw the objects' poses, shape (7,) each; always as many random numbers."""

    def usual(self, pose: Pose) -> bool:
        """Check whether the task is meant for a first object there, at that height."""
        return self.box.contains(pose)

    @abstractmethod
    def legs(self, starts: Frames, poses: Frames, style: Style) -> Legs:
        """Lay out the ways of both hands.

        Parameters
        ----------
        starts : mapping of str to Frame
            Where the hands are at first, (n,).
        poses : mapping of str to Frame
            Where the objects are, (n,).
        style : Style
        """

    @abstractmethod
    def judge(self) -> Judge:
        """Make the judge of one episode."""

    def operators(self, orientation: bool = True, held: bool = True) -> list[Operator]:
        """List the subspaces in which TP-GMM learns the task.

        Parameters
        ----------
        orientation : bool
            False leaves the orientation of the hands out.
        held : bool, default=True
            False leaves out what is carried as a thing of its own.
        """
        found = [seen(*pair, orientation) for pair in self.pairs]
        if self.together is not None:
            things, hands = self.together
            found.append(seen(*(things if held else hands), orientation, held))
        return [*found, Canonical()]

    @cached_property
    def duration(self) -> float:
        """Length of an episode: that of the slowest demonstration, and a second [s]."""
        return math.ceil(sum(self.phases.values()) * (1 + STRETCH)) + 1.0

    def ends(self) -> dict[str, float]:
        """When each phase ends nominally [s]."""
        done = np.cumsum(list(self.phases.values()))
        return dict(zip(self.phases, done.tolist(), strict=True))

    def at_grip(self, pose: Frame, hand: str) -> Frame:
        """Return the pose of a hand that touches a thing with a pose."""
        return place_hand(pose, self.grip[hand])

    def near(self, pose: Frame, hand: str, style: Style) -> Frame:
        """Return the pose of a hand that waits beside a thing with a pose."""
        return shift_pose(place_hand(pose, self.wait[hand]), style.aim[:, HANDS.index(hand)])

    def start_posture(self, rng: np.random.Generator) -> Array:
        """Around the neutral one, shape (n_joints,) [rad]."""
        spread = rng.uniform(-START, START, self.robot.n_joints)
        posture = self.embodiment.posture.numpy() + spread
        return np.clip(posture, self.robot.lower.numpy(), self.robot.upper.numpy())

    def demonstrations(
        self, n: int, seed: int = 0, rate: float = 100.0, only: Sequence[int] | None = None
    ) -> list[Demonstration]:
        """Demonstrations with different objects, start postures, timing and style.

        Parameters
        ----------
        n : int
            How many are drawn.
        seed : int, default=0
        rate : float, default=100
            Time steps per second.
        only : sequence of int, optional
            The numbers of those that are made, since each takes a second; by default all.

        Returns
        -------
        list of Demonstration
            With the poses of the objects at the beginning, and the ends of the phases as
            events.
        """
        rng = np.random.default_rng(seed)
        drawn = [self.draw(rng) for _ in range(n)]
        starts = np.stack([self.start_posture(rng) for _ in range(n)])
        phases = Phases(self.phases, rate, STRETCH)
        ends = torch.from_numpy(phases.lengths(n, rng).cumsum(1))
        style = Style.draw(n, self.robot.n_joints, rng)
        made = list(range(n) if only is None else only)
        return self._perform(
            [drawn[i] for i in made],
            torch.from_numpy(starts[made]),
            phases,
            ends[made],
            style[made],
        )

    def nominal(
        self, poses: Mapping[str, Pose], joints: Array, rate: float = 100.0
    ) -> Demonstration:
        """Motion of the expert without noise.

        Parameters
        ----------
        poses : mapping of str to ndarray of shape (7,)
        joints : ndarray of shape (n_joints,)
            [rad]
        rate : float, default=100
        """
        phases = Phases(self.phases, rate, 0.0)
        style = Style.none(1, self.robot.n_joints)
        starts = torch.from_numpy(joints[None])
        [best] = self._perform([dict(poses)], starts, phases, phases.nominal_ends(1), style)
        return best

    def _perform(
        self,
        drawn: Sequence[Mapping[str, Pose]],
        starts: Tensor,
        phases: Phases,
        ends: Tensor,
        style: Style,
    ) -> list[Demonstration]:
        robot = self.robot
        poses = {
            name: Frame(*np.split(np.stack([one[name] for one in drawn]), [3], axis=1))
            for name in self.objects
        }
        first = robot.state(starts)
        hands = {hand: Frame(first.position(hand), first.orientation(hand)) for hand in HANDS}
        legs = self.legs(hands, poses, style)
        lengths = phases.steps(ends)
        times = phases.times(max(lengths))

        wanted = hands_along(hands, legs, phases.progress(times[:, None], ends), style.bow)
        posture = self.embodiment.posture + style.posture
        joints = follow_hands(robot, starts, wanted, 1 / phases.rate, posture)
        return [
            Demonstration(
                times[:steps],
                joints[:steps, i],
                {name: pose[i] for name, pose in poses.items()},
                robot.joint_names,
                dict(
                    zip(self.phases, ends[i].clamp(max=times[steps - 1]).tolist(), strict=True)
                ),
            )
            for i, steps in enumerate(lengths)
        ]


def hands_along(
    starts: Frames,
    legs: Legs,
    progress: Mapping[str, Tensor],
    bow: Tensor,
) -> list[Frame]:
    """Compute where both hands should be, when a share of each phase is done: (..., n).

    Parameters
    ----------
    starts : mapping of str to Frame
        (n,)
    progress : mapping of str to Tensor
        (..., n)
    bow : Tensor of shape (n, 2, 3)
    """
    poses, batch = [], next(iter(progress.values())).shape
    for hand, aside in zip(HANDS, bow.unbind(1), strict=True):
        pose = starts[hand].expand(batch)
        for leg in legs[hand]:
            done = progress[leg.phase]
            if isinstance(leg.target, Frame):
                pose = between(pose, leg.target, done)
            else:
                begun, way = (done > 0)[..., None], leg.target(done)
                pose = Frame(
                    torch.where(begun, way.position, pose.position),
                    torch.where(begun, way.orientation, pose.orientation),
                )
            if leg.free:
                # nothing at both ends, without a speed there
                bump = torch.sin(math.pi * minimum_jerk(done)).square()
                pose = shift_pose(pose, bump[..., None] * aside)
        poses.append(pose)
    return poses


def shift_pose(pose: Frame, offset: Tensor) -> Frame:
    """Shift a pose by an offset (3,) [m]."""
    return Frame(pose.position + offset, pose.orientation)


def raise_pose(pose: Frame, height: float) -> Frame:
    """Lifted straight up [m], as what stands on the table is before it is carried away."""
    return shift_pose(pose, vector((0.0, 0.0, height)))


def vector(values: Sequence[float]) -> Tensor:
    """Make a tensor of double precision."""
    return torch.tensor(values, dtype=torch.float64)


def seen(what: str, frame: str, orientation: bool, held: bool = False) -> Stack:
    """Make the operator of a link, or what is ``held``, in a frame, turned or not."""
    kinds = (RelativePosition, RelativeOrientation)[: 1 + orientation]
    return Stack(*(kind(what, frame, held=held) for kind in kinds))


class Box(NamedTuple):
    """Where upright things stand: between two corners [m], turned either way [deg]."""

    lowest: tuple[float, ...]
    highest: tuple[float, ...]
    yaw: float

    def draw(self, rng: np.random.Generator) -> Pose:
        """Draw a pose (7,) in it."""
        position = rng.uniform(self.lowest, self.highest)
        half = math.radians(rng.uniform(-self.yaw, self.yaw)) / 2
        return np.concatenate((position, (math.cos(half), 0.0, 0.0, math.sin(half))))

    def across(self, height: float) -> Box:
        """Mirror the box to the other side of the table, at a height [m]."""
        (x, y, _), (far, wide, _) = self.lowest, self.highest
        return Box((x, -wide, height), (far, -y, height), self.yaw)

    def contains(self, pose: Pose) -> bool:
        """Check whether :meth:`draw` may give a pose (7,), but for rounding."""
        w, x, y, z = pose[3:]
        turn = (math.degrees(2 * math.atan2(z, w)) + 180) % 360 - 180
        upright = math.hypot(x, y) < 1e-6 and abs(turn) < self.yaw + 1e-6
        return self.surrounds(pose) and upright

    def surrounds(self, pose: Pose) -> bool:
        """Check whether a pose is between the corners, however turned, but for rounding."""
        low, high = np.subtract(self.lowest, 1e-9), np.add(self.highest, 1e-9)
        return bool(np.all((low <= pose[:3]) & (pose[:3] <= high)))
