"""The paper's skill, generated: reach a bottle with both hands, grasp it, bring it, shake it.

Section IV of the paper made its demonstrations by inverse kinematics for the part in task
space and by sinusoidal references of the shoulders for the shaking. So does this module, for
the 17-joint upper body of :mod:`tpgmm_datasets.robots`: damped least squares on the Jacobian
of both hands, which share the waist, along minimum-jerk paths.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from tpgmm_datasets.bottle.phases import Phases
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Robot,
    Situation,
    Stack,
    Trajectory,
    quaternions,
)
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.operators import Operator

__all__ = ["BottleShaking", "bottle_operators", "upper_body"]

Point = Sequence[float]
#: What LeRobot data sets of the skill call it.
TASK = "shake the bottle"
HANDS = ("l_hand", "r_hand")
SHOULDERS = ("l_shoulder_pitch", "r_shoulder_pitch")
#: Where the hands hold the bottle, in its frame [m], and how they are turned there.
GRASP_POINT = {"l_hand": (0.0, 0.08, 0.0), "r_hand": (0.0, -0.08, 0.0)}
GRASP_TURN = (math.cos(-math.pi / 4), 0.0, math.sin(-math.pi / 4), 0.0)
#: Where the hands wait before they close, in the bottle's frame [m].
APPROACH_POINT = {"l_hand": (-0.05, 0.14, 0.0), "r_hand": (-0.05, -0.14, 0.0)}
#: Height of the bottle's centre above its foot [m].
FOOT = 0.11
#: Of the inverse kinematics.
DAMPING = 1e-3
#: Where the bottle is brought, upright [m].
CHEST = np.array((0.24, 0.0, 0.18))
#: Nominal seconds of each phase; 13 in all, as in the paper.
PHASES = MappingProxyType(
    dict(reach=2.5, close=1.5, hold=0.5, bring=3.0, pause=0.5, shake=4.5, rest=0.5)
)


def upper_body(**options: object) -> Robot:
    """Make the 17-joint upper body with both hands as links.

    Parameters
    ----------
    **options
        Passed to :meth:`tpgmm_torch.Robot.from_urdf`.
    """
    return Robot.from_urdf(upper_body_urdf(), links=HANDS, **options)  # type: ignore[arg-type]


@dataclass(frozen=True)
class BottleSkill:
    """Common parts of skills of two hands with a bottle.

    Parameters
    ----------
    rate : float, default=100.0
        Time steps per second.
    stretch : float, default=0.18
        Durations are spread evenly between ``1 - stretch`` and ``1 + stretch`` of the nominal
        one; each phase moreover takes up to 12 % more or less of its demonstration.
    start_spread : float, default=0.05
        Start postures differ by up to this in each joint [rad].

    Attributes
    ----------
    robot : Robot
        The 17-joint upper body.
    """

    #: Nominal seconds of each phase.
    phases: ClassVar[Mapping[str, float]]
    #: The box in which bottles stand [m], and by how much they are turned to either side [deg].
    lowest: ClassVar[tuple[float, float, float]] = (0.24, -0.05, 0.10)
    highest: ClassVar[tuple[float, float, float]] = (0.32, 0.05, 0.20)
    yaw: ClassVar[float] = 20.0

    rate: float = 100.0
    stretch: float = 0.18
    start_spread: float = 0.05
    robot: Robot = field(default_factory=upper_body, repr=False)

    def bottle_poses(self, n: int, rng: np.random.Generator) -> Frame:
        """Draw ``n`` upright bottles, anywhere in the box."""
        return upright(rng, self.lowest, self.highest, self.yaw, n)

    def start_postures(self, n: int, rng: np.random.Generator) -> Tensor:
        """Draw ``n`` start postures around the neutral one, shape (n, 17) [rad]."""
        spread = rng.uniform(-self.start_spread, self.start_spread, (n, self.robot.n_joints))
        joints = self.neutral_posture() + torch.from_numpy(spread)
        return joints.clamp(self.robot.lower, self.robot.upper)

    def usual(self, bottle: Frame) -> bool:
        """Check if a bottle stands where :meth:`bottle_poses` may put one, but for rounding."""
        low, high = map(bottle.position.new_tensor, (self.lowest, self.highest))
        inside = (low - 1e-9 <= bottle.position) & (bottle.position <= high + 1e-9)
        w, x, y, z = bottle.orientation.tolist()
        turn = math.degrees(2 * math.atan2(z, w))
        return bool(inside.all()) and math.hypot(x, y) < 1e-6 and abs(turn) < self.yaw + 1e-6

    def grasp_error(self, joints: Tensor, bottle: Frame) -> tuple[Tensor, Tensor]:
        """Measure how far hands are from where they should hold a bottle, the worse of both.

        Parameters
        ----------
        joints : Tensor of shape (..., 17)
            Postures [rad].
        bottle : Frame
            Its initial pose.

        Returns
        -------
        position : Tensor of shape (...)
            In metres.
        orientation : Tensor of shape (...)
            In radians.
        """
        state = self.robot.state(joints)
        errors = [
            pose_error(state.pose(hand), place_hand(bottle, GRASP_POINT[hand]))
            for hand in HANDS
        ]
        position, orientation = (torch.maximum(*kind) for kind in zip(*errors, strict=True))
        return position, orientation

    def neutral_posture(self) -> Tensor:
        """Return the humanoid's published home posture, elbows bent, shape (17,) [rad]."""
        joints = torch.zeros(self.robot.n_joints, dtype=torch.float64)
        home = {"shoulder_pitch": (0.5, 0.5), "shoulder_roll": (0.5, -0.5)}
        home |= {"shoulder_yaw": (-0.3, 0.3), "elbow": (-1.57, -1.57)}
        for name, sides in home.items():
            for side, value in zip("lr", sides, strict=True):
                joints[self.robot.joint_names.index(f"{side}_{name}")] = value
        return joints

    def _phase_ends(self, n: int, rng: np.random.Generator) -> Tensor:
        """Draw when each phase ends, shape (n, n_phases) [s]."""
        return torch.from_numpy(self._phase_lengths(n, rng).cumsum(1))

    def _phase_lengths(self, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return self._timing.lengths(n, rng)

    @property
    def _timing(self) -> Phases:
        return Phases(self.phases, self.rate, self.stretch)

    def _times(self, ends: Tensor) -> Tensor:
        """Return the instants until the longest demonstration ends, shape (T,) [s]."""
        return self._timing.times(max(self._timing.steps(ends)))

    def _follow(self, starts: Tensor, wanted: Sequence[Frame]) -> Tensor:
        """Compute joints (T, n, 17) of all demonstrations, by inverse kinematics."""
        return follow_hands(self.robot, starts, wanted, 1 / self.rate, self.neutral_posture())

    def _record(
        self, times: Tensor, joints: Tensor, ends: Tensor, frames: Mapping[str, Frame]
    ) -> list[Demonstration]:
        """Make demonstrations, each until its last phase ends, of frames (n,) or (T, n)."""
        found = []
        for i, steps in enumerate(self._timing.steps(ends)):
            end = dict(zip(self.phases, ends[i].tolist(), strict=True))
            poses = {
                name: pose[:steps, i] if len(pose.batch_shape) > 1 else pose[i]
                for name, pose in frames.items()
            }
            names, events = self.robot.joint_names, self._events(end)
            found.append(Demonstration(times[:steps], joints[:steps, i], poses, names, events))
        return found

    def _events(self, end: Mapping[str, float]) -> dict[str, float]:
        raise NotImplementedError


@dataclass(frozen=True)
class BottleShaking(BottleSkill):
    """Generator of demonstrations and situations of the bimanual bottle-shaking skill.

    Parameters
    ----------
    rate : float, default=100.0
        Time steps per second.
    amplitude : float, default=0.25
        Swing of the shoulders while shaking [rad]; each demonstration differs by up to 5 %.
    cycles : float, default=3.0
        Periods of the shaking, in nominally 4.5 s.
    stretch : float, default=0.18
        Durations are spread evenly between ``1 - stretch`` and ``1 + stretch`` of the nominal
        13 s; each phase moreover takes up to 12 % more or less of its demonstration.
    start_spread : float, default=0.05
        Start postures differ by up to this in each joint [rad].
    chest_spread : float, default=0.005
        Where the bottle is brought differs by up to this in each direction [m].
    steady_rhythm : bool, default=False
        Whether the shaking takes its nominal 4.5 s in every demonstration, so that all have
        one frequency: what a policy can be asked to repeat.

    Attributes
    ----------
    robot : Robot
        The 17-joint upper body.

    Examples
    --------
    >>> skill = BottleShaking()
    >>> [situation] = skill.situations(1, seed=0)
    >>> skill.robot.n_joints, list(situation.frames)
    (17, ['bottle'])
    """

    phases: ClassVar[Mapping[str, float]] = PHASES
    amplitude: float = 0.25
    cycles: float = 3.0
    chest_spread: float = 0.005
    steady_rhythm: bool = False

    def situations(self, n: int, seed: int = 0) -> list[Situation]:
        """Draw ``n`` new bottle poses and start postures."""
        rng = np.random.default_rng(seed)
        bottles, starts = self.bottle_poses(n, rng), self.start_postures(n, rng)
        return [Situation(starts[i], {"bottle": bottles[i]}) for i in range(n)]

    def demonstrations(self, n: int = 10, seed: int = 0) -> list[Demonstration]:
        """Generate demonstrations with different bottle poses, start postures and timing.

        Parameters
        ----------
        n : int, default=10
            Number of demonstrations.
        seed : int, default=0
            Seed of the random numbers: equal seeds give equal demonstrations.

        Returns
        -------
        list of Demonstration
            With the frame ``"bottle"`` (its initial pose, as in the paper) and the events
            ``"grasp"``, ``"shake"`` and ``"rest"``.
        """
        rng = np.random.default_rng(seed)
        bottles, starts = self.bottle_poses(n, rng), self.start_postures(n, rng)
        ends = self._phase_ends(n, rng)
        amplitudes = self.amplitude * torch.from_numpy(rng.uniform(0.95, 1.05, n))
        chests = Frame(CHEST + rng.uniform(-self.chest_spread, self.chest_spread, (n, 3)))
        return self._demonstrations(bottles, chests, starts, ends, amplitudes)

    def nominal(self, situations: Sequence[Situation]) -> list[Demonstration]:
        """Generate the skill in situations, without spread in timing, chest and amplitude.

        Parameters
        ----------
        situations : sequence of Situation
            With the frame ``"bottle"``.

        Returns
        -------
        list of Demonstration
            As :meth:`demonstrations` gives them, of 13 s.
        """
        n = len(situations)
        return self._demonstrations(
            Frame.stack([situation.frames["bottle"] for situation in situations]),
            Frame(CHEST).expand((n,)),
            torch.stack([situation.joints for situation in situations]),
            self._timing.nominal_ends(n),
            torch.full((n,), self.amplitude, dtype=torch.float64),
        )

    def _demonstrations(
        self, bottles: Frame, chests: Frame, starts: Tensor, ends: Tensor, amplitudes: Tensor
    ) -> list[Demonstration]:
        state = self.robot.state(starts)
        first = {hand: state.pose(hand) for hand in HANDS}

        times = self._times(ends)
        progress = self._timing.progress(times[:, None], ends)
        carried = between(bottles, chests, progress["bring"])
        # from the grasp on the bottle moves, and the hand with it
        wanted = [
            either(
                progress["bring"] > 0,
                place_hand(carried, GRASP_POINT[hand]),
                approach_bottle(first[hand], hand, bottles, progress),
            )
            for hand in HANDS
        ]
        joints, u = self._follow(starts, wanted), progress["shake"]
        ramp = minimum_jerk(8 * u) * minimum_jerk(8 * (1 - u))
        swing = amplitudes * ramp * torch.sin(2 * math.pi * self.cycles * u)
        columns = [self.robot.joint_names.index(name) for name in SHOULDERS]
        joints[..., columns] += swing[..., None]
        return self._record(times, joints, ends, {"bottle": bottles})

    def _events(self, end: Mapping[str, float]) -> dict[str, float]:
        grasp = (end["close"] + end["hold"]) / 2
        return {"grasp": grasp, "shake": end["pause"], "rest": end["shake"]}

    def shoulders(self, trajectory: Trajectory | Demonstration) -> Tensor:
        """Return both shoulder pitches of a motion, shape (T, 2) [rad]."""
        columns = [self.robot.joint_names.index(name) for name in SHOULDERS]
        return trajectory.joints[:, columns]

    def _phase_lengths(self, n: int, rng: np.random.Generator) -> NDArray[np.float64]:
        lengths = super()._phase_lengths(n, rng)
        if self.steady_rhythm:
            lengths[:, list(PHASES).index("shake")] = PHASES["shake"]
        return lengths


def approach_bottle(
    start: Frame, hand: str, bottle: Frame, progress: Mapping[str, Tensor]
) -> Frame:
    """Move a hand from its start to the grasp: beside the bottle, then to it."""
    pose = between(start, place_hand(bottle, APPROACH_POINT[hand]), progress["reach"])
    return between(pose, place_hand(bottle, GRASP_POINT[hand]), progress["close"])


def either(where: Tensor, one: Frame, other: Frame) -> Frame:
    """Return one pose where a condition (...) holds, the other elsewhere."""
    mask = where[..., None]
    return Frame(
        torch.where(mask, one.position, other.position),
        torch.where(mask, one.orientation, other.orientation),
    )


def pose_error(pose: Frame, target: Frame) -> tuple[Tensor, Tensor]:
    """Compute distance [m] and angle [rad] of poses (...) from their targets."""
    turn = quaternions.product(pose.orientation, quaternions.conjugate(target.orientation))
    distance = torch.linalg.vector_norm(pose.position - target.position, dim=-1)
    return distance, torch.linalg.vector_norm(quaternions.log(turn), dim=-1)


def upright(
    rng: np.random.Generator, lowest: Point, highest: Point, yaw: float, n: int
) -> Frame:
    """Draw ``n`` poses in a box [m], turned about the vertical by up to ``yaw`` [deg]."""
    position = rng.uniform(lowest, highest, (n, 3))
    half = np.radians(rng.uniform(-yaw, yaw, n)) / 2
    zero = np.zeros(n)
    return Frame(position, np.stack((np.cos(half), zero, zero, np.sin(half)), axis=1))


def place_hand(frame: Frame, point: Point) -> Frame:
    """Place a hand at a point of a frame, turned for the grasp."""
    turn = torch.tensor(GRASP_TURN, dtype=torch.float64).expand_as(frame.orientation)
    where = torch.tensor(point, dtype=torch.float64)
    return Frame(frame.transform(where), quaternions.product(frame.orientation, turn))


def between(a: Frame, b: Frame, progress: Tensor) -> Frame:
    """Interpolate poses on a minimum-jerk way, of which ``progress`` is done."""
    u = minimum_jerk(progress)
    position = a.position + u[..., None] * (b.position - a.position)
    start, end = torch.broadcast_tensors(a.orientation, b.orientation)
    return Frame(position, quaternions.slerp(start, end, u))


def follow_hands(
    robot: Robot, starts: Tensor, wanted: Sequence[Frame], dt: float, posture: Tensor
) -> Tensor:
    """Follow both hands' ways by inverse kinematics, in all demonstrations at once.

    Parameters
    ----------
    robot : Robot
        With both hands as links; a waist that arms share shall move less than these.
    starts : Tensor of shape (n, n_joints)
        Where the joints begin [rad].
    wanted : sequence of Frame
        Poses of both hands, ``HANDS``, at each of T instants, of shape (T, n).
    dt : float
        Between two of them [s].
    posture : Tensor of shape (n_joints,) or (n, n_joints)
        Posture that the null space seeks [rad].

    Returns
    -------
    Tensor of shape (T, n, n_joints)
    """
    weights = torch.ones(robot.n_joints, dtype=torch.float64)
    waist = [i for i, name in enumerate(robot.joint_names) if name.startswith("waist_")]
    weights[waist] = 0.3
    limit = robot.velocity * dt
    joints, out = starts, [starts]
    for i in range(1, len(wanted[0].position)):
        rest = dt * (posture - joints)
        step = _step(robot, joints, [hand[i] for hand in wanted], weights, rest)
        joints = (joints + step.clamp(-limit, limit)).clamp(robot.lower, robot.upper)
        out.append(joints)
    return torch.stack(out)


def _step(
    robot: Robot, joints: Tensor, wanted: list[Frame], weights: Tensor, rest: Tensor
) -> Tensor:
    """Compute the damped least-squares step to hand poses; the null space takes ``rest``."""
    state = robot.state(joints)
    errors, rows = [], []
    for hand, target in zip(HANDS, wanted, strict=True):
        back = quaternions.conjugate(state.orientation(hand))
        turn = quaternions.product(target.orientation, back)
        errors += [target.position - state.position(hand), quaternions.log(turn)]
        rows += [state.linear_jacobian(hand), state.angular_jacobian(hand)]
    error, jacobian = torch.cat(errors, dim=-1), torch.cat(rows, dim=-2)
    weighted = jacobian * weights
    gram = weighted @ weighted.mT + DAMPING**2 * torch.eye(12, dtype=torch.float64)
    residual = error - (jacobian @ rest[..., None])[..., 0]
    solved = torch.linalg.solve(gram, residual[..., None])
    return rest + weights * (weighted.mT @ solved)[..., 0]


def bottle_operators(orientation: bool = True) -> list[Operator]:
    """Make the two operators of eqs (16), (17): both hands in the bottle's frame, and joints.

    Parameters
    ----------
    orientation : bool, default=True
        False leaves the hands' orientations out, as the dashed lines of figure 4 do.

    Examples
    --------
    >>> hands, joints = bottle_operators(orientation=False)
    >>> hands
    Stack(RelativePosition(link='l_hand', frame='bottle', held=False, ...
    """
    rows: list[Operator] = []
    for hand in HANDS:
        rows.append(RelativePosition(hand, "bottle"))
        if orientation:
            rows.append(RelativeOrientation(hand, "bottle"))
    return [Stack(*rows), Canonical()]
