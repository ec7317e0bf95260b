"""gym-aloha's tasks with joints and object poses as observation."""

import os
import subprocess
import sys

import gymnasium as gym
import numpy as np
import pytest
from gym_aloha.utils import sample_box_pose, sample_insertion_pose
from gymnasium.utils.env_checker import check_env
from lerobot.envs import make_env
from lerobot.envs.factory import make_env_config
from stable_baselines3.common.env_checker import check_env as check_for_baselines

import lerobot_env_bimanual  # noqa: F401  registers
from lerobot_env_bimanual.aloha.state import AlohaStateEnv
from tpgmm_torch.exceptions import TPGMMError

GYM_ID = "lerobot_env_bimanual/AlohaState-v0"
TASKS = ("transfer_cube", "insertion")
HOME = np.array([0, -0.96, 1.16, 0, -0.3, 0, 0.5] * 2)


@pytest.fixture(scope="module")
def env():
    return AlohaStateEnv()


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")  # joint ranges are not
@pytest.mark.parametrize("task", TASKS)
def test_checkers_are_content(task):
    made = gym.make(GYM_ID, task=task, episode_length=20)
    check_env(made.unwrapped, skip_render_check=True)
    check_for_baselines(made, warn=False)


@pytest.mark.parametrize("task", TASKS)
def test_objects_lie_where_gym_aloha_puts_them_but_for_the_yaw(task):
    plain, turned = AlohaStateEnv(task, yaw_range=0), AlohaStateEnv(task, fps=25)
    drawn = []
    for seed in range(8):
        draw = sample_box_pose if task == "transfer_cube" else sample_insertion_pose
        theirs = np.hstack(draw(seed))
        assert np.array_equal(plain.reset(seed=seed)[0]["environment_state"], theirs)
        poses = turned.reset(seed=seed)[0]["environment_state"].reshape(-1, 7)
        assert np.array_equal(poses[:, :3], theirs.reshape(-1, 7)[:, :3])
        assert np.allclose(np.linalg.norm(poses[:, 3:], axis=1), 1)
        assert not poses[:, 4:6].any()
        drawn += list(2 * np.arctan2(poses[:, 6], poses[:, 3]))
    assert np.abs(drawn).max() <= np.pi / 4
    assert np.std(drawn) > 0.2


def test_a_seed_gives_one_start_and_no_seed_another(env):
    first = env.reset(seed=5)[0]["environment_state"]
    after = env.reset()[0]["environment_state"]
    assert np.array_equal(env.reset(seed=5)[0]["environment_state"], first)
    assert np.array_equal(env.reset()[0]["environment_state"], after)
    assert not np.array_equal(first, after)
    at_25_hz = AlohaStateEnv(fps=25).reset(seed=5)[0]["environment_state"]
    assert np.array_equal(at_25_hz, first)


def test_environments_side_by_side_do_not_disturb_one_another():
    alone = [AlohaStateEnv(track=True) for _ in range(3)]
    vector = gym.vector.SyncVectorEnv([lambda: AlohaStateEnv(track=True)] * 3)
    together, _ = vector.reset(seed=[7, 8, 9])
    apart = [e.reset(seed=seed)[0] for e, seed in zip(alone, (7, 8, 9), strict=True)]
    for _ in range(30):
        for name, values in together.items():
            assert np.array_equal(values, np.stack([o[name] for o in apart]))
        together, *_ = vector.step(np.tile(np.float32(HOME), (3, 1)))
        apart = [e.step(np.float32(HOME))[0] for e in alone]
    vector.close()


def test_gym_aloha_keeps_its_own_pose(env):
    from gym_aloha.tasks.sim import BOX_POSE

    BOX_POSE[0] = "somebody else's"
    env.reset(seed=0)
    assert BOX_POSE == ["somebody else's"]
    BOX_POSE[0] = None


def test_pose_of_the_object_is_the_initial_or_the_present_one():
    still, tracking = AlohaStateEnv(), AlohaStateEnv(track=True)
    start = still.reset(seed=1)[0]["environment_state"]
    assert np.array_equal(tracking.reset(seed=1)[0]["environment_state"], start)
    for _ in range(25):
        seen, now = (e.step(HOME)[0]["environment_state"] for e in (still, tracking))
    assert np.array_equal(seen, start)
    assert now[2] == pytest.approx(0.02, abs=1e-3)  # on the table


