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

import numpy as np
import torch
from torch import Tensor

from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import (
    Demonstration,
    Frame,
    Robot,
    RobotState,
    Situation,
    Trajectory,
    quaternions,
)
from tpgmm_torch.motion.minimum_jerk import minimum_jerk

__all__ = ["TASK", "BottleShaking", "upper_body"]

#: What LeRobot data sets of the skill call it.
TASK = "shake the bottle"
HANDS = ("l_hand", "r_hand")
SHOULDERS = ("l_shoulder_pitch", "r_shoulder_pitch")
#: Where the hands hold the bottle, in its frame [m], and how they are turned there.
GRASP_POINT = {"l_hand": (0.0, 0.08, 0.0), "r_hand": (0.0, -0.08, 0.0)}
GRASP_TURN = (math.cos(-math.pi / 4), 0.0, math.sin(-math.pi / 4), 0.0)
#: Where the hands wait before they close, in the bottle's frame [m].
APPROACH_POINT = {"l_hand": (-0.05, 0.14, 0.0), "r_hand": (-0.05, -0.14, 0.0)}
#: Where the bottle is brought, upright [m].
CHEST = np.array((0.24, 0.0, 0.18))
#: The box in which bottles stand [m], and by how much they are turned to either side [deg].
LOWEST, HIGHEST, YAW = (0.24, -0.05, 0.10), (0.32, 0.05, 0.20), 20.0
#: Nominal seconds of each phase; 13 in all, as in the paper.
PHASES = MappingProxyType(
    {
        "reach": 2.5,
        "close": 1.5,
        "hold": 0.5,
        "bring": 3.0,
        "pause": 0.5,
        "shake": 4.5,
        "rest": 0.5,
    }
)


def upper_body(**options: object) -> Robot:
    """The 17-joint upper body with both hands as links.

    Parameters
    ----------
    **options
        Passed to :meth:`tpgmm_torch.Robot.from_urdf`.
    """
    return Robot.from_urdf(upper_body_urdf(), links=HANDS, **options)  # type: ignore[arg-type]


