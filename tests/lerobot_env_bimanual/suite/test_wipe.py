"""Wipe: the expert succeeds, each criterion can fail, and a sponge presses as is said."""

import math

import numpy as np
import pytest

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.tasks import suite_task
from lerobot_env_bimanual.suite.wipe import CELL, FIELD, FORCES, SPONGE
from tests.support.suite_expert import replay, start_of

FPS = 25
TASK = suite_task("wipe")


@pytest.fixture
def env():
    return SuiteEnv("wipe", fps=FPS)


def test_who_presses_deep_presses_hard_and_what_follows_the_last_contact_is_no_pause(env):
    """Boards that are higher than they seemed."""
    motion = TASK.demonstrations(2, seed=5, rate=FPS)[1]
    usual = replay(env, motion)
    board = start_of(motion)["board"].copy()
    w, x, y, z = board[3:]
    normal = (2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y))
    board[:3] += 0.003 * np.array(normal)
    info = replay(env, motion, board=board)
    assert 1.3 * usual["force"] < info["force"] < 2.2 * usual["force"]
    assert usual["off_s"] < 0.1


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
