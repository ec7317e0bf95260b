"""The scripted expert of gym-aloha's tasks, what it records, and TP-GMM from a few of those."""

import numpy as np
import pytest
import torch

from lerobot_env_bimanual.aloha.expert import AlohaExpert
from lerobot_env_bimanual.aloha.state import AlohaStateEnv
from tpgmm_torch.exceptions import DataError

HOME = [0, -0.96, 1.16, 0, -0.3, 0, 0.1] * 2


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
        env.reset(seed=seed)
        rewards = [env.step(reference)[1] for reference in plan]
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
