"""Peg in hole: the expert succeeds, and each criterion can fail."""

import numpy as np
import pytest

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.peg_in_hole import (
    BLOCK,
    CLEARANCE,
    DEPTH,
    HEIGHT,
    LENGTH,
    PEG,
    RADIUS,
)
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import missed, replay, start_of, tick
from tpgmm_torch.operators.text import format_operator

FPS = 25
TASK = suite_task("peg_in_hole")


@pytest.fixture(scope="module")
def motions():
    return TASK.demonstrations(3, seed=5, rate=FPS)


@pytest.fixture
def env():
    return SuiteEnv("peg_in_hole", fps=FPS)


def test_the_peg_is_seen_from_the_block_as_it_is_carried():
    *_, together, _ = map(format_operator, TASK.operators())
    assert together == "pose:peg@held:block"


def test_the_peg_has_to_stay_in_for_half_a_second(motions):
    end = tick(motions[0], "insert") - round(0.6 * FPS)
    env = SuiteEnv("peg_in_hole", fps=FPS, episode_length=end)
    info = replay(env, motions[0])
    assert info["depth_mm"] > 30 and missed(TASK, info) == {"inserted_s"}


def test_a_peg_beside_the_hole_jams(motions, env):
    block = start_of(motions[1])["block"]
    block[0] += 0.008
    end = motions[1].events["insert"]
    info = replay(env, motions[1], block=block, seconds=end)
    assert env._scene.held == {PEG, BLOCK} and not info["is_success"]
    figures = env.figures()
    assert figures["depth_mm"] < 10 and figures["inserted_s"] == 0
    assert figures["force_n"] > 50


@pytest.mark.parametrize(("turn", "wanted"), [(0.1, {"force_n"}), (0.8, {"force_n", "held"})])
def test_a_peg_that_is_levered_presses_and_is_lost_at_last(motions, env, turn, wanted):
    references = motions[2].joints.numpy()
    push = np.repeat(references[-1:], 2 * FPS, axis=0)
    turned = turn * np.minimum(np.arange(2 * FPS) / FPS, 1)
    push[:, env.joint_names.index("r_shoulder_yaw")] += turned
    info = replay(env, motions[2], np.concatenate((references, push)))
    assert wanted <= missed(TASK, info), info
    assert env._scene.taken == {PEG, BLOCK}


def test_the_hole_is_as_wide_and_deep_as_is_said(env):
    """Where the peg touches the block, as seen from it."""
    scene = env._scene

    def touched(x, y, depth):
        block = np.array((1.0, 1.0, 1.0, 1.0, 0, 0, 0))
        peg = block + np.array((x, y, HEIGHT + LENGTH - depth, 0, 0, 0, 0))
        scene.reset({"peg": peg, "block": block}, TASK.start_posture(env.np_random), 0.0)
        return scene.data.ncon > 0

    env.reset(seed=0)
    for side in (-1, 1):
        for axis in ((1, 0), (0, 1)):
            x, y = side * np.array(axis)
            inside, outside = 0.95 * CLEARANCE, 1.05 * CLEARANCE
            assert not touched(inside * x, inside * y, 0.04)
            assert touched(outside * x, outside * y, 0.04)
    assert not touched(0, 0, DEPTH - 2e-4) and touched(0, 0, DEPTH + 2e-4)
    # the mouth is wider
    assert not touched(2 * CLEARANCE, 0, 5e-4) and touched(RADIUS, 0, 5e-4)


def test_depth_counts_within_the_hole_alone(env):
    env.reset(seed=0)
    block = env._scene.pose("block")
    for aside, depth in ((0.0, 0.02), (0.0, -0.01), (0.02, 0.02)):
        turn = env._scene.data.body("block").xmat.reshape(3, 3)
        offset = turn @ (aside, 0.0, HEIGHT + LENGTH - depth)
        env._scene.put("peg", np.concatenate((block[:3] + offset, block[3:])))
        wanted = 1e3 * max(depth, 0.0) if aside == 0 else 0.0
        assert env.figures()["depth_mm"] == pytest.approx(wanted, abs=1e-6)
