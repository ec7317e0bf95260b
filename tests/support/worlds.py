"""Where operators act: on the 17-joint upper body, or on poses without a robot."""

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import replace
from functools import cache

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tests.support import oracles
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import Frame, Robot, quaternions
from tpgmm_torch.robots import Poses, RobotState
from tpgmm_torch.robots.kinematics import Kinematics

LEFT, RIGHT, OBJECT, CARRIED = "l_hand", "r_hand", "object", "bottle"
#: How the right hand holds what it carries.
GRASP = Frame([0.05, -0.12, 0.08], np.array([0.6, -0.2, 0.5, -0.59]) / np.sqrt(0.9981))
#: Where everything goes in laws of invariance.
MOVED = Frame([0.4, -0.3, 0.7], np.array([0.6, -0.2, 0.5, 0.59]) / np.sqrt(0.9981))


def units(rng: np.random.Generator, *batch: int) -> Tensor:
    return quaternions.normalize(torch.from_numpy(rng.standard_normal((*batch, 4))))


def moved(pose: Frame) -> Frame:
    turned = quaternions.product(MOVED.orientation, pose.orientation)
    return Frame(MOVED.transform(pose.position), turned)


@cache
def upper_body() -> Robot:
    return Robot.from_urdf(upper_body_urdf(), links=(LEFT, RIGHT))


@cache
def moved_upper_body() -> Robot:
    """The same robot, standing at ``MOVED`` in its base frame."""
    turn = Rotation.from_quat(MOVED.orientation.numpy(), scalar_first=True).as_euler("xyz")
    xyz, rpy = (" ".join(map(repr, v)) for v in (MOVED.position.tolist(), turn.tolist()))
    stand = (
        '<link name="world"/><joint name="stand" type="fixed"><parent link="world"/>'
        f'<child link="base"/><origin xyz="{xyz}" rpy="{rpy}"/></joint></robot>'
    )
    return Robot.from_urdf(upper_body_urdf().replace("</robot>", stand), links=(LEFT, RIGHT))


class Carrying(Kinematics):
    """A robot whose right hand carries an object."""

    def __init__(self, robot: Kinematics) -> None:
        self.robot = robot
        self.joint_names, self.links = robot.joint_names, robot.links
        self.lower, self.upper, self.velocity = robot.lower, robot.upper, robot.velocity
        self.quaternion_starts = robot.quaternion_starts

    def state(self, joints):
        return self.robot.state(joints).with_link(CARRIED, RIGHT, GRASP)

    def retract(self, joints):
        return self.robot.retract(joints)

    def to(self, dtype=None, device=None):
        return Carrying(self.robot.to(dtype, device))


class World(ABC):
    """A kinematics, postures in it, and what changes of coordinates do to them."""

    kinematics: Kinematics
    #: the columns of each link's quaternion, where poses are the space
    quaternion_columns: Mapping[str, slice] = {}

    @abstractmethod
    def joints(self, rng: np.random.Generator, *batch: int) -> Tensor:
        """Random postures, away from singular ones."""

    @abstractmethod
    def moved(self, joints: Tensor) -> RobotState:
        """The state after everything was moved by ``MOVED``."""

    @abstractmethod
    def moved_answer(self, joints: Tensor) -> Tensor:
        """What becomes of an operator's answer then."""

    @abstractmethod
    def flipped(self, state: RobotState) -> RobotState:
        """The same state with every quaternion negated."""

    @abstractmethod
    def flipped_answer(self, joints: Tensor) -> Tensor:
        """What becomes of an operator's answer then."""

    def scene(self, *batch: int, seed: int = 0) -> tuple[RobotState, dict[str, Frame]]:
        """A random state, and the pose of an object."""
        rng = np.random.default_rng(seed)
        position = torch.from_numpy(rng.standard_normal((*batch, 3)))
        state = self.kinematics.state(self.joints(rng, *batch))
        return state, {OBJECT: Frame(position, units(rng, *batch))}

    def at(self, state: RobotState, frames: Mapping[str, Frame]) -> oracles.At:
        """One state for the oracles."""
        return oracles.At(
            state.joints.numpy(),
            {n: (state.position(n).numpy(), state.orientation(n).numpy()) for n in state.links},
            {n: state.jacobians[i].numpy() for i, n in enumerate(state.links)},
            {n: (f.position.numpy(), f.orientation.numpy()) for n, f in frames.items()},
            dict(self.quaternion_columns),
        )


class OnRobot(World):
    """The upper body: joints stay what they are, whatever happens to the world."""

    kinematics = upper_body()

    def joints(self, rng: np.random.Generator, *batch: int) -> Tensor:
        lower, upper = self.kinematics.lower, self.kinematics.upper
        return lower + torch.from_numpy(rng.uniform(0.25, 0.75, (*batch, 17))) * (upper - lower)

    def moved(self, joints: Tensor) -> RobotState:
        return moved_upper_body().state(joints)

    def moved_answer(self, joints: Tensor) -> Tensor:
        return joints

    def flipped(self, state: RobotState) -> RobotState:
        return replace(state, orientations=-state.orientations)

    def flipped_answer(self, joints: Tensor) -> Tensor:
        return joints


class OnPoses(World):
    """Classic TP-GMM: the joint vector holds the poses themselves."""

    kinematics = Poses((LEFT, RIGHT))
    quaternion_columns: Mapping[str, slice] = {LEFT: slice(3, 7), RIGHT: slice(10, 14)}

    def joints(self, rng: np.random.Generator, *batch: int) -> Tensor:
        positions = torch.from_numpy(rng.standard_normal((*batch, 2, 3)))
        return torch.cat((positions, units(rng, *batch, 2)), dim=-1).flatten(-2)

    def moved(self, joints: Tensor) -> RobotState:
        return self.kinematics.state(self.moved_answer(joints))

    def moved_answer(self, joints: Tensor) -> Tensor:
        poses = joints.unflatten(-1, (2, 7))
        turned = quaternions.product(MOVED.orientation, poses[..., 3:])
        return torch.cat((MOVED.transform(poses[..., :3]), turned), dim=-1).flatten(-2)

    def flipped(self, state: RobotState) -> RobotState:
        return self.kinematics.state(self.flipped_answer(state.joints))

    def flipped_answer(self, joints: Tensor) -> Tensor:
        poses = joints.unflatten(-1, (2, 7))
        return torch.cat((poses[..., :3], -poses[..., 3:]), dim=-1).flatten(-2)


class CarryingOnRobot(OnRobot):
    """The upper body with an object in its right hand."""

    kinematics = Carrying(OnRobot.kinematics)

    def moved(self, joints: Tensor) -> RobotState:
        return super().moved(joints).with_link(CARRIED, RIGHT, GRASP)


class CarryingOnPoses(OnPoses):
    """Tracked bodies, the right one with an object."""

    kinematics = Carrying(OnPoses.kinematics)
