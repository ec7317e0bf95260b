"""The arms as a robot of this project: the one of the physics."""

import mujoco
import numpy as np
import pytest
import torch
from gym_aloha import constants

import lerobot_env_bimanual  # noqa: F401  registers
from lerobot_env_bimanual.aloha.robot import (
    JOINTS,
    OBJECTS,
    SIDES,
    aloha_operators,
    aloha_robot,
)
from lerobot_env_bimanual.aloha.state import AlohaStateEnv
from tpgmm_torch import Frame
from tpgmm_torch.exceptions import TPGMMError


@pytest.mark.parametrize("task", OBJECTS)
def test_operators_fit_the_robot_and_the_objects(task):
    robot, frames = aloha_robot(), {name: Frame(torch.zeros(3)) for name in OBJECTS[task]}
    for orientation in (True, False):
        for operator in aloha_operators(task, orientation):
            operator.check(robot, frames)
    with pytest.raises(TPGMMError, match="transfer_cube"):
        aloha_operators("juggling")


def test_robot_is_the_one_of_the_physics():
    assert list(JOINTS) == constants.JOINTS
    robot = aloha_robot()
    assert robot.joint_names == JOINTS
    file = constants.ASSETS_DIR / "bimanual_viperx_insertion.xml"
    model = mujoco.MjModel.from_xml_path(str(file))
    data = mujoco.MjData(model)
    joints = np.random.default_rng(0).uniform(-1.5, 1.5, (5, 14))
    state = robot.state(joints)
    for row, values in enumerate(joints):
        data.qpos[:6], data.qpos[8:14] = values[:6], values[7:13]
        mujoco.mj_kinematics(model, data)
        for side in SIDES:
            body = data.body(f"vx300s_{side}/gripper_link")
            tip = body.xpos + 0.14 * body.xmat.reshape(3, 3)[:, 0]
            assert state[row].position(f"{side}_gripper").numpy() == pytest.approx(tip)
            alike = state[row].orientation(f"{side}_gripper") @ torch.from_numpy(body.xquat)
            assert abs(alike) == pytest.approx(1)
    limits = AlohaStateEnv().action_space
    arms = np.isfinite(robot.lower.numpy())
    assert robot.lower.numpy()[arms] == pytest.approx(limits.low[arms])
    assert robot.upper.numpy()[arms] == pytest.approx(limits.high[arms])
    assert limits.low[~arms].tolist() == [0, 0]
    assert limits.high[~arms].tolist() == [1, 1]