@dataclass(frozen=True)
class BottleShaking:
    """Generator of demonstrations and situations of the bimanual bottle-shaking skill.

    Parameters
    ----------
    rate : float, default=100.0
        Time steps per second.
    amplitude : float, default=0.25
        Of the shoulders while shaking [rad]; each demonstration's differs by up to 5 %.
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

    rate: float = 100.0
    amplitude: float = 0.25
    cycles: float = 3.0
    stretch: float = 0.18
    start_spread: float = 0.05
    chest_spread: float = 0.005
    steady_rhythm: bool = False
    robot: Robot = field(default_factory=upper_body, repr=False)

    def bottle_poses(self, n: int, rng: np.random.Generator) -> Frame:
        """``n`` bottle poses within reach: a box of 8 x 10 x 10 cm, turned by up to 20 deg."""
        position = rng.uniform(LOWEST, HIGHEST, (n, 3))
        half = np.radians(rng.uniform(-YAW, YAW, n)) / 2
        zero = np.zeros(n)
        return Frame(position, np.stack((np.cos(half), zero, zero, np.sin(half)), axis=1))

    def start_postures(self, n: int, rng: np.random.Generator) -> Tensor:
        """``n`` start postures around the neutral one, shape (n, 17) [rad]."""
        spread = rng.uniform(-self.start_spread, self.start_spread, (n, self.robot.n_joints))
        joints = self.neutral_posture()
        return torch.clamp(
            joints + torch.from_numpy(spread), self.robot.lower, self.robot.upper
        )

    def situations(self, n: int, seed: int = 0) -> list[Situation]:
        """New bottle poses and start postures.

        Parameters
        ----------
        n : int
        seed : int, default=0

        Returns
        -------
        list of Situation
        """
        rng = np.random.default_rng(seed)
        bottles, starts = self.bottle_poses(n, rng), self.start_postures(n, rng)
        return [Situation(starts[i], {"bottle": bottles[i]}) for i in range(n)]

    def demonstrations(self, n: int = 10, seed: int = 0) -> list[Demonstration]:
        """Demonstrations with different bottle poses, start postures and timing.

        Parameters
        ----------
        n : int, default=10
        seed : int, default=0

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
        """The skill in given situations, without its spread in timing, chest and amplitude.

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
        ends = torch.tensor(list(PHASES.values()), dtype=torch.float64).cumsum(0)
        return self._demonstrations(
            Frame.stack([situation.frames["bottle"] for situation in situations]),
            Frame(CHEST).expand((n,)),
            torch.stack([situation.joints for situation in situations]),
            ends.expand(n, -1),
            torch.full((n,), self.amplitude, dtype=torch.float64),
        )

    def usual(self, bottle: Frame) -> bool:
        """Whether a bottle stands where :meth:`bottle_poses` may put one, but for rounding."""
        low, high = (bottle.position.new_tensor(corner) for corner in (LOWEST, HIGHEST))
        inside = (low - 1e-9 <= bottle.position) & (bottle.position <= high + 1e-9)
        w, x, y, z = bottle.orientation.tolist()
        turn = math.degrees(2 * math.atan2(z, w))
        return bool(inside.all()) and math.hypot(x, y) < 1e-6 and abs(turn) < YAW + 1e-6

    def _demonstrations(
        self,
        bottles: Frame,
        chests: Frame,
        starts: Tensor,
        ends: Tensor,
        amplitudes: Tensor,
    ) -> list[Demonstration]:
        lengths = torch.floor(ends[:, -1] * self.rate + 1e-9).long() + 1
        joints = self._follow(bottles, chests, starts, ends, amplitudes, int(lengths.max()))
        phases = list(PHASES)
        demonstrations = []
        for i in range(len(starts)):
            end = dict(zip(phases, ends[i].tolist(), strict=True))
            events = {
                "grasp": (end["close"] + end["hold"]) / 2,
                "shake": end["pause"],
                "rest": end["shake"],
            }
            steps = int(lengths[i])
            demonstrations.append(
                Demonstration(
                    torch.arange(steps, dtype=torch.float64) / self.rate,
                    joints[:steps, i],
                    {"bottle": bottles[i]},
                    self.robot.joint_names,
                    events,
                )
            )
        return demonstrations

    def grasp_error(self, joints: Tensor, bottle: Frame) -> tuple[Tensor, Tensor]:
        """How far the hands are from where they should hold the bottle, the worse of both.

        Parameters
        ----------
        joints : Tensor of shape (..., 17)
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
        distance, angle = [], []
        for hand in HANDS:
            target = _attached(bottle, GRASP_POINT[hand])
            distance.append(
                torch.linalg.vector_norm(state.position(hand) - target.position, dim=-1)
            )
            between = quaternions.product(
                target.orientation, quaternions.conjugate(state.orientation(hand))
            )
            angle.append(torch.linalg.vector_norm(quaternions.log(between), dim=-1))
        return torch.maximum(*distance), torch.maximum(*angle)

    def shoulders(self, trajectory: Trajectory | Demonstration) -> Tensor:
        """Both shoulder pitches of a motion, shape (T, 2) [rad]."""
        columns = [self.robot.joint_names.index(name) for name in SHOULDERS]
        return trajectory.joints[:, columns]

    def neutral_posture(self) -> Tensor:
        """The humanoid's published home posture, elbows out and bent, shape (17,) [rad]."""
        joints = torch.zeros(self.robot.n_joints, dtype=torch.float64)
        for side, sign in (("l", 1.0), ("r", -1.0)):
            home = {
                "shoulder_pitch": 0.5,
                "shoulder_roll": 0.5 * sign,
                "shoulder_yaw": -0.3 * sign,
                "elbow": -1.57,
            }
            for name, value in home.items():
                joints[self.robot.joint_names.index(f"{side}_{name}")] = value
        return joints

    def _phase_ends(self, n: int, rng: np.random.Generator) -> Tensor:
        """When each phase ends, shape (n, n_phases) [s]."""
        nominal = np.array(list(PHASES.values()))
        shares = nominal * rng.uniform(0.88, 1.12, (n, len(nominal)))
        total = nominal.sum() * rng.permutation(np.linspace(-1, 1, n) * self.stretch + 1)
        lengths = shares / shares.sum(1, keepdims=True) * total[:, None]
        if self.steady_rhythm:
            lengths[:, list(PHASES).index("shake")] = PHASES["shake"]
        return torch.from_numpy(lengths.cumsum(1))

    def _follow(
        self,
        bottles: Frame,
        chests: Frame,
        starts: Tensor,
        ends: Tensor,
        amplitudes: Tensor,
        steps: int,
    ) -> Tensor:
        """Inverse kinematics of all demonstrations at once, shape (steps, n, 17)."""
        robot, n = self.robot, len(starts)
        weights = torch.ones(robot.n_joints, dtype=torch.float64)
        weights[
            [robot.joint_names.index(f"waist_{axis}") for axis in ("roll", "pitch", "yaw")]
        ] = 0.3
        neutral = self.neutral_posture()
        shaken = [robot.joint_names.index(name) for name in SHOULDERS]
        first = robot.state(starts)
        paths = {hand: _Path(first, hand, bottles, chests) for hand in HANDS}
        limit = robot.velocity / self.rate
        joints, out = starts, [starts]
        for k in range(1, steps):
            progress = _progress(torch.full((n,), k / self.rate, dtype=torch.float64), ends)
            wanted = [paths[hand].at(progress) for hand in HANDS]
            step = _least_squares(robot, joints, wanted, weights, neutral, 1 / self.rate)
            joints = torch.clamp(
                joints + torch.clamp(step, -limit, limit), robot.lower, robot.upper
            )
            u = progress["shake"]
            ramp = minimum_jerk(8 * u) * minimum_jerk(8 * (1 - u))
            swing = torch.zeros_like(joints)
            swing[:, shaken] = (amplitudes * ramp * torch.sin(2 * math.pi * self.cycles * u))[
                :, None
            ]
            out.append(joints + swing)
        return torch.stack(out)


