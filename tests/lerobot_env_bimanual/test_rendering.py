"""Pictures of an environment, where a machine can draw and where it cannot."""

import itertools
import subprocess

import numpy as np
import pytest

from lerobot_env_bimanual import rendering
from lerobot_env_bimanual.bottle.shaking import BottleShakingEnv
from lerobot_env_bimanual.rendering import offscreen


@pytest.fixture
def fresh(monkeypatch):
    """Let the platform be looked for again, and again afterwards."""
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    offscreen.cache_clear()
    yield monkeypatch
    offscreen.cache_clear()


def tried(monkeypatch, *working):
    """Let only some platforms work; the list tells which were tried."""
    names = []

    def run(command, **options):
        platform = next(p for p in ("egl", "osmesa", "glfw") if f"mujoco.{p} " in command[-1])
        names.append(platform)
        return subprocess.CompletedProcess(command, platform not in working)

    monkeypatch.setattr(rendering.subprocess, "run", run)
    return names


@pytest.mark.parametrize("names", [["egl"], ["egl", "osmesa"]])
def test_egl_is_tried_before_osmesa(fresh, names):
    found = tried(fresh, names[-1], "osmesa")
    assert offscreen() == offscreen() == names[-1]
    assert found == names


def test_the_environment_variable_decides(fresh):
    names = tried(fresh, "egl", "osmesa")
    fresh.setenv("MUJOCO_GL", "osmesa")
    assert offscreen() == "osmesa" and names == ["osmesa"]
    fresh.setenv("MUJOCO_GL", "disable")
    offscreen.cache_clear()
    assert offscreen() is None and names == ["osmesa"]


def test_without_a_platform_frames_are_blank_and_one_warning_is_given(fresh):
    tried(fresh)
    envs = [BottleShakingEnv(render_mode="rgb_array") for _ in range(2)]
    for env in envs:
        env.reset(seed=0)
    with pytest.warns(RuntimeWarning, match="egl and osmesa did not work; install") as caught:
        frames = [env.render() for env in envs]
    assert len(caught) == 1
    for frame in frames:
        assert frame.shape == (16, 16, 3) and frame.dtype == np.uint8 and not frame.any()


def test_without_a_render_mode_nothing_is_drawn():
    env = BottleShakingEnv()
    env.reset(seed=0)
    assert env.render() is None and env._renderer is None


DRAWN = pytest.mark.skipif(offscreen() is None, reason="neither EGL nor OSMesa is here")


@DRAWN
def test_a_picture_shows_robot_table_and_bottle():
    env = BottleShakingEnv(render_mode="rgb_array", render_width=160, render_height=120)
    env.reset(seed=0)
    picture = env.render()
    assert picture.shape == (120, 160, 3) and picture.dtype == np.uint8
    red, _, blue = picture.astype(int).transpose(2, 0, 1)
    shares = {
        "bottle": (blue > red + 60).mean(),
        "table": ((red > blue + 20) & (red < 200)).mean(),
        "robot": ((abs(red - blue) < 5) & (red < 150)).mean(),
        "sky": ((red > 180) & (blue > red)).mean(),
    }
    assert min(shares.values()) > 0.02, shares
    assert shares["sky"] < 0.9


@DRAWN
def test_pictures_change_25_times_per_second():
    env = BottleShakingEnv(render_mode="rgb_array", render_width=64, render_height=48)
    observation, _ = env.reset(seed=0)
    action = observation["agent_pos"]
    pictures = [env.render()]
    for _ in range(8):
        action = action + 0.03
        env.step(action)
        pictures.append(env.render())
    new = [not np.array_equal(a, b) for a, b in itertools.pairwise(pictures)]
    assert new == [False, False, False, True] * 2
    for _ in range(5):  # nobody looks meanwhile
        action = action + 0.03
        env.step(action)
    assert not np.array_equal(env.render(), pictures[-1])
    env.close()
    env.reset(seed=0)
    np.testing.assert_array_equal(env.render(), pictures[0])
    env.close()
