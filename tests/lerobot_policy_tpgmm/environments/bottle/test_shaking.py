"""The bottle-shaking environment as gymnasium, Stable-Baselines3 and LeRobot see it."""

import warnings

import gymnasium as gym
import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env as check_by_gymnasium
from lerobot.envs import env_to_policy_features, make_env, make_env_config
from stable_baselines3.common.env_checker import check_env as check_by_stable_baselines

import lerobot_policy_tpgmm  # noqa: F401  registers the environment
from lerobot_policy_tpgmm.environments.bottle.conditions import PUSHED, skill
from lerobot_policy_tpgmm.environments.bottle.scene import BottleScene, displaced
from lerobot_policy_tpgmm.environments.bottle.shaking import BottleShakingEnv
from tpgmm_torch.exceptions import DataError, ShapeError

FIGURES = {
    *("grasp_mm", "grasp_deg", "lift_mm", "frequency_hz", "amplitude_rad"),
    *("frequency_error", "amplitude_error"),
}


def made(**options):
    return gym.make("lerobot_policy_tpgmm/BottleShaking-v0", **options).unwrapped


def home(env):
    return skill().neutral_posture().numpy().astype(np.float32)


@pytest.mark.parametrize(
    "options",
    [
        {"episode_length": 5},
        {"fps": 25, "mode": "kinematic"},
        {"fps": 50, "pushes": True, "noise": 1.0, "track": True},
    ],
    ids=lambda options: "-".join(options),
)
def test_the_checkers_of_gymnasium_and_stable_baselines_pass(options):
    env = made(**options)
    with warnings.catch_warnings():
        # actions are angles, not numbers between -1 and 1
        warnings.filterwarnings("ignore", message=".*symmetric and normalized")
        check_by_gymnasium(env, skip_render_check=True)
    scaled = gym.wrappers.RescaleAction(env, np.float32(-1), np.float32(1))
    check_by_stable_baselines(scaled)


def test_observations_stay_in_their_space_whatever_is_done():
    env = made(fps=50, pushes=True, noise=3.0, track=True, episode_length=300)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(300):
        observation, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)


def test_the_seed_alone_gives_the_start():
    situation = skill().situations(1, seed=7)[0]
    starts = []
    for options in ({}, {"fps": 25}, {"mode": "kinematic"}, {"pushes": True, "noise": 1.0}):
        env = made(**options)
        env.reset(seed=3)  # another episode before it
        env.reset(seed=7)
        starts.append(env._start)
    for start in starts:
        np.testing.assert_array_equal(start.joints, situation.joints)
        np.testing.assert_array_equal(start.bottle[:3], situation.frames["bottle"].position)
        assert repr(start) == repr(starts[0])
    env.reset()
    assert not np.array_equal(env._start.joints, situation.joints)


def test_joints_stand_in_the_order_of_their_names():
    env = made(mode="kinematic")
    assert env.joint_names == skill().robot.joint_names
    names = [env._scene.model.joint(i).name for i in range(len(env.joint_names))]
    assert tuple(names) == env.joint_names
    start, _ = env.reset(seed=0)
    for j in range(len(env.joint_names)):
        moved = start["agent_pos"].copy()
        moved[j] += 0.01 if moved[j] < env.action_space.high[j] - 0.02 else -0.01
        observation, *_ = env.step(moved)
        np.testing.assert_allclose(observation["agent_pos"], moved, atol=1e-12)


def test_a_start_can_be_chosen():
    env = made()
    joints = home(env)
    bottle = [0.3, 0.02, 0.12, 1.0, 0.0, 0.0, 0.0]
    for options in ({"bottle": bottle, "joints": joints}, {"bottle": bottle}, {"other": 1}):
        observation, info = env.reset(seed=1, options=options)
        assert info == {"is_success": False}
        drawn = env.reset(seed=1)[0]
        wanted = options.get("joints", drawn["agent_pos"])
        np.testing.assert_allclose(observation["agent_pos"], wanted)
        wanted = options.get("bottle", drawn["environment_state"])
        np.testing.assert_allclose(observation["environment_state"], wanted)


@pytest.mark.parametrize("fps", [25, 50, 100])
def test_position_control_follows_a_moving_reference(fps):
    env = made(fps=fps)
    start = home(env)
    observation, _ = env.reset(seed=0, options={"joints": start})
    delay = env._start.delay / 1000
    speed = np.full(17, 0.2)
    for k in range(1, fps):
        observation, *_ = env.step(start + speed * k / fps)
    lag = start + speed * (fps - 1) / fps - observation["agent_pos"]
    np.testing.assert_allclose(lag, speed * delay, atol=1e-3)


