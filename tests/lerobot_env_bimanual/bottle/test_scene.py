"""The simulated world: the robot of the kinematics, and what can be done to it."""

import mujoco
import numpy as np

import lerobot_env_bimanual  # noqa: F401  registers the environment
from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.bottle.scene import BottleScene


def test_the_simulated_robot_is_the_one_of_the_kinematics():
    scene = BottleScene()
    rng = np.random.default_rng(0)
    robot = skill().robot
    for _ in range(5):
        joints = rng.uniform(robot.lower, robot.upper)
        scene.reset({"bottle": [0.3, 0, 0.15, 1, 0, 0, 0]}, joints, 0.0)
        state = robot.state(joints)
        for hand in ("l_hand", "r_hand"):
            body = scene.data.body(hand)
            np.testing.assert_allclose(body.xpos, state.position(hand), atol=1e-12)
            apart = np.empty(3)
            mujoco.mju_subQuat(apart, body.xquat, state.orientation(hand).numpy())
            np.testing.assert_allclose(apart, 0, atol=1e-9)
