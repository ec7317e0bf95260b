"""A scripted expert for gym-aloha's tasks: from where the objects lie to a whole motion.

Each arm goes through way points: a pose of the point between its fingers, in an object's frame
or in the world, and an opening of the gripper. Inverse kinematics makes postures of them, and
from posture to posture all joints take minimum-jerk steps. The expert sees the first
observation only, like a policy that predicts open loop.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from lerobot_env_bimanual.aloha.robot import JOINTS, OBJECTS, SIDES, aloha_robot
from tpgmm_torch import Frame, Robot, quaternions
from tpgmm_torch.data.arrays import as_tensor
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.motion.minimum_jerk import minimum_jerk


def _turn_about(quaternion: Tensor, **axes: float) -> Tensor:
    """Turn on about axes of the body, given in degrees."""
    for axis, angle in axes.items():
        vector = math.radians(angle) * torch.eye(3, dtype=torch.float64)["xyz".index(axis)]
        quaternion = quaternions.product(quaternion, quaternions.exp(vector))
    return quaternion


LEFT = quaternions.identity()  # the left gripper looks along the world's x axis
RIGHT = _turn_about(LEFT, z=180)
LEFT_ROLLED = _turn_about(LEFT, x=90)  # fingers above one another
LEFT_DOWN, RIGHT_DOWN = _turn_about(LEFT, y=90), _turn_about(RIGHT, y=90)

#: Height of each object's centre when it rests on the table [m].
RESTING = {"cube": 0.02, "peg": 0.01, "socket": 0.022}
#: Turned about the vertical by this an object looks the same [rad].
SYMMETRY = {"cube": math.pi / 2, "peg": math.pi, "socket": math.pi}
OPEN, CLOSED = 1.0, 0.0
#: Postures that a straight line is made of.
LINE_PIECES = 8


@dataclass(frozen=True)
class WayPoint:
    """Where an arm is to be at an instant.

    Parameters
    ----------
    time : float
        [s]
    position : tuple of 3 floats
        Of the point between the fingers, in ``frame`` [m].
    turn : Tensor of shape (4,)
        Orientation of the gripper in ``frame``, a unit quaternion.
    opening : float
        Of the gripper, 0 to 1.
    frame : str, optional
        An object, as it lies on the table; the default is the world.
    straight : bool, default=False
        Whether the way there is a straight line; by default the joints take the shortest.
    """

    time: float
    position: tuple[float, float, float]
    turn: Tensor
    opening: float
    frame: str | None = None
    straight: bool = False


def _picking(
    frame: str, turn: Tensor, depth: float, lift: float = 0.12
) -> tuple[WayPoint, ...]:
    """Reach above an object, grasp it from there, and lift it."""
    above, there = (0.0, 0.0, 0.1), (0.0, 0.0, depth)
    return (
        WayPoint(1.2, above, turn, OPEN, frame),
        WayPoint(1.9, there, turn, OPEN, frame, straight=True),
        WayPoint(2.1, there, turn, OPEN, frame),
        WayPoint(2.7, there, turn, CLOSED, frame),
        WayPoint(3.4, (0.0, 0.0, lift), turn, CLOSED, frame, straight=True),
    )


MEETING, BEFORE, BEHIND = (0.0, 0.5, 0.28), (-0.12, 0.5, 0.28), (0.12, 0.5, 0.28)
#: Way points of both arms, left and right, for each task.
PLANS = {
    "transfer_cube": (
        (
            WayPoint(3.6, BEFORE, LEFT_ROLLED, OPEN),
            WayPoint(4.7, BEFORE, LEFT_ROLLED, OPEN),
            WayPoint(5.3, MEETING, LEFT_ROLLED, OPEN, straight=True),
            WayPoint(5.9, MEETING, LEFT_ROLLED, CLOSED),
        ),
        (
            *_picking("cube", RIGHT_DOWN, 0.003),
            WayPoint(4.7, MEETING, RIGHT, CLOSED),
            WayPoint(6.1, MEETING, RIGHT, CLOSED),
            WayPoint(6.6, MEETING, RIGHT, OPEN),
            WayPoint(7.2, BEHIND, RIGHT, OPEN, straight=True),
        ),
    ),
    "insertion": (
        (
            *_picking("socket", LEFT_DOWN, 0.003),
            WayPoint(4.6, (-0.08, 0.5, 0.2), LEFT_DOWN, CLOSED),
        ),
        (
            *_picking("peg", RIGHT_DOWN, 0.010),
            WayPoint(4.6, (0.05, 0.5, 0.206), RIGHT_DOWN, CLOSED),
            WayPoint(5.2, (0.05, 0.5, 0.206), RIGHT_DOWN, CLOSED),
            WayPoint(7.0, (0.01, 0.5, 0.206), RIGHT_DOWN, CLOSED, straight=True),
        ),
    ),
}


@dataclass(frozen=True)
class AlohaExpert:
    """Plans of joint references that solve a task of :class:`AlohaStateEnv`.

    Parameters
    ----------
    task : {"transfer_cube", "insertion"}, default="transfer_cube"
    fps : float, default=50
        References per second.
    duration : float, default=7.5
        Seconds; from the last way point on the arms stand still.
    """

    task: str = "transfer_cube"
    fps: float = 50
    duration: float = 7.5
    robot: Robot = field(default_factory=aloha_robot, repr=False)

    def __post_init__(self) -> None:
        if self.task not in PLANS:
            raise UnknownNameError("task", self.task, "the expert", PLANS)

    def plan(self, agent_pos: Any, environment_state: Any) -> NDArray[np.float64]:
        """Plan the references that follow on a first observation.

        Parameters
        ----------
        agent_pos : array-like of shape (..., 14)
        environment_state : array-like of shape (..., 7) or (..., 14)
            Each object's pose, x y z and w x y z; height and tilt do not matter.

        Returns
        -------
        ndarray of shape (..., T, 14)

        Raises
        ------
        ShapeError
            If a shape does not fit the task.
        DataError
            If an object lies out of reach.
        """
        start = as_tensor(agent_pos, "agent_pos")
        poses = as_tensor(environment_state, "environment_state")
        names = OBJECTS[self.task]
        if start.shape[-1:] != (len(JOINTS),) or poses.shape[-1:] != (7 * len(names),):
            raise ShapeError(
                f"{self.task} has {len(JOINTS)} joints and, 7 values each, poses of {names}; "
                f"got the shapes {tuple(start.shape)} and {tuple(poses.shape)}"
            )
        batch = torch.broadcast_shapes(start.shape[:-1], poses.shape[:-1])
        start = start.expand(*batch, -1).reshape(-1, len(JOINTS))
        poses = poses.expand(*batch, -1).reshape(len(start), len(names), 7)
        frames = {name: _lying(name, poses[:, i]) for i, name in enumerate(names)}
        steps = round(self.duration * self.fps)
        time = torch.arange(1, steps + 1, dtype=torch.float64) / self.fps
        arms = start.unflatten(-1, (len(SIDES), -1)).unbind(-2)
        references = [
            self._arm(side, arm, PLANS[self.task][i], frames, time)
            for i, (side, arm) in enumerate(zip(SIDES, arms, strict=True))
        ]
        return torch.cat(references, dim=-1).reshape(*batch, steps, len(JOINTS)).numpy()

    def _arm(
        self,
        side: str,
        start: Tensor,
        way_points: tuple[WayPoint, ...],
        frames: dict[str, Frame],
        time: Tensor,
    ) -> Tensor:
        """References of one arm and its gripper, shape (B, T, 7)."""
        state, _ = self._state(side, start)
        here, posture, now = Frame(*state), start, 0.0
        references = start.expand(len(time), *start.shape)
        for point in way_points:
            target = _pose(point, frames)
            path = [posture]
            pieces = LINE_PIECES if point.straight else 1
            for piece in range(1, pieces + 1):
                joints = self._reach(side, path[-1], _between(here, target, piece / pieces))
                opening = torch.full_like(joints[:, :1], point.opening)
                opening = torch.lerp(posture[:, -1:], opening, piece / pieces)
                path.append(torch.cat((joints, opening), dim=1))
            passed = pieces * minimum_jerk((time - now) / (point.time - now))
            node = passed.long().clamp(max=pieces - 1)
            nodes, share = torch.stack(path), (passed - node)[:, None, None]
            references = references + torch.lerp(nodes[node], nodes[node + 1], share) - posture
            here, posture, now = target, path[-1], point.time
        return references.transpose(0, 1)

    def _reach(self, side: str, seed: Tensor, target: Frame) -> Tensor:
        """Joints (B, 6) of an arm that bring its gripper to a pose, from others near by."""
        seed = seed.clone()
        lower, upper = self.robot.lower[:6], self.robot.upper[:6]  # both arms have the same
        for _ in range(100):
            (position, orientation), jacobian = self._state(side, seed)
            turn = quaternions.product(target.orientation, quaternions.conjugate(orientation))
            error = torch.cat((target.position - position, quaternions.log(turn)), dim=1)
            if error.abs().max() < 1e-9:
                return seed[:, :6]
            # damped by the error itself (Sugihara 2011): far away it does not jump at the
            # singular posture of a straight wrist, near by it converges fast
            damping = (error.square().sum(1) / 2 + 1e-9)[:, None, None]
            normal = jacobian.mT @ jacobian + damping * torch.eye(6, dtype=seed.dtype)
            step = torch.linalg.solve(normal, (jacobian.mT @ error[..., None])[..., 0])
            seed[:, :6] = torch.clamp(seed[:, :6] + step, lower, upper)
        worst = int(error.abs().amax(1).argmax())
        raise DataError(
            f"the {side} gripper cannot get to {target.position[worst].tolist()} m as it "
            "should: an object lies out of the arm's reach"
        )

    def _state(self, side: str, arm: Tensor) -> tuple[tuple[Tensor, Tensor], Tensor]:
        """Position and orientation of a gripper at (B, 7), and its Jacobian (B, 6, 6)."""
        first = SIDES.index(side) * arm.shape[1]
        joints = arm.new_zeros(len(arm), len(JOINTS))
        joints[:, first : first + arm.shape[1]] = arm
        state, link = self.robot.state(joints), f"{side}_gripper"
        rows = (state.linear_jacobian(link), state.angular_jacobian(link))
        pose = state.position(link), state.orientation(link)
        return pose, torch.cat(rows, dim=-2)[..., first : first + 6]


def _lying(name: str, pose: Tensor) -> Frame:
    """Return an object's frame at rest, turned to the nearest of its equal looks."""
    _, _, _, w, x, y, z = pose.unbind(-1)
    yaw = torch.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    half = (yaw - SYMMETRY[name] * torch.round(yaw / SYMMETRY[name])) / 2
    none = torch.zeros_like(half)
    height = torch.full_like(half, RESTING[name])
    return Frame(
        torch.stack((pose[:, 0], pose[:, 1], height), dim=1),
        torch.stack((torch.cos(half), none, none, torch.sin(half)), dim=1),
    )


def _pose(point: WayPoint, frames: dict[str, Frame]) -> Frame:
    """Return the pose of a way point in the world, one for each situation."""
    some = next(iter(frames.values()))
    frame = (
        Frame(torch.zeros_like(some.position)) if point.frame is None else frames[point.frame]
    )
    position = torch.tensor(point.position, dtype=torch.float64)
    return Frame(frame.transform(position), quaternions.product(frame.orientation, point.turn))


def _between(a: Frame, b: Frame, share: float) -> Frame:
    position = torch.lerp(a.position, b.position, share)
    return Frame(position, quaternions.slerp(a.orientation, b.orientation, share))
