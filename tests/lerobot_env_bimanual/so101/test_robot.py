"""What the servos of the simulated SO-101 arms do to where the links are."""

import mujoco
import numpy as np
import pytest

from lerobot_env_bimanual.so101.robot import BACKLASH
from lerobot_env_bimanual.so101.scene import BiSo101Scene
from tpgmm_datasets.robots import bi_so101_urdf, parse_robot

CUP = np.array([0.5, 0.45, 0, 1, 0, 0, 0])
ROBOT = parse_robot(bi_so101_urdf())


@pytest.fixture(scope="module")
def stretched():
    """A scene at rest, both arms told to stretch forward, the left one with a saucer."""
    scene = BiSo101Scene()
    held = np.array([0, 0, 0.045, 1, 0, 0, 0])
    scene.reset({"cup": CUP, "saucer": held}, np.zeros(12))
    return scene


def test_gravity_bends_the_stretched_arm_by_two_degrees(stretched):
    joints = dict(zip(ROBOT.joint_names, np.rad2deg(stretched.joints), strict=True))
    assert 1.5 < joints["right_shoulder_lift"] < 2.5
    assert joints["left_shoulder_lift"] > joints["right_shoulder_lift"]  # it holds something
    assert abs(joints["right_shoulder_pan"]) < 0.1


def test_links_are_where_the_description_says_for_angles_not_for_encoders(stretched):
    def miss(joints):
        state = ROBOT.state(np.asarray(joints))
        there = stretched.data.body("right_gripper_frame_link").xpos
        return np.linalg.norm(state.position("right_gripper_frame_link").numpy() - there)

    assert miss(stretched.angles) < 1e-6
    assert 1e-3 < miss(stretched.joints) < 5e-3  # the play of three joints


def test_a_link_turns_freely_within_the_backlash(stretched):
    scene, pan = stretched, ROBOT.joint_names.index("right_shoulder_pan")
    place, ends = scene.model.joint("right_shoulder_pan_play"), []
    for side in (1, -1):
        scene.data.qfrc_applied[place.dofadr] = 0.03 * side  # less than the motor's friction
        mujoco.mj_step(scene.model, scene.data, 500)
        ends.append((scene.angles[pan], scene.joints[pan]))
    scene.data.qfrc_applied[:] = 0
    (left, first), (right, second) = ends
    assert (left - first) - (right - second) == pytest.approx(BACKLASH, rel=0.15)
    assert abs(first - second) < 0.2 * BACKLASH
