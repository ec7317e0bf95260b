"""Teleoperation, with keys that a script presses."""

import runpy
from pathlib import Path

import numpy as np
import pytest
import torch

from lerobot_policy_tpgmm.environments.bottle.shaking import BottleShakingEnv
from tests.support.worlds import upper_body
from tpgmm_datasets import load_lerobot, save_lerobot
from tpgmm_torch import Canonical, RelativePosition, Situation, TaskParameterizedGMM
from tpgmm_torch.alignment import DynamicTimeWarping

EXAMPLE = runpy.run_path(str(Path(__file__).parents[2] / "examples" / "teleoperate.py"))
START = np.array(BottleShakingEnv(fps=25).reset(seed=0)[0]["agent_pos"])


def hands(joints) -> np.ndarray:
    """Positions of both hands, (2, 3)."""
    state = upper_body().state(torch.as_tensor(joints))
    return np.stack([state.position(hand).numpy() for hand in EXAMPLE["HANDS"]])


@pytest.mark.parametrize(
    ("key", "left", "right"),
    [
        ("w", (1, 0, 0), (1, 0, 0)),
        ("d", (0, -1, 0), (0, -1, 0)),
        ("r", (0, 0, 1), (0, 0, 1)),
        ("e", (0, -1, 0), (0, 1, 0)),
        ("q", (0, 1, 0), (0, -1, 0)),
    ],
)
def test_a_key_moves_the_hands_where_it_says(key, left, right):
    leading = EXAMPLE["Teleoperation"](upper_body(), START, 0.02)
    for _ in range(10):
        joints = leading.step({key})
    moved = (hands(joints) - hands(START)) / 0.2
    np.testing.assert_allclose(moved, EXAMPLE["SPEED"] * np.array([left, right]), atol=0.02)


def test_without_keys_and_with_others_it_stands():
    leading = EXAMPLE["Teleoperation"](upper_body(), START)
    np.testing.assert_array_equal(leading.step(set()), START)
    np.testing.assert_allclose(leading.step({"x", "shift"}), START, atol=1e-12)


def test_references_keep_limits_whatever_is_pressed():
    robot = upper_body()
    leading = EXAMPLE["Teleoperation"](robot, START, 0.2)
    last = START
    for _ in range(60):
        joints = leading.step({"w", "r", "q", "i"})
        assert (joints >= robot.lower.numpy()).all() and (joints <= robot.upper.numpy()).all()
        assert (np.abs(joints - last) <= robot.velocity.numpy() * 0.2 + 1e-9).all()
        last = joints


def test_episodes_become_a_data_set_that_is_learned(tmp_path):
    env = BottleShakingEnv(fps=25)
    script = [{"w"}] * 20 + [{"w", "r"}] * 15 + [{"e"}] * 10 + [None]
    shown = [EXAMPLE["episode"](env, iter(script).__next__, seed) for seed in range(4)]
    assert {len(one) for one in shown} == {46}
    starts = torch.stack([one.frames["bottle"].position for one in shown])
    assert bool((starts.std(0) > 1e-3).all())
    save_lerobot(shown, tmp_path / "set", fps=25, task="reach", robot_type="upper_body")
    read = load_lerobot(tmp_path / "set", robot=upper_body())
    aligned = DynamicTimeWarping(robot=upper_body()).fit_transform(read)
    operators = [RelativePosition("l_hand", "bottle"), Canonical()]
    model = TaskParameterizedGMM(6, operators, upper_body()).fit(aligned)
    [trajectory] = model.predict([Situation(shown[0].joints[0], shown[0].frames)])
    np.testing.assert_allclose(
        hands(trajectory.joints[-1]), hands(shown[0].joints[-1]), atol=0.05
    )
