"""A baton that is picked, placed and left, and grasps that are spoilt."""

import pytest

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import replay

TASK = suite_task("pick_place")
RATE = 25


@pytest.fixture(scope="module")
def motion():
    return TASK.demonstrations(1, seed=3, rate=RATE)[0]


def test_the_expert_puts_the_baton_on_the_stand_and_goes_home(motion):
    info = replay(SuiteEnv("pick_place", fps=RATE), motion)
    assert info["is_success"] and info["place_mm"] < 4 and info["home_mm"] < 4


@pytest.mark.parametrize("condition", ["slips", "knocked"])
def test_a_spoilt_grasp_leaves_the_baton_and_the_hand_may_take_it_again(motion, condition):
    env = SuiteEnv("pick_place", fps=RATE, condition=condition)
    info = replay(env, motion)
    assert not info["is_success"] and not info["put"] and info["place_mm"] > 50
    begun = motion.joints[0].numpy()
    replay(env, motion, seconds=motion.events["lift"])
    [hold] = TASK.holds
    assert not env._scene.held
    for _ in range(2 * RATE):
        env.step(begun)
    stands = env._scene.pose("baton")
    again = TASK.nominal({"baton": stands, "stand": env._scene.pose("stand")}, begun, RATE)
    for reference in again.joints.numpy()[: int(RATE * TASK.ends()["lift"])]:
        env.step(reference)
    assert env._scene.held == {hold}
