"""The scripted expert of gym-aloha's tasks, what it records, and TP-GMM from a few of those."""

import numpy as np
import pytest
import torch

from lerobot_policy_tpgmm.environments.aloha.demonstrations import record_aloha
from lerobot_policy_tpgmm.environments.aloha.expert import AlohaExpert
from lerobot_policy_tpgmm.environments.aloha.robot import (
    GRIPPERS,
    JOINTS,
    OBJECTS,
    aloha_operators,
    aloha_robot,
)
from lerobot_policy_tpgmm.environments.aloha.state import AlohaStateEnv
from tpgmm_datasets import DatasetError, describe_lerobot, load_lerobot
from tpgmm_torch import Frame, Situation, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, TPGMMError

HOME = [0, -0.96, 1.16, 0, -0.3, 0, 0.1] * 2


def follow(env, seed, references):
    """The rewards of an episode."""
    env.reset(seed=seed)
    return [env.step(reference)[1] for reference in references]


@pytest.mark.parametrize(("task", "fps"), [("transfer_cube", 50), ("insertion", 25)])
def test_expert_solves_the_task(task, fps):
    env, expert = AlohaStateEnv(task, fps=fps, stop_at_success=False), AlohaExpert(task, fps)
    seeds = range(100, 106)
    starts = [env.reset(seed=seed)[0] for seed in seeds]
    plans = expert.plan(*(np.stack([s[key] for s in starts]) for key in starts[0]))
    assert plans.shape == (6, round(7.5 * fps), 14)
    assert env.action_space.contains(plans.min((0, 1)).astype(np.float32))
    assert env.action_space.contains(plans.max((0, 1)).astype(np.float32))
    for seed, plan in zip(seeds, plans, strict=True):
        rewards = follow(env, seed, plan)
        assert max(rewards) == 4
        assert 2 in rewards[: 4 * fps]  # lifted before it was handed over
        # the cube stays with the left gripper when the right one has left
        assert np.mean(np.array(rewards[-fps // 4 :]) == 4) > 0.5


def test_expert_plans_alike_for_one_situation_and_for_many():
    expert = AlohaExpert()
    poses = np.array([[0.1, 0.5, 0.05, np.cos(a), 0, 0, np.sin(a)] for a in (-0.3, 0.0, 0.3)])
    together = expert.plan(HOME, poses)
    assert np.allclose(together[2], expert.plan(HOME, poses[2]), atol=1e-8)
    start_gap = np.abs(together[:, 0] - HOME).max()
    assert start_gap < 1e-3
    assert np.abs(np.diff(together, axis=1)).max() < 0.1  # no jumps


def test_expert_turns_with_the_cube_and_not_further_than_it_must():
    expert = AlohaExpert()
    yaw = np.radians([20, 110, -70])
    poses = [[0.1, 0.5, 0.05, np.cos(a / 2), 0, 0, np.sin(a / 2)] for a in yaw]
    plans = expert.plan(HOME, np.array(poses))
    assert np.allclose(plans, plans[:1], atol=1e-8)  # a cube looks the same after 90 deg
    state = expert.robot.state(torch.from_numpy(plans[0, 100]))
    assert state.position("right_gripper").numpy() == pytest.approx([0.1, 0.5, 0.023], abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((HOME, [1.5, 0.5, 0.02, 1, 0, 0, 0]), "right gripper cannot"),
        ((HOME, [0.1, 0.5, 0.02]), "7 values"),
        ((HOME[:7], [0.1, 0.5, 0.02, 1, 0, 0, 0]), "14 joints"),
        ((HOME, [0.1, 0.5, np.nan, 1, 0, 0, 0]), "NaN"),
    ],
)
def test_expert_refuses_what_it_cannot_do(arguments, message):
    with pytest.raises(DataError, match=message):
        AlohaExpert().plan(*arguments)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    return record_aloha(tmp_path_factory.mktemp("aloha") / "set", 6, seed=20)


def test_recording_holds_what_was_measured_and_commanded(recorded):
    found = describe_lerobot(recorded)
    assert found.problems == ()
    assert found.fps == 50
    measured = load_lerobot(recorded, robot=aloha_robot())
    references = load_lerobot(recorded, robot=aloha_robot(), joints="action")
    env = AlohaStateEnv()
    for seed, (state, action) in enumerate(zip(measured, references, strict=True), start=20):
        start = env.reset(seed=seed)[0]
        pose = torch.cat((state.frame("cube").position, state.frame("cube").orientation))
        assert pose.numpy() == pytest.approx(start["environment_state"], abs=1e-6)
        plan = AlohaExpert().plan(*start.values())
        assert action.joints.numpy() == pytest.approx(plan, abs=1e-6)
        assert state.joints[0].numpy() == pytest.approx(start["agent_pos"], abs=1e-6)
        after = env.step(plan[0])[0]["agent_pos"]
        assert state.joints[1].numpy() == pytest.approx(after, abs=1e-6)
        held = state.joints[180, [JOINTS.index(name) for name in GRIPPERS]]
        assert held[1] == pytest.approx(0.6, abs=0.05)  # the cube is between the fingers
    with pytest.raises(DatasetError, match="exists"):
        record_aloha(recorded, 1)


def test_a_failed_demonstration_is_not_recorded(tmp_path):
    with pytest.raises(DataError, match="seed 20"):  # no time to lift the cube
        record_aloha(tmp_path / "set", 1, seed=20, duration=3.0)
    assert not (tmp_path / "set").exists()


def test_tpgmm_learns_to_hand_the_cube_over(recorded):
    robot = aloha_robot()
    demonstrations = load_lerobot(recorded, robot=robot, joints="action")
    model = TaskParameterizedGMM(10, aloha_operators("transfer_cube"), robot, random_state=0)
    model.fit(demonstrations)
    env = AlohaStateEnv()
    situations = []
    for seed in range(1000, 1004):
        start, _ = env.reset(seed=seed)
        pose = start["environment_state"]
        frames = {"cube": Frame(pose[:3], pose[3:])}
        situations.append(Situation(start["agent_pos"], frames))
    solved = [
        4 in follow(env, seed, trajectory.joints.numpy())
        for seed, trajectory in enumerate(model.predict(situations, candidates=False), 1000)
    ]
    assert sum(solved) >= 3


@pytest.mark.parametrize("task", OBJECTS)
def test_operators_fit_the_robot_and_the_objects(task):
    robot, frames = aloha_robot(), {name: Frame(torch.zeros(3)) for name in OBJECTS[task]}
    for orientation in (True, False):
        for operator in aloha_operators(task, orientation):
            operator.check(robot, frames)
    with pytest.raises(TPGMMError, match="transfer_cube"):
        aloha_operators("juggling")
