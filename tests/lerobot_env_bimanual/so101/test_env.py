"""Cup on saucer: units, offsets, registration, and an expert that succeeds."""

import gymnasium as gym
import numpy as np
import pytest
from lerobot.envs import EnvConfig

import lerobot_env_bimanual  # noqa: F401
from lerobot_env_bimanual.so101.env import BiSo101Env
from lerobot_env_bimanual.so101.expert import teleoperate
from lerobot_env_bimanual.so101.scene import LEFT, RIGHT
from tpgmm_torch.exceptions import DataError, UnknownNameError


@pytest.fixture(scope="module")
def env():
    return BiSo101Env()


def shown(env, seed):
    """The figures of a demonstration, and what hands held meanwhile."""
    env.reset(seed=seed)
    held = [set(env.scene.held)]
    for action in teleoperate(env, np.random.default_rng(seed)):
        *_, info = env.step(action)
        if held[-1] != env.scene.held:
            held.append(set(env.scene.held))
    while "place_mm" not in info:
        *_, info = env.step(action)
    return info, held


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_the_expert_puts_the_cup_on_the_saucer(env, seed):
    info, held = shown(env, seed)
    assert info["is_success"]
    assert info["place_mm"] < 5
    assert held == [{LEFT}, {LEFT, RIGHT}, {LEFT}]


def test_a_robot_that_stands_still_does_not_succeed(env):
    env.reset(seed=3)
    still, over = env.in_stored_units(np.array(env.scene.data.ctrl)), False
    while not over:
        *_, over, info = env.step(still)
    assert not info["is_success"]
    assert info["standing"] == 0
    assert env.scene.held == {LEFT}


def test_encoders_miss_the_offset_of_each_joint_but_not_of_the_grippers(env):
    observation, _ = env.reset(seed=4)
    stored = np.deg2rad(observation["agent_pos"])
    arms = [i for i in range(12) if i not in (5, 11)]
    off = env.scene.joints - stored
    np.testing.assert_allclose(off[arms], env.offsets[arms], atol=1e-9)
    assert observation["agent_pos"][11] == pytest.approx(40, abs=2)
    assert env.offsets[[5, 11]].tolist() == [0, 0]
    assert 0.5 < np.rad2deg(np.std(env.offsets[arms])) < 1.5


def test_offsets_belong_to_the_arms_and_not_to_the_episode(env):
    assert (BiSo101Env(specimen=0).offsets == env.offsets).all()
    assert (BiSo101Env(specimen=1).offsets != env.offsets).any()


def test_episodes_of_a_seed_are_the_same_and_of_others_differ(env):
    first, again, other = (env.reset(seed=seed)[0] for seed in (5, 5, 6))
    for key, value in first.items():
        np.testing.assert_array_equal(value, again[key])
    assert (first["environment_state"] != other["environment_state"]).any()
    assert env.observation_space.contains(first)


def test_a_cup_that_is_given_stands_there(env):
    cup = [0.28, -0.1, 0, 1, 0, 0, 0]
    observation, _ = env.reset(seed=7, options={"cup": cup})
    np.testing.assert_allclose(observation["environment_state"][:7], cup, atol=2e-3)


def test_lerobot_and_gymnasium_know_it():
    config = EnvConfig.get_choice_class("bi_so101")(specimen=1)
    assert config.features["agent_pos"].shape == (12,)
    assert config.features["environment_state"].shape == (14,)
    made = gym.make(config.gym_id, disable_env_checker=True, **config.gym_kwargs)
    assert (made.unwrapped.offsets == BiSo101Env(specimen=1).offsets).all()
    assert made.unwrapped.task_description == "put the cup on the saucer"


def test_what_does_not_exist_is_refused(env):
    with pytest.raises(UnknownNameError, match="cup_on_saucer"):
        BiSo101Env("saucer_on_cup")
    env.reset(seed=0)
    with pytest.raises(DataError, match="right_gripper"):
        env.step(np.full(12, np.nan))
