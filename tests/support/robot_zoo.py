"""Robots for the tests, and pinocchio as an oracle for them."""

import math
import sysconfig
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import quaternions
from tpgmm_torch.robots.kinematic_tree import Body
from tpgmm_torch.robots.kinematics import Kinematics
from tpgmm_torch.robots.robot import Robot

HANDS = ("l_hand", "r_hand")
G1_PATH = Path(
    sysconfig.get_path("purelib"),
    "cmeel.prefix/share/example-robot-data/robots/g1_description/urdf/g1_29dof_rev_1_0.urdf",
)
G1_ARM = ("shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow", "wrist_roll")
G1_ARM += ("wrist_pitch", "wrist_yaw")
G1_JOINTS = tuple(f"waist_{axis}_joint" for axis in ("yaw", "roll", "pitch")) + tuple(
    f"{side}_{joint}_joint" for side in ("left", "right") for joint in G1_ARM
)
G1_HANDS = ("left_rubber_hand", "right_rubber_hand")

# every kind of joint: sliding, endless, without an axis, with one not of unit length, fixed
# and turned, following another on the same and on another branch
ZOO = """<robot name="zoo">
  <link name="ground"/> <link name="column"/> <link name="turret"/> <link name="arm"/>
  <link name="flange"/> <link name="l_finger"/> <link name="r_finger"/> <link name="tail"/>
  <link name="tip"/>
  <joint name="lift" type="prismatic">
    <parent link="ground"/><child link="column"/><axis xyz="0 0 2"/>
    <origin xyz="0.1 0 0.2" rpy="0.3 -0.2 0.1"/>
    <limit lower="-0.1" upper="0.5" effort="1" velocity="0.2"/>
  </joint>
  <joint name="swivel" type="continuous">
    <parent link="column"/><child link="turret"/><origin xyz="0 0.1 0"/>
  </joint>
  <joint name="elbow" type="revolute">
    <parent link="turret"/><child link="arm"/><axis xyz="1 1 0"/>
    <origin xyz="0 0 0.3" rpy="1.5707963267948966 0 0"/>
    <limit lower="-1" upper="2" effort="1" velocity="3"/>
  </joint>
  <joint name="weld" type="fixed">
    <parent link="arm"/><child link="flange"/><origin xyz="0.2 0 0" rpy="1.2 0.4 -0.7"/>
  </joint>
  <joint name="grip" type="prismatic">
    <parent link="flange"/><child link="l_finger"/><axis xyz="0 1 0"/>
    <limit lower="0" upper="0.1" effort="1" velocity="1"/>
  </joint>
  <joint name="grip_too" type="prismatic">
    <parent link="flange"/><child link="r_finger"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="grip" multiplier="-1" offset="0.01"/>
  </joint>
  <joint name="wag" type="revolute">
    <parent link="ground"/><child link="tail"/><axis xyz="0 1 0"/><origin xyz="-0.2 0 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
  </joint>
  <joint name="wag_too" type="revolute">
    <parent link="tail"/><child link="tip"/><axis xyz="0 0 1"/><origin xyz="-0.1 0 0.1"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/>
    <mimic joint="elbow" multiplier="0.5" offset="0.2"/>
  </joint>
</robot>"""
ZOO_JOINTS = ("lift", "swivel", "elbow", "grip", "wag")
ZOO_FOLLOWERS = {"grip_too": ("grip", -1.0, 0.01), "wag_too": ("elbow", 0.5, 0.2)}
ZOO_LINKS = ("tip", "l_finger", "r_finger", "flange", "column", "ground")


def upper_body(**settings: Any) -> Robot:
    return Robot.from_urdf(upper_body_urdf(), HANDS, **settings)


def zoo(links: Any = ZOO_LINKS, **settings: Any) -> Robot:
    return Robot.from_urdf(ZOO, links, **settings)


def g1() -> Robot:
    return Robot.from_urdf(G1_PATH, G1_HANDS, joints=G1_JOINTS)


def random_joints(robot: Kinematics, *batch: int, seed: int = 0) -> Tensor:
    uniform = torch.rand(
        *batch,
        robot.n_joints,
        generator=torch.Generator().manual_seed(seed),
        dtype=torch.float64,
    )
    lower, upper = robot.lower.double().clamp(min=-3), robot.upper.double().clamp(max=3)
    return lower + (upper - lower) * uniform


def skew(vector: np.ndarray) -> np.ndarray:
    return np.cross(np.eye(3), vector)


Followers = dict[str, tuple[str, float, float]]


