"""Meta-World's tasks and its hand as a robot: what needs no Meta-World."""

import numpy as np
import pytest
import torch

from lerobot_env_bimanual import MetaworldStateConfig
from lerobot_env_bimanual.metaworld import hand, tasks
from tpgmm_torch.exceptions import UnknownNameError


def test_tasks_are_fifty_in_the_published_groups():
    sizes = {group: len(names) for group, names in tasks.DIFFICULTIES.items()}
    assert sizes == {"easy": 28, "medium": 11, "hard": 6, "very hard": 5}
    assert len(set(tasks.TASKS)) == 50
    assert list(tasks.TASKS) == sorted(tasks.TASKS)
    assert tasks.TASKS[0::2] == tasks.TUNED
    assert tasks.difficulty("push-v3") == "hard"


def test_an_unknown_task_is_refused_where_it_is_named():
    with pytest.raises(UnknownNameError, match="reach-v2"):
        MetaworldStateConfig(task="reach-v2")


def test_the_hand_is_where_its_joints_say():
    robot = hand.metaworld_robot()
    assert robot.joint_names == hand.JOINTS
    state = robot.state([0.1, 0.6, 0.2, 1.0])
    assert state.position("hand").tolist() == pytest.approx([0.1, 0.6, 0.2])
    assert robot.lengths == (0, 1, 2)
    assert robot.velocity[:3].tolist() == pytest.approx([hand.FPS * hand.ACTION_SCALE] * 3)


def test_operators_see_the_hand_from_the_frames_that_are_asked_for():
    seen = [
        name
        for operator in hand.metaworld_operators(hand.FRAMES[:2])
        for name in operator.references()
    ]
    assert seen == ["object_1", "object_2"]


def test_displacements_reach_a_reference_in_the_fewest_steps():
    generator = np.random.default_rng(0)
    for reference in generator.uniform(-0.1, 0.1, (50, 3)):
        target, steps = np.zeros(3), 0
        while np.abs(reference - target).max() > 1e-12:
            action = hand.displacement(reference, target)
            assert np.abs(action).max() <= 1
            target, steps = target + hand.ACTION_SCALE * action, steps + 1
        assert steps == np.ceil(np.abs(reference).max() / hand.ACTION_SCALE - 1e-9)


def test_effort_and_opening_are_each_other_s_inverse_and_have_bounds():
    for value in torch.linspace(0, 1, 11).tolist():
        assert hand.opening(hand.effort(value)) == pytest.approx(value)
    assert (hand.effort(1.0), hand.effort(0.0)) == (-1.0, 1.0)
    assert (hand.effort(3.0), hand.opening(3.0)) == (-1.0, 0.0)


def test_the_configuration_says_what_the_environment_sees():
    config = MetaworldStateConfig(task="push-v3")
    assert config.features["agent_pos"].shape == (4,)
    assert config.features["environment_state"].shape == (21,)
    assert config.gym_kwargs["task"] == "push-v3"
    assert config.gym_id == "lerobot_env_bimanual/MetaworldState-v0"
