"""The environments as gymnasium, Stable-Baselines3 and LeRobot see them."""

import gymnasium as gym
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_by_gymnasium
from lerobot.envs import env_to_policy_features, make_env, make_env_config
from stable_baselines3.common.env_checker import check_env as check_by_stable_baselines

import lerobot_env_bimanual  # noqa: F401  registers the environments
from lerobot_env_bimanual.bottle.torque import CONTROLS
from lerobot_env_bimanual.suite.names import SUITE
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import TRIED

FIGURES = {
    "bottle_shaking": {
        *("grasp_mm", "grasp_deg", "lift_mm", "frequency_hz", "amplitude_rad"),
        *("frequency_error", "amplitude_error", "clipped_rad"),
    },
    "carry_and_put": {"put_mm", "put_deg", "standing", "grasp_mm", "grasp_deg"},
    "bottle_torque": {"grasp_mm", "peak_contact_N"},
}
SHORT = {"fps": 50, "episode_length": 5}
SUITES = [{"task": name, "robot": robot} for name in SUITE for robot in TRIED]


def slow(*values):
    return pytest.param(*values, marks=pytest.mark.slow)


@pytest.mark.filterwarnings("ignore:.*symmetric and normalized")  # actions are angles
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("BottleShaking", {"episode_length": 5}),
        ("BottleShaking", {"fps": 25, "mode": "kinematic"}),
        ("BottleShaking", {"fps": 50, "pushes": True, "noise": 1.0, "track": True}),
        ("CarryAndPut", {"fps": 50, "noise": 1.0}),
        *(("BottleTorque", {"control": one, "obstacle": 1.0} | SHORT) for one in CONTROLS),
        *(slow("Bimanual", {"pushes": True, "noise": 1.0} | SHORT | one) for one in SUITES),
    ],
)
def test_the_checkers_of_gymnasium_and_stable_baselines_pass(name, options):
    env = gym.make(f"lerobot_env_bimanual/{name}-v0", **options).unwrapped
    check_by_gymnasium(env, skip_render_check=True)
    if name != "BottleTorque":  # whose gains have no end
        check_by_stable_baselines(
            gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
        )


@pytest.mark.parametrize(
    ("kind", "options", "n", "sizes"),
    [
        ("bottle_shaking", {"mode": "kinematic"}, 50, (17, 7, 17)),
        ("carry_and_put", {"mode": "kinematic"}, 3, (17, 14, 17)),
        ("bottle_torque", {"control": "impedance", "obstacle": 1.0}, 1, (17, 7, 51)),
        ("bottle_torque", {"control": "reference", "obstacle": 1.0}, 1, (17, 7, 17)),
        *(slow("bimanual", one, 2, None) for one in SUITES),
    ],
)
def test_lerobot_makes_several_with_every_option(kind, options, n, sizes):
    config = make_env_config(kind, fps=25, episode_length=3, **options)
    description, figures = None, FIGURES.get(kind)
    if kind == "bimanual":
        task = suite_task(options["task"], options["robot"])
        joints, description = task.robot.joint_names, task.description
        sizes = len(joints), 7 * len(SUITE[task.name]), len(joints)
        figures = {*task.figures, "peak_speed"}
    features = ("observation.state", "observation.environment_state", "action")
    shapes = {key: value.shape for key, value in env_to_policy_features(config).items()}
    assert config.type == kind
    assert shapes == dict(zip(features, ((size,) for size in sizes), strict=True))
    [[envs]] = [list(tasks.values()) for tasks in make_env(config, n_envs=n).values()]
    observation, _ = envs.reset(seed=list(range(n)), options={"new": True})
    assert observation["agent_pos"].shape == (n, sizes[0])
    assert envs.metadata["render_fps"] == 25 and envs.call("_max_episode_steps") == (3,) * n
    for name, value in options.items():
        assert set(envs.call(name)) == {value}
    if kind == "bottle_shaking":
        assert set(envs.call("task")) == {"shake the bottle"}
        description = "take the bottle with both hands, lift it and shake it"
    if description:
        assert set(envs.call("task_description")) == {description}
    action = observation["agent_pos"].astype(np.float32)
    if sizes[0] != sizes[2]:
        action = np.concatenate((action, np.full((n, sizes[2] - sizes[0]), 20.0)), axis=1)
    for _ in range(3):
        *_, truncated, info = envs.step(action)
    final = info["final_info"]
    assert truncated.all() and not final["is_success"].any()
    for name in figures:
        assert final[name].shape == (n,)
        assert np.isfinite(final[name]).all() or kind != "bottle_shaking"
    envs.close()
