"""gym-aloha's arms at the suite's table: kinematics are those of the physics, and reach all."""

import json
import sys

import mujoco
import numpy as np
import pytest
import torch
from gym_aloha import constants

from lerobot_policy_tpgmm.environments.aloha.pair import BASE, pair_robot, pair_spec
from lerobot_policy_tpgmm.environments.aloha.robot import ARM_JOINTS, SIDES
from lerobot_policy_tpgmm.environments.start import PUSHED
from lerobot_policy_tpgmm.environments.suite.embodiments import embodiment
from lerobot_policy_tpgmm.environments.suite.env import SuiteEnv
from lerobot_policy_tpgmm.environments.suite.names import SUITE
from lerobot_policy_tpgmm.environments.suite.tasks import suite_task
from lerobot_policy_tpgmm.evaluation.benchmarks import benchmark
from tests.support.suite_expert import replay
from tpgmm_datasets import load_lerobot
from tpgmm_datasets.bottle.skill import HANDS
from tpgmm_torch import quaternions
from tpgmm_torch.exceptions import DependencyError

ROBOT = embodiment("viperx").robot
FPS = 25


def physics():
    model = pair_spec().compile()
    return model, mujoco.MjData(model)


def test_kinematics_are_those_of_the_physics():
    model, data = physics()
    assert tuple(model.joint(i).name for i in range(model.njnt)) == ROBOT.joint_names
    assert tuple(model.actuator(i).name for i in range(model.nu)) == ROBOT.joint_names
    for joints in np.random.default_rng(0).uniform(-1.5, 1.2, (5, 12)):
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        state = ROBOT.state(joints)
        for hand in HANDS:
            body = data.body(hand)
            assert state.position(hand).numpy() == pytest.approx(body.xpos)
            alike = state.orientation(hand) @ torch.from_numpy(body.xquat)
            assert abs(alike) == pytest.approx(1)


def test_the_arms_are_gym_alohas():
    """Ranges, masses, and how links follow one another, wherever the arm stands."""
    theirs = mujoco.MjModel.from_xml_path(
        str(constants.ASSETS_DIR / "bimanual_viperx_transfer_cube.xml")
    )
    model, data = physics()
    seen = mujoco.MjData(theirs)
    for column, name in enumerate(ROBOT.joint_names):
        side, _, joint = name.split("_", 2)
        there = theirs.joint(f"vx300s_{side}/{joint}")
        np.testing.assert_array_equal(model.joint(name).range, there.range)
        np.testing.assert_array_equal(
            (ROBOT.lower[column], ROBOT.upper[column]), np.float64(there.range)
        )
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
    model, _ = physics()
    for side, sign in zip(SIDES, (1, -1), strict=True):
        base = model.body(f"vx300s_{side}")
        np.testing.assert_allclose(base.pos, np.multiply(BASE, (1, sign, 1)))
        np.testing.assert_array_equal(base.quat, (1, 0, 0, 0))


def test_hands_wait_where_those_of_the_upper_body_do_and_level():
    upper, arms = embodiment("upper_body"), embodiment("viperx")
    before, now = (one.robot.state(one.posture) for one in (upper, arms))
    for hand in HANDS:
        assert float((before.position(hand) - now.position(hand)).norm()) < 0.003
        forward = quaternions.rotate(now.orientation(hand), -torch.eye(3).double()[2])
        assert forward.tolist() == pytest.approx((1, 0, 0), abs=0.01)


@pytest.mark.parametrize("name", SUITE)
def test_six_joints_do_what_experts_ask_for(name, monkeypatch):
    """Within 1 mm and half a degree, away from ends of joints, below their speed."""
    task = suite_task(name, "viperx")
    asked = []

    def spy(robot, starts, wanted, times, posture):
        joints = follow_hands(robot, starts, wanted, times, posture)
        asked.append((wanted, times, joints))
        return joints

    module = sys.modules[type(task).__mro__[1].__module__]
    follow_hands = module.follow_hands
    monkeypatch.setattr(module, "follow_hands", spy)
    task.demonstrations(10, seed=7, rate=FPS)
    [(wanted, times, joints)] = asked
    poses = [wanted(time.expand(10)) for time in times]
    state = ROBOT.state(joints)
    for index, hand in enumerate(HANDS):
        places = torch.stack([both[index].position for both in poses])
        turns = torch.stack([both[index].orientation for both in poses])
        away = (state.position(hand) - places).norm(dim=-1)
        turned = quaternions.product(turns, quaternions.conjugate(state.orientation(hand)))
        assert float(away.max()) < 1e-3
        assert float(quaternions.log(turned).norm(dim=-1).max()) < np.radians(0.5)
    room = torch.minimum(joints - ROBOT.lower, ROBOT.upper - joints)
    assert float(room.min()) > 0.1
    assert float(joints.diff(dim=0).abs().max()) * FPS < 0.99 * float(ROBOT.velocity.min())


@pytest.mark.parametrize("name", SUITE)
def test_experts_succeed(name):
    task, env = suite_task(name, "viperx"), SuiteEnv(name, "viperx", fps=FPS)
    for motion in task.demonstrations(2, seed=3, rate=FPS):
        info = replay(env, motion)
        assert info["is_success"], info
        assert info["clipped_rad"] == 0


def test_pushes_are_meant_for_strong_joints_of_both_arms():
    env, pushed = SuiteEnv("lid", "viperx", fps=FPS, pushes=True), set()
    for seed in range(40):
        env.reset(seed=seed)
        pushed.add(env.joint_names[env._start.pushed])
    strong = {f"{side}_arm_{joint}" for side in SIDES for joint in ARM_JOINTS[:3]}
    assert pushed == strong
    assert all(any(part in name for part in PUSHED) for name in strong)


def test_a_comparison_records_them_as_another_robot(tmp_path):
    task = benchmark("lid-viperx", rate=FPS)
    assert task.options == {"task": "lid", "robot": "viperx"} and task.robot is ROBOT
    assert task.record(tmp_path, 1, 1, seed=0) == [True]
    info = json.loads((tmp_path / "training" / "meta" / "info.json").read_text())
    assert info["robot_type"] == "viperx" and info["features"]["action"]["shape"] == [12]
    [shown] = load_lerobot(tmp_path / "training", robot=ROBOT)
    assert shown.joint_names == ROBOT.joint_names


def test_nothing_of_this_machine_is_in_the_description():
    text = pair_robot().config()["urdf"]
    assert "mesh" not in text and str(constants.ASSETS_DIR.parent) not in text


def test_without_gym_aloha_it_says_what_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_aloha.constants", None)
    for make in (pair_robot, pair_spec):
        with pytest.raises(DependencyError, match=r"viperx needs gym-aloha: pip install"):
            make()
