"""A baton that changes hands, and what can go wrong with it."""

import numpy as np
import pytest

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import replay, start_of, tick
from tpgmm_torch import Demonstration

TASK = suite_task("handover")
RATE = 50
LEFT, RIGHT = slice(3, 10), slice(10, 17)


@pytest.fixture(scope="module")
def examples() -> list[Demonstration]:
    return TASK.demonstrations(3, seed=3, rate=float(RATE))


@pytest.fixture(scope="module")
def env() -> SuiteEnv:
    return SuiteEnv("handover", fps=RATE, noise=0.5)


@pytest.mark.parametrize("index", range(3))
def test_the_expert_passes_the_baton_and_puts_it_on_the_stand(env, examples, index):
    info = replay(env, examples[index])
    assert info["is_success"], info
    assert info["place_mm"] < 4 and info["lean_deg"] < 1
    left, right = TASK.holds
    assert env._scene.taken == {left, right} and not env._scene.held


def test_the_left_hand_opens_when_the_right_one_holds(env, examples):
    motion = examples[0]
    left, right = TASK.holds
    replay(env, motion, seconds=motion.events["bring"])
    assert env._scene.held == {left}
    replay(env, motion, seconds=motion.events["pass"])
    assert env._scene.held == {right}


def test_a_right_hand_that_stays_away_takes_nothing(env, examples):
    joints = examples[0].joints.numpy().copy()
    joints[:, RIGHT] = joints[0, RIGHT]
    info = replay(env, examples[0], joints)
    assert not info["passed"] and not info["put"] and not info["is_success"]


def test_a_left_hand_that_misses_the_baton_brings_nothing(env, examples):
    joints = examples[0].joints.numpy().copy()
    joints[:, LEFT] = joints[0, LEFT]
    info = replay(env, examples[0], joints)
    assert not info["passed"] and info["place_mm"] > 50 and not info["is_success"]


def test_a_baton_that_is_not_lowered_is_not_put_down(env, examples):
    motion = examples[0]
    info = replay(env, motion, motion.joints.numpy()[: tick(motion, "carry")])
    assert info["passed"] and not info["put"] and not info["is_success"]


def test_it_has_to_be_put_on_the_stand(env, examples):
    aside = start_of(examples[0])["stand"]
    aside[0] += 0.02
    info = replay(env, examples[0], stand=aside)
    assert info["put"] and info["place_mm"] == pytest.approx(20, abs=4)
    assert not info["is_success"]


def test_objects_are_where_the_task_is_meant_for():
    rng = np.random.default_rng(0)
    for _ in range(50):
        drawn = TASK.draw(rng)
        assert TASK.usual(drawn["baton"])
        assert drawn["stand"][1] < 0 < drawn["baton"][1]
        assert drawn["stand"][2] == pytest.approx(drawn["baton"][2] - TASK.foot)
    assert not TASK.usual(drawn["stand"])