def test_references_are_limited_to_the_joints_ranges_and_speeds():
    env = made(mode="kinematic")
    start, _ = env.reset(seed=0)
    start = start["agent_pos"]
    *_, info = env.step(start)
    assert info["clipped_rad"] == 0
    far = start + 0.5
    observation, *_, info = env.step(far)
    np.testing.assert_allclose(observation["agent_pos"], start + 0.04)  # 4 rad/s
    assert info["clipped_rad"] == pytest.approx(0.46)
    for _ in range(200):
        observation, *_, info = env.step(np.full(17, 9.0))
    np.testing.assert_allclose(observation["agent_pos"], skill().robot.upper)
    assert info["clipped_rad"] == pytest.approx(9 - float(skill().robot.upper.min()))


def test_sensor_noise_has_the_sizes_that_are_promised():
    exact, noisy = made(mode="kinematic"), made(mode="kinematic", noise=2.0)
    errors = []
    for seed in range(200):
        (a, _), (b, _) = exact.reset(seed=seed), noisy.reset(seed=seed)
        errors.append({key: b[key] - a[key] for key in a})
    again, *_ = noisy.step(b["agent_pos"])
    np.testing.assert_array_equal(again["environment_state"], b["environment_state"])
    joints = np.std([e["agent_pos"] for e in errors])
    position = np.std([e["environment_state"][:3] for e in errors])
    turn = 2 * np.std([e["environment_state"][4:6] for e in errors])  # yaw is near zero
    assert joints == pytest.approx(4e-3, rel=0.1)
    assert position == pytest.approx(2e-3, rel=0.1)
    assert np.degrees(turn) == pytest.approx(1.0, rel=0.15)


def test_a_tracked_bottle_is_seen_where_it_is():
    env = made(track=True)
    observation, _ = env.reset(seed=0)
    env._scene.data.qvel[17] = 0.3  # it slides forward
    observation, *_ = env.step(observation["agent_pos"])
    np.testing.assert_array_equal(observation["environment_state"], env._scene.bottle)
    assert observation["environment_state"][0] > env._start.bottle[0] + 1e-3


def test_a_displaced_pose():
    half = np.sqrt(0.5)
    pose = np.array([1.0, 2.0, 3.0, half, 0, 0, half])
    out = displaced(pose, np.array([0.1, 0, 0, np.pi / 2, 0, 0]))
    # a quarter about the pose's own x axis, after a quarter about z
    np.testing.assert_allclose(out, [1.1, 2, 3, 0.5, 0.5, 0.5, 0.5], atol=1e-12)
    assert pose[0] == 1


def test_a_push_moves_an_arm_for_a_moment():
    calm, pushed = made(), made(pushes=True)
    moved = []
    for seed in (5, 18, 21):  # whose pushes come early
        (start, _), _ = calm.reset(seed=seed), pushed.reset(seed=seed)
        push = pushed._start
        assert any(part in calm.joint_names[push.pushed] for part in PUSHED)
        assert 0.1 <= push.push_length <= 0.3 and 40 <= abs(push.push_torque) <= 50
        before, last = int(100 * push.push_start) - 1, int(100 * push.push_start) + 120
        apart = []
        for _ in range(last):
            for env in (calm, pushed):
                env.step(start["agent_pos"])
            scenes = calm._scene, pushed._scene
            hands = [scene.data.xpos[scene._hands] for scene in scenes]
            apart.append(np.linalg.norm(hands[0] - hands[1], axis=-1).max())
        assert max(apart[:before]) == 0
        assert apart[-1] < 1e-3
        moved.append(max(apart))
    assert min(moved) > 0.008 and max(moved) < 0.04


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"fps": 30}, "fps has to divide 1000"),
        ({"fps": 5}, "at least 10"),
        ({"mode": "static"}, "'dynamic' or 'kinematic', got 'static'"),
        ({"mode": "kinematic", "pushes": True}, "need mode='dynamic'"),
        ({"episode_length": 0}, "episode_length"),
        ({"noise": -1.0}, "noise"),
        ({"noise": float("nan")}, "noise"),
        ({"frequency": 0.0}, "frequency"),
        ({"amplitude": float("inf")}, "amplitude"),
        ({"render_mode": "human"}, "render_mode"),
    ],
)
def test_an_unknown_option_is_refused(options, message):
    with pytest.raises(DataError, match=message):
        BottleShakingEnv(**options)


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"joints": np.zeros(14)}, ShapeError, "joints needs 17 values"),
        ({"joints": np.full(17, np.nan)}, DataError, "not finite"),
        ({"joints": np.full(17, 1.0)}, DataError, "l_elbow is out of its range by 1 rad"),
        ({"bottle": np.zeros(7)}, DataError, "unit quaternion"),
        ({"bottle": np.zeros(3)}, ShapeError, "bottle needs 7 values"),
    ],
)
def test_an_impossible_start_is_refused(options, error, message):
    with pytest.raises(error, match=message):
        made().reset(seed=0, options=options)