class _Path:
    """Where one hand should be: minimum-jerk segments on the bottle's frame."""

    def __init__(self, start: RobotState, hand: str, bottle: Frame, chest: Frame) -> None:
        self.hand, self.bottle, self.chest = hand, bottle, chest
        self.start = Frame(start.position(hand), start.orientation(hand))
        self.approach = _attached(bottle, APPROACH_POINT[hand])
        self.grasp = _attached(bottle, GRASP_POINT[hand])

    def at(self, progress: Mapping[str, Tensor]) -> Frame:
        pose = _between(self.start, self.approach, progress["reach"])
        pose = _between(pose, self.grasp, progress["close"])
        # from the grasp on the bottle moves, and the hand with it
        carried = _between(self.bottle, self.chest, progress["bring"])
        held = _attached(carried, GRASP_POINT[self.hand])
        bringing = (progress["bring"] > 0)[:, None]
        return Frame(
            torch.where(bringing, held.position, pose.position),
            torch.where(bringing, held.orientation, pose.orientation),
        )


def _attached(frame: Frame, point: tuple[float, ...]) -> Frame:
    """The grasp orientation at a point of a frame."""
    turn = torch.tensor(GRASP_TURN, dtype=torch.float64).expand_as(frame.orientation)
    where = torch.tensor(point, dtype=torch.float64)
    return Frame(frame.transform(where), quaternions.product(frame.orientation, turn))


def _between(a: Frame, b: Frame, progress: Tensor) -> Frame:
    u = minimum_jerk(progress)
    position = a.position + u[:, None] * (b.position - a.position)
    start, end = torch.broadcast_tensors(a.orientation, b.orientation)
    return Frame(position, quaternions.slerp(start, end, u))


def _progress(time: Tensor, ends: Tensor) -> dict[str, Tensor]:
    """How much of each phase is done, in [0, 1]."""
    starts = torch.cat((torch.zeros_like(ends[:, :1]), ends[:, :-1]), dim=1)
    done = ((time[:, None] - starts) / (ends - starts)).clamp(0, 1)
    return dict(zip(PHASES, done.T, strict=True))


def _least_squares(
    robot: Robot,
    joints: Tensor,
    wanted: list[Frame],
    weights: Tensor,
    posture: Tensor,
    dt: float,
    damping: float = 1e-3,
    posture_rate: float = 1.0,
) -> Tensor:
    """Damped least-squares step to the wanted hand poses; the null space seeks the posture."""
    state = robot.state(joints)
    errors, rows = [], []
    for hand, target in zip(HANDS, wanted, strict=True):
        turn = quaternions.product(
            target.orientation, quaternions.conjugate(state.orientation(hand))
        )
        errors += [target.position - state.position(hand), quaternions.log(turn)]
        rows += [state.linear_jacobian(hand), state.angular_jacobian(hand)]
    error, jacobian = torch.cat(errors, dim=-1), torch.cat(rows, dim=-2)
    weighted = jacobian * weights
    gram = weighted @ weighted.mT + damping**2 * torch.eye(12, dtype=torch.float64)
    rest = posture_rate * dt * (posture - joints)
    residual = error - (jacobian @ rest[..., None])[..., 0]
    solved = torch.linalg.solve(gram, residual[..., None])
    return rest + weights * (weighted.mT @ solved)[..., 0]
