"""gym-aloha's arms at the suite's table: they are those, one the mirror image of the other."""

import sys

import mujoco
import numpy as np
import pytest
import torch
from gym_aloha import constants

from lerobot_env_bimanual.aloha.robot import SIDES
from lerobot_env_bimanual.suite.robots.embodiments import embodiment
from lerobot_env_bimanual.suite.robots.viperx import (
    BASE,
    viperx_robot,
    viperx_spec,
)
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_torch.exceptions import DependencyError

ROBOT = embodiment("viperx").robot


def test_the_arms_are_gym_alohas():
    """Ranges, masses, and how links follow one another, wherever the arm stands."""
    theirs = mujoco.MjModel.from_xml_path(
        str(constants.ASSETS_DIR / "bimanual_viperx_transfer_cube.xml")
    )
    model = viperx_spec().compile()
    data, seen = mujoco.MjData(model), mujoco.MjData(theirs)
    for column, name in enumerate(ROBOT.joint_names):
        side, _, joint = name.split("_", 2)
        there = theirs.joint(f"vx300s_{side}/{joint}")
        np.testing.assert_array_equal(model.joint(name).range, there.range)
        limits = ROBOT.lower[column], ROBOT.upper[column]
        np.testing.assert_array_equal(limits, np.float64(there.range))
        body = model.body(int(model.joint(name).bodyid[0]))
        assert body.mass == theirs.body(int(there.bodyid[0])).mass
        data.joint(name).qpos = seen.joint(there.name).qpos = 0.3
    for each, world in ((model, data), (theirs, seen)):
        mujoco.mj_kinematics(each, world)
    for side in SIDES:
        base, gripper = f"vx300s_{side}", f"vx300s_{side}/gripper_link"
        places = []
        for world in (data, seen):
            turn = world.body(base).xmat.reshape(3, 3)
            places.append(turn.T @ (world.body(gripper).xpos - world.body(base).xpos))
        np.testing.assert_allclose(*places, atol=1e-12)


def test_one_arm_is_the_mirror_image_of_the_other():
    posture = embodiment("viperx").posture
    state = ROBOT.state(posture)
    left, right = (state.position(hand) for hand in HANDS)
    np.testing.assert_allclose(left * torch.tensor((1.0, -1.0, 1.0)), right, atol=1e-12)
    model = viperx_spec().compile()
    for side, sign in zip(SIDES, (1, -1), strict=True):
        base = model.body(f"vx300s_{side}")
        np.testing.assert_allclose(base.pos, np.multiply(BASE, (1, sign, 1)))
        np.testing.assert_array_equal(base.quat, (1, 0, 0, 0))


def test_without_gym_aloha_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_aloha.constants", None)
    for make in (viperx_robot, viperx_spec):
        with pytest.raises(DependencyError, match=r"viperx needs gym-aloha: pip install"):
            make()
