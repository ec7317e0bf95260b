"""Meta-World's tasks and its hand as a robot: what needs no Meta-World."""

import numpy as np
import pytest
import torch

from lerobot_env_bimanual import MetaworldStateConfig
from lerobot_env_bimanual.metaworld.hand import (
    ACTION_SCALE,
    FPS,
    FRAMES,
    JOINTS,
    displacement,
    effort,
    metaworld_operators,
    metaworld_robot,
    opening,
)
from lerobot_env_bimanual.metaworld.tasks import (
    DIFFICULTIES,
    TASKS,
    TUNED,
    difficulty,
)
from tpgmm_torch.exceptions import UnknownNameError


def test_tasks_are_fifty_in_the_published_groups():
    assert {group: len(names) for group, names in DIFFICULTIES.items()} == {
        "easy": 28,
        "medium": 11,
        "hard": 6,
        "very hard": 5,
    }
    assert len(set(TASKS)) == 50
    assert list(TASKS) == sorted(TASKS)
    assert TASKS[0::2] == TUNED
    assert difficulty("push-v3") == "hard"


def test_an_unknown_task_is_refused_where_it_is_named():
    with pytest.raises(UnknownNameError, match="reach-v2"):
        MetaworldStateConfig(task="reach-v2")


def test_the_hand_is_where_its_joints_say():
    robot = metaworld_robot()
    assert robot.joint_names == JOINTS
    state = robot.state([0.1, 0.6, 0.2, 1.0])
    assert state.position("hand").tolist() == pytest.approx([0.1, 0.6, 0.2])
    assert robot.lengths == (0, 1, 2)
    assert robot.velocity[:3].tolist() == pytest.approx([FPS * ACTION_SCALE] * 3)


def test_operators_see_the_hand_from_the_frames_that_are_asked_for():
    seen = [
        name for operator in metaworld_operators(FRAMES[:2]) for name in operator.references()
    ]
    assert seen == ["object_1", "object_2"]


def test_displacements_reach_a_reference_in_the_fewest_steps():
    generator = np.random.default_rng(0)
    for reference in generator.uniform(-0.1, 0.1, (50, 3)):
        target, steps = np.zeros(3), 0
        while np.abs(reference - target).max() > 1e-12:
            action = displacement(reference, target)
            assert np.abs(action).max() <= 1
            target, steps = target + ACTION_SCALE * action, steps + 1
        assert steps == np.ceil(np.abs(reference).max() / ACTION_SCALE - 1e-9)


def test_effort_and_opening_are_each_other_s_inverse_and_have_bounds():
    for value in torch.linspace(0, 1, 11).tolist():
        assert opening(effort(value)) == pytest.approx(value)
    assert (effort(1.0), effort(0.0)) == (-1.0, 1.0)
    assert (effort(3.0), opening(3.0)) == (-1.0, 0.0)


def test_the_configuration_says_what_the_environment_sees():
    config = MetaworldStateConfig(task="push-v3")
    assert config.features["agent_pos"].shape == (4,)
    assert config.features["environment_state"].shape == (21,)
    assert config.gym_kwargs["task"] == "push-v3"
    assert config.gym_id == "lerobot_env_bimanual/MetaworldState-v0"