def test_an_action_of_another_robot_or_without_a_value_is_refused():
    env = made(episode_length=2)
    with pytest.raises(DataError, match="call reset first"):
        env.step(np.zeros(17))
    env.reset(seed=0)
    with pytest.raises(ShapeError, match=r"shape \(14,\); this robot has 17 joints: \['waist"):
        env.step(np.zeros(14))
    broken = home(env)
    broken[5] = np.nan
    with pytest.raises(DataError, match=r"not finite for \['l_shoulder_yaw'\] at step 0"):
        env.step(broken)
    for _ in range(2):
        *_, truncated, _info = env.step(home(env))
    assert truncated
    with pytest.raises(DataError, match="call reset first"):
        env.step(home(env))


def test_lerobot_makes_fifty_of_them():
    config = make_env_config("bottle_shaking", fps=25, mode="kinematic", episode_length=3)
    assert config.type == "bottle_shaking"
    shapes = {key: value.shape for key, value in env_to_policy_features(config).items()}
    assert shapes == {
        "observation.state": (17,),
        "observation.environment_state": (7,),
        "action": (17,),
    }
    envs = make_env(config, n_envs=50)["bottle_shaking"][0]
    observation, info = envs.reset(seed=list(range(50)), options={"new": True})
    assert observation["agent_pos"].shape == (50, 17)
    assert envs.metadata["render_fps"] == 25
    assert envs.call("_max_episode_steps") == (3,) * 50
    assert set(envs.call("task")) == {"shake the bottle"}
    assert set(envs.call("task_description")) == {
        "take the bottle with both hands, lift it and shake it"
    }
    for _ in range(3):
        *_, truncated, info = envs.step(observation["agent_pos"].astype(np.float32))
    assert truncated.all()
    final = info["final_info"]
    assert FIGURES | {"is_success", "clipped_rad"} <= set(final)
    assert not final["is_success"].any()
    for name in FIGURES:
        assert final[name].shape == (50,)
        assert np.isfinite(final[name]).all()
    envs.close()


def test_every_option_of_the_environment_is_one_of_the_configuration():
    options = BottleShakingEnv.__init__.__kwdefaults__
    config = make_env_config("bottle_shaking", frequency=1.0, amplitude=0.1, episode_length=9)
    assert set(config.gym_kwargs) == set(options)
    chosen = made(**config.gym_kwargs)
    assert (chosen.frequency, chosen.amplitude, chosen.episode_length) == (1.0, 0.1, 9)
    usual = made(**make_env_config("bottle_shaking").gym_kwargs)
    given = {name: getattr(usual, name, value) for name, value in options.items()}
    assert given == {**options, "episode_length": 1600, "render_mode": "rgb_array"}


def test_the_simulated_robot_is_the_one_of_the_kinematics():
    scene = BottleScene()
    rng = np.random.default_rng(0)
    robot = skill().robot
    for _ in range(5):
        joints = rng.uniform(robot.lower, robot.upper)
        scene.reset([0.3, 0, 0.15, 1, 0, 0, 0], joints, 1.0)
        state = robot.state(joints)
        for hand in ("l_hand", "r_hand"):
            body = scene.data.body(hand)
            np.testing.assert_allclose(body.xpos, state.position(hand), atol=1e-12)
            apart = np.empty(3)
            mujoco.mju_subQuat(apart, body.xquat, state.orientation(hand).numpy())
            np.testing.assert_allclose(apart, 0, atol=1e-9)


def test_a_simulation_that_diverges_is_no_result(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    env = made()
    observation, _ = env.reset(seed=0)
    env._scene.data.qvel[3] = 1e12
    with pytest.raises(DataError, match="diverges"):
        env.step(observation["agent_pos"])
