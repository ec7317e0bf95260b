"""What holds for every robot of the suite: it reaches what is asked for, and succeeds."""

import json
import sys
from pathlib import Path

import mujoco
import numpy as np
import pytest
import torch

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.names import SUITE, UPPER_BODY
from lerobot_env_bimanual.suite.robots.embodiments import embodiment
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import TRIED, replay
from tpgmm_datasets import load_lerobot
from tpgmm_datasets.bottle.skill import HANDS, pose_error
from tpgmm_evaluation.benchmarks import benchmark
from tpgmm_torch import quaternions

pytestmark = pytest.mark.slow

FPS = 25
#: Robots that others describe.
OTHERS = [name for name in TRIED if name != UPPER_BODY]
#: Which of their joints are pushed.
STRONG = {
    "viperx": ("{}_arm_{}", ("waist", "shoulder", "elbow")),
    "g1": ("{}_{}_joint", ("shoulder_pitch", "shoulder_yaw", "elbow")),
}
on_others = pytest.mark.parametrize("name", OTHERS)


@on_others
def test_kinematics_are_those_of_the_physics(name):
    robot, model = embodiment(name).robot, embodiment(name).spec().compile()
    data = mujoco.MjData(model)
    assert tuple(model.joint(i).name for i in range(model.njnt)) == robot.joint_names
    assert tuple(model.actuator(i).name for i in range(model.nu)) == robot.joint_names
    limits = torch.stack((robot.lower, robot.upper), 1)
    np.testing.assert_allclose(model.jnt_range, limits, rtol=1e-12)
    for joints in np.random.default_rng(0).uniform(-1.5, 1.2, (5, robot.n_joints)):
        data.qpos[:] = joints
        mujoco.mj_kinematics(model, data)
        state = robot.state(joints)
        for hand in HANDS:
            body = data.body(hand)
            assert state.position(hand).numpy() == pytest.approx(body.xpos)
            alike = state.orientation(hand) @ torch.from_numpy(body.xquat)
            assert abs(alike) == pytest.approx(1)


@on_others
def test_hands_wait_where_those_of_the_upper_body_do_and_level_with_six_joints(name):
    upper, other = embodiment(UPPER_BODY), embodiment(name)
    before, now = (one.robot.state(one.posture) for one in (upper, other))
    for hand in HANDS:
        assert float((before.position(hand) - now.position(hand)).norm()) < 0.003
        turn = now.orientation(hand)
        if name == "viperx":
            forward = quaternions.rotate(turn, -torch.eye(3).double()[2])
            assert forward.tolist() == pytest.approx((1, 0, 0), abs=0.01)
        else:
            assert abs(float(before.orientation(hand) @ turn)) > np.cos(0.01 / 2)
    left, right = (now.position(hand) for hand in HANDS)
    np.testing.assert_allclose(left * torch.tensor((1.0, -1.0, 1.0)), right, atol=2e-5)


@on_others
@pytest.mark.parametrize("task_name", SUITE)
def test_joints_do_what_experts_ask_for(name, task_name, monkeypatch):
    """Within 1 mm and half a degree, away from ends of joints, below their speed."""
    task, robot = suite_task(task_name, name), embodiment(name).robot
    asked = []

    def spy(robot, starts, wanted, dt, posture):
        joints = follow_hands(robot, starts, wanted, dt, posture)
        asked.append((wanted, joints))
        return joints

    module = sys.modules[type(task).__mro__[1].__module__]
    follow_hands = module.follow_hands
    monkeypatch.setattr(module, "follow_hands", spy)
    task.demonstrations(10, seed=7, rate=FPS)
    [(wanted, joints)] = asked
    state = robot.state(joints)
    for hand, target in zip(HANDS, wanted, strict=True):
        away, turned = pose_error(state.pose(hand), target)
        assert float(away.max()) < 1e-3
        assert float(turned.max()) < np.radians(0.5)
    room = torch.minimum(joints - robot.lower, robot.upper - joints)
    assert float(room.min()) > 0.1
    assert float(joints.diff(dim=0).abs().max()) * FPS < 0.99 * float(robot.velocity.min())


@on_others
@pytest.mark.parametrize("task_name", SUITE)
def test_experts_succeed(name, task_name):
    task, env = suite_task(task_name, name), SuiteEnv(task_name, name, fps=FPS)
    for motion in task.demonstrations(2, seed=3, rate=FPS):
        info = replay(env, motion)
        assert info["is_success"], info
        assert info["clipped_rad"] == 0


@on_others
def test_pushes_are_meant_for_strong_joints_of_both_arms(name):
    env, pushed = SuiteEnv("lid", name, fps=FPS, pushes=True), set()
    for seed in range(40):
        env.reset(seed=seed)
        pushed.add(env.joint_names[env._start.pushed])
    text, joints = STRONG[name]
    assert pushed == {text.format(side, one) for side in ("left", "right") for one in joints}


@on_others
def test_a_comparison_records_them_as_another_robot(name, tmp_path):
    task, robot = benchmark(f"lid-{name}", rate=FPS), embodiment(name).robot
    assert task.options == {"task": "lid", "robot": name} and task.robot is robot
    assert task.record(tmp_path, 1, 1, seed=0) == [True]
    info = json.loads((tmp_path / "training" / "meta" / "info.json").read_text())
    assert info["robot_type"] == name
    assert info["features"]["action"]["shape"] == [robot.n_joints]
    [shown] = load_lerobot(tmp_path / "training", robot=robot)
    assert shown.joint_names == robot.joint_names


@on_others
def test_nothing_of_this_machine_is_in_the_description(name):
    text = embodiment(name).robot.config()["urdf"]
    assert "mesh" not in text and str(Path(sys.prefix)) not in text
