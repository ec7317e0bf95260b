"""Wipe: the expert succeeds, each criterion can fail, and a sponge presses as is said."""

import math

import numpy as np
import pytest
import torch

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.tasks import suite_task
from lerobot_env_bimanual.suite.wipe import CELL, FIELD, FORCES, SPONGE
from tests.support.suite_expert import replay, start_of, tick

FPS = 25
TASK = suite_task("wipe")


@pytest.fixture(scope="module")
def motions():
    return TASK.demonstrations(2, seed=5, rate=FPS)


@pytest.fixture
def env():
    return SuiteEnv("wipe", fps=FPS)


def failing(info):
    """The criteria that are not met."""
    return {name for name, f in TASK.figures.items() if not f.low <= info[name] <= f.high}


def shift_board(board, *offset):
    """A board that is displaced in its own frame."""
    w, x, y, z = board[3:]
    normal = np.array((2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)))
    moved = board.copy()
    moved[:3] += offset[-1] * normal
    moved[:2] += offset[:2]
    return moved


def test_experts_wipe_with_an_even_force(motions, env):
    for seed, motion in enumerate(motions):
        info = replay(env, motion, seed=seed)
        assert info["is_success"] and not failing(info)
        assert info["coverage"] > 0.95 and 5 < info["force"] < 15


def test_half_of_the_strokes_wipe_half_of_it(motions, env):
    references = motions[0].joints.numpy()
    begin, end = (tick(motions[0], event) for event in ("press", "wipe"))
    info = replay(env, motions[0], references[: (begin + end) // 2])
    assert failing(info) == {"coverage"}
    assert 0.4 < info["coverage"] < 0.75


def test_above_the_board_nothing_is_wiped(motions, env):
    board = start_of(motions[0])["board"]
    info = replay(env, motions[0], board=shift_board(board, 0, 0, -0.008))
    assert failing(info) == {"coverage", "force"}
    assert info["coverage"] == info["force"] == 0


def test_who_presses_deep_presses_hard(motions, env):
    """Boards that are higher than they seemed."""
    board = start_of(motions[1])["board"]
    usual = replay(env, motions[1])["force"]
    info = replay(env, motions[1], board=shift_board(board, 0, 0, 0.003))
    assert 1.3 * usual < info["force"] < 2.2 * usual
    assert "force" in failing(replay(env, motions[1], board=shift_board(board, 0, 0, 0.015)))


def test_a_pause_counts_if_it_goes_on(motions, env):
    references = motions[0].joints.numpy()
    begin, end, lifted = (tick(motions[0], event) for event in ("press", "wipe", "lift"))
    middle = (begin + end) // 2
    up = references[end:lifted]
    # lift as in the end, from the middle, and come back
    away = references[middle] + up - up[0]
    motion = (references[:middle], away, away[::-1], references[middle:])
    info = replay(
        SuiteEnv("wipe", fps=FPS, episode_length=600), motions[0], np.concatenate(motion)
    )
    assert failing(info) == {"off_s"} and info["off_s"] > 0.5
    # what follows the last contact is none
    assert replay(env, motions[0])["off_s"] < 0.1


def test_the_left_palm_has_to_stay_at_the_edge(motions, env):
    references = motions[0].joints.numpy().copy()
    left = [i for i, name in enumerate(env.joint_names) if name.startswith("l_")]
    references[:, left] = references[tick(motions[0], "reach"), left]
    info = replay(env, motions[0], references)
    assert "edge_mm" in failing(info) and info["edge_mm"] > 30


def on_board(env, position, lean=0.0):
    """The judge's wiped cells after the sponge was somewhere in the board's frame."""
    scene, judge = env._scene, TASK.judge()
    board, sponge = scene.data.body("board"), scene.data.geom("sponge")
    turn = board.xmat.reshape(3, 3)
    # its y points into the board; lean is about its x
    cos, sin = math.cos(lean), math.sin(lean)
    own = np.array(((1, 0, 0), (0, 0, 1), (0, -1, 0))) @ np.array(
        ((1, 0, 0), (0, cos, -sin), (0, sin, cos))
    )
    sponge.xpos[:] = board.xpos + turn @ position
    sponge.xmat[:] = (turn @ own).ravel()
    judge._wipe(scene)
    return judge.wiped


def test_cells_are_wiped_where_the_sponge_is_pressed_in(env):
    env.reset(seed=0)
    cells = round(4 * SPONGE[0] * SPONGE[2] / CELL**2)
    pressed = on_board(env, (0.0, 0.0, SPONGE[1] - 0.003))
    assert pressed.shape == tuple(round(2 * half / CELL) for half in FIELD)
    assert abs(pressed.sum() - cells) <= 11  # a row and a column
    assert not on_board(env, (0.0, 0.0, SPONGE[1] + 0.001)).any()
    leaning = on_board(env, (0.0, 0.0, SPONGE[1] - 0.001), lean=math.radians(10))
    assert 0 < leaning.sum() < 0.7 * pressed.sum()
    corner = on_board(env, (FIELD[0], FIELD[1], SPONGE[1] - 0.003))
    assert corner[-1, -1] and not corner[0].any() and not corner[:, 0].any()


@pytest.mark.parametrize(("force", "wiped"), [(1.0, False), (10.0, True), (50.0, False)])
def test_too_little_and_too_much_force_wipe_nothing(env, monkeypatch, force, wiped):
    env.reset(seed=0)
    scene, judge = env._scene, TASK.judge()
    on_board(env, (0.0, 0.0, SPONGE[1] - 0.003))
    monkeypatch.setattr(scene, "touch", lambda *pair: force)
    judge.note(scene, 0.01)
    assert judge.wiped.any() == wiped
    figures = judge.figures(scene)
    assert figures["force"] == (force if force >= FORCES[0] else 0)


def test_boards_are_drawn_where_they_are_usual():
    rng = np.random.default_rng(0)
    leans, yaws = [], []
    for _ in range(100):
        board = TASK.draw(rng)["board"]
        w, x, y, z = board[3:]
        assert TASK.usual(board)
        assert not TASK.usual(board + np.array((0.1, 0, 0, 0, 0, 0, 0)))
        assert not TASK.usual(np.array((*board[:3], -z, y, -x, w)))  # half a turn further
        leans.append(math.degrees(math.acos(1 - 2 * (x * x + y * y))))
        yaws.append(math.degrees(2 * math.atan2(z, w)))
    assert 10 < max(leans) < 22 and -21 < min(yaws) < -10 and 10 < max(yaws) < 21


def test_a_seed_stands_for_an_episode(env):
    first, second = (env.reset(seed=3)[0]["environment_state"] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    motions = [TASK.demonstrations(1, seed=4, rate=5.0)[0].joints for _ in range(2)]
    assert torch.equal(*motions)