def test_a_start_is_set_exactly(env):
    pose = np.array([0.1, 0.45, 0.02, np.cos(0.2), 0, 0, np.sin(0.2)])
    observation, info = env.reset(seed=0, options={"environment_state": pose, "joints": HOME})
    assert np.array_equal(observation["environment_state"], pose)
    assert observation["agent_pos"] == pytest.approx(HOME, abs=1e-12)
    zero = dict.fromkeys(("max_reward", "lift_mm", "elapsed_s"), 0.0)
    assert info == {"is_success": False, "diverged": False, **zero}
    for _ in range(50):
        observation, *_ = env.step(HOME)
    assert observation["agent_pos"] == pytest.approx(HOME, abs=0.02)  # gravity


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"environment_state": np.zeros(7)}, "unit quaternion"),
        ({"environment_state": np.zeros(14)}, r"shape \(7,\)"),
        ({"joints": np.full(14, np.nan)}, "NaN"),
    ],
)
def test_wrong_starts_are_refused(env, options, message):
    with pytest.raises(TPGMMError, match=message):
        env.reset(options=options)


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "juggling"}, "transfer_cube"),
        ({"fps": 30}, "divide 500"),
        ({"fps": 0}, "divide 500"),
        ({"fps": 33.3}, "divide 500"),
        ({"episode_length": 0}, "at least 1"),
        ({"yaw_range": -1.0}, "between 0 and pi"),
        ({"yaw_range": float("nan")}, "between 0 and pi"),
        ({"render_mode": "human"}, "rgb_array"),
    ],
)
def test_wrong_options_are_refused(options, message):
    with pytest.raises(TPGMMError, match=message):
        AlohaStateEnv(**options)


@pytest.mark.parametrize(
    ("action", "message"), [(np.zeros(17), r"shape \(14,\)"), (np.full(14, np.nan), "NaN")]
)
def test_wrong_actions_are_refused(env, action, message):
    env.reset(seed=0)
    with pytest.raises(TPGMMError, match=message):
        env.step(action)


def test_unstable_physics_end_the_episode(env):
    env.reset(seed=0)
    env._physics.data.qvel[3] = 1e12
    observation, reward, terminated, truncated, info = env.step(HOME)
    assert all(np.isfinite(values).all() for values in observation.values())
    assert (reward, terminated, truncated) == (0, True, False)
    assert info["diverged"]
    assert not info["is_success"]
    observation, info = env.reset(seed=0)
    assert np.abs(observation["agent_pos"]).max() < 2
    assert not info["diverged"]


def test_an_episode_takes_8_seconds_at_every_rate():
    assert {AlohaStateEnv(fps=fps)._max_episode_steps / fps for fps in (20, 50, 100)} == {8}
    env = AlohaStateEnv(fps=10)
    env.reset(seed=0)
    ends = [env.step(HOME)[3] for _ in range(80)]
    assert ends == [False] * 79 + [True]


def test_lerobot_makes_the_environment():
    config = make_env_config("aloha_state", task="insertion", fps=25, episode_length=3)
    assert config.features["environment_state"].shape == (14,)
    vector = make_env(config, n_envs=2)["aloha_state"][0]
    observation, _ = vector.reset(seed=[0, 1])
    assert observation["environment_state"].shape == (2, 14)
    assert vector.call("_max_episode_steps") == (3, 3)
    assert vector.call("task_description")[0].startswith("pick up the peg")
    for _ in range(3):
        *_, info = vector.step(np.tile(HOME, (2, 1)))
    assert info["final_info"]["is_success"].tolist() == [False, False]
    vector.close()
    with pytest.raises(TPGMMError, match="juggling"):
        make_env_config("aloha_state", task="juggling")


def test_no_display_no_drawing_and_no_warning():
    module = "lerobot_env_bimanual.aloha.state"
    program = f"from {module} import AlohaStateEnv; env = AlohaStateEnv(); env.reset(seed=0); "
    program += "env.step(env.action_space.low * 0)"
    hidden = {"MUJOCO_GL", "DISPLAY", "WAYLAND_DISPLAY"}
    environment = {k: v for k, v in os.environ.items() if k not in hidden}
    command = [sys.executable, "-c", program]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "DISPLAY" not in done.stderr