class Pinocchio:
    """Poses and Jacobians by pinocchio, of which every movable joint is independent."""

    def __init__(
        self, model: pin.Model, followers: dict[str, tuple[str, float, float]]
    ) -> None:
        self.model, self.data, self.followers = model, model.createData(), followers

    def run(self, values: dict[str, float]) -> None:
        q = pin.neutral(self.model)
        for name, (leader, multiplier, offset) in self.followers.items():
            values = values | {name: multiplier * values.get(leader, 0.0) + offset}
        for name, value in values.items():
            joint = self.model.joints[self.model.getJointId(name)]
            endless = joint.nq == 2
            q[joint.idx_q : joint.idx_q + joint.nq] = (
                (math.cos(value), math.sin(value)) if endless else value
            )
        pin.computeJointJacobians(self.model, self.data, q)
        pin.updateFramePlacements(self.model, self.data)

    def column(self, jacobian: np.ndarray, name: str) -> np.ndarray:
        column = jacobian[:, self.model.joints[self.model.getJointId(name)].idx_v].copy()
        for follower, (leader, multiplier, _) in self.followers.items():
            if leader == name:
                column += multiplier * self.column(jacobian, follower)
        return column

    def link(self, name: str, base: str, joints: tuple[str, ...]) -> tuple[np.ndarray, ...]:
        """Position, rotation and Jacobian relative to a base that joints may move."""
        (p, R, J), (p_b, R_b, J_b) = (self._absolute(link, joints) for link in (name, base))
        linear = J[:3] - J_b[:3] + skew(p - p_b) @ J_b[3:]
        relative = np.vstack((R_b.T @ linear, R_b.T @ (J[3:] - J_b[3:])))
        return R_b.T @ (p - p_b), R_b.T @ R, relative

    def _absolute(self, name: str, joints: tuple[str, ...]) -> tuple[np.ndarray, ...]:
        index = self.model.getFrameId(name, pin.FrameType.BODY)
        place = self.data.oMf[index]
        J = pin.getFrameJacobian(self.model, self.data, index, pin.LOCAL_WORLD_ALIGNED)
        columns = [self.column(J, name) for name in joints]
        return place.translation, place.rotation, np.array(columns).T


def written_out(tree: Sequence[Body], joints: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses (N, 4, 4) and geometric Jacobians (N, 6, n) of all bodies, joint by joint."""
    poses, jacobians = [np.eye(4)], [np.zeros((6, len(joints)))]
    for body in tree[1:]:
        motion = np.eye(4)
        if body.joint is not None:
            value = body.multiplier * joints[body.joint] + body.shift
            if body.slides:
                motion[2, 3] = value
            else:
                motion[:3, :3] = Rotation.from_rotvec([0, 0, value]).as_matrix()
        before = poses[body.parent]
        pose = before @ body.pose @ motion
        carried = jacobians[body.parent].copy()
        carried[:3] += np.cross(carried[3:].T, pose[:3, 3] - before[:3, 3]).T
        if body.joint is not None:
            axis = body.multiplier * pose[:3, 2]
            carried[slice(3) if body.slides else slice(3, 6), body.joint] += axis
        poses.append(pose)
        jacobians.append(carried)
    return np.array(poses), np.array(jacobians)


def assert_agrees(
    robot: Robot, oracle: Pinocchio, base: str, locked: dict[str, float] | None = None
) -> None:
    postures = random_joints(robot, 20)
    many = robot.state(postures.repeat(10, 1))
    for number, joints in enumerate(postures):
        oracle.run((locked or {}) | dict(zip(robot.joint_names, joints.tolist(), strict=True)))
        for state in (robot.state(joints), many[number], many[180 + number]):
            for index, link in enumerate(robot.links):
                expected = oracle.link(link, base, robot.joint_names)
                turned = quaternions.to_matrix(state.orientation(link))
                found = state.position(link), turned, state.jacobians[index]
                for mine, theirs in zip(found, expected, strict=True):
                    np.testing.assert_allclose(mine.numpy(), theirs, rtol=0, atol=1e-12)


def assert_differences_agree(robot: Kinematics, joints: Tensor, atol: float = 1e-8) -> None:
    """Jacobians against central differences of positions and orientations."""
    step = 1e-6
    steps = step * torch.eye(robot.n_joints, dtype=torch.float64)
    ahead, behind = robot.state(joints + steps), robot.state(joints - steps)
    linear = (ahead.positions - behind.positions) / (2 * step)
    turn = quaternions.product(ahead.orientations, quaternions.conjugate(behind.orientations))
    angular = quaternions.log(turn) / (2 * step)
    differences = torch.cat((linear, angular), dim=-1).permute(1, 2, 0)
    torch.testing.assert_close(robot.state(joints).jacobians, differences, rtol=0, atol=atol)
