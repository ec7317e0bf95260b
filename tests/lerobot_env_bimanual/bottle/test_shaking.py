"""The bottle-shaking environment as gymnasium, Stable-Baselines3 and LeRobot see it."""

import gymnasium as gym
import numpy as np
import pytest
import torch
from lerobot.envs import make_env_config

import lerobot_env_bimanual  # noqa: F401  registers the environment
from lerobot_env_bimanual.bottle.conditions import skill
from lerobot_env_bimanual.bottle.handling import GRIP_FORCE
from lerobot_env_bimanual.bottle.scene import HOLDS
from lerobot_env_bimanual.bottle.shaking import (
    AMPLITUDE,
    FREQUENCY,
    BottleShakingEnv,
)
from lerobot_env_bimanual.controlled import Options
from lerobot_env_bimanual.start import PUSHED
from tests.support.suite_expert import start_of
from tpgmm_datasets.bottle.skill import HANDS, SHOULDERS, BottleShaking
from tpgmm_tools.paper.sinusoid import sinusoid
from tpgmm_torch import Frame
from tpgmm_torch.exceptions import DataError, ShapeError


def made(**options):
    return gym.make("lerobot_env_bimanual/BottleShaking-v0", **options).unwrapped


def home(env):
    return skill().neutral_posture().numpy().astype(np.float32)


def test_observations_stay_in_their_space_whatever_is_done():
    env = made(fps=50, pushes=True, noise=3.0, track=True, episode_length=300)
    env.action_space.seed(0)
    env.reset(seed=0)
    for _ in range(300):
        observation, *_ = env.step(env.action_space.sample())
        assert env.observation_space.contains(observation)


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
    env, bottle = made(), [0.3, 0.02, 0.12, 1.0, 0.0, 0.0, 0.0]
    names = {"joints": "agent_pos", "bottle": "environment_state"}
    for options in ({"bottle": bottle, "joints": home(env)}, {"bottle": bottle}, {"other": 1}):
        observation, info = env.reset(seed=1, options=options)
        assert info == {"is_success": False}
        drawn = env.reset(seed=1)[0]
        for name, key in names.items():
            np.testing.assert_allclose(observation[key], options.get(name, drawn[key]))


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
    assert observation["environment_state"][0] > env._start.poses["bottle"][0] + 1e-3


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
            hands = [
                np.stack([scene.data.body(hand).xpos for hand in HANDS]) for scene in scenes
            ]
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


def test_an_action_of_another_robot_or_without_a_value_is_refused():
    env = made(episode_length=2)
    with pytest.raises(DataError, match="call reset first"):
        env.step(np.zeros(17))
    env.reset(seed=0)
    broken = np.where(np.arange(17) == 5, np.nan, home(env))
    for action, error, message in (
        (np.zeros(14), ShapeError, r"shape \(14,\); this robot has 17 joints: \['waist"),
        (broken, DataError, r"not finite for \['l_shoulder_yaw'\] at step 0"),
    ):
        with pytest.raises(error, match=message):
            env.step(action)
    for _ in range(2):
        *_, truncated, _info = env.step(home(env))
    assert truncated
    with pytest.raises(DataError, match="call reset first"):
        env.step(home(env))


def test_every_option_of_the_environment_is_one_of_the_configuration():
    options = vars(Options()) | BottleShakingEnv.__init__.__kwdefaults__
    config = make_env_config("bottle_shaking", frequency=1.0, amplitude=0.1, episode_length=9)
    assert set(config.gym_kwargs) == set(options)
    chosen = made(**config.gym_kwargs)
    assert (chosen.frequency, chosen.amplitude, chosen.episode_length) == (1.0, 0.1, 9)
    usual = made(**make_env_config("bottle_shaking").gym_kwargs)
    given = {name: getattr(usual, name, value) for name, value in options.items()}
    assert given == {**options, "episode_length": 1600, "render_mode": "rgb_array"}


def test_a_simulation_that_diverges_is_no_result(monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)  # MuJoCo writes a log there
    env = made()
    observation, _ = env.reset(seed=0)
    env._scene.data.qvel[3] = 1e12
    with pytest.raises(DataError, match="diverges"):
        env.step(observation["agent_pos"])


NAMES = skill().robot.joint_names


PITCHES = [NAMES.index(name) for name in SHOULDERS]


@pytest.fixture(scope="module")
def demonstrations():
    return BottleShaking(rate=50, steady_rhythm=True).demonstrations(3, seed=3)


def pose(demonstration):
    return start_of(demonstration)["bottle"]


def replay(env, demonstration, joints=None, bottle=None, seed=0):
    """Send a demonstration's joints, at 50 Hz, as references; hold the last."""
    joints = demonstration.joints.numpy() if joints is None else joints
    bottle = pose(demonstration) if bottle is None else bottle
    env.reset(seed=seed, options={"bottle": bottle, "joints": joints[0]})
    each = 50 // env.fps
    for k in range(1, env.episode_length + 1):
        action = joints[min(each * k, len(joints) - 1)]
        *_, over, info = env.step(action.astype(np.float32))
    assert over
    return info


def at(demonstration, event):
    return int(50 * demonstration.events[event])


def shaken(demonstration, change):
    """The demonstration with another swing of the shoulders."""
    joints = demonstration.joints.numpy().copy()
    start, end = (at(demonstration, event) for event in ("shake", "rest"))
    around = joints[start]
    done = (np.arange(end + 1 - start) / (end - start))[:, None]
    swing = (joints - around)[start : end + 1, PITCHES]
    joints[start : end + 1, PITCHES] = around[PITCHES] + change(done, swing)
    return joints


@pytest.mark.parametrize(
    "options", [{}, {"fps": 25}, {"mode": "kinematic"}], ids=["dynamic", "slow", "kinematic"]
)
def test_replayed_demonstrations_succeed(demonstrations, options):
    env = BottleShakingEnv(**{"fps": 50, **options})
    for seed, demonstration in enumerate(demonstrations):
        info = replay(env, demonstration, seed=seed)
        assert info["is_success"] is True
        assert info["grasp_mm"] < (0.2 if env.mode == "dynamic" else 0.01)
        assert info["grasp_deg"] < 0.01
        assert 80 < info["lift_mm"] < 110
        # the first and the last eighth of the shaking grow and fade
        start, end = (at(demonstration, event) for event in ("shake", "rest"))
        steady = slice(start + (end - start) // 8 + 1, end - (end - start) // 8)
        shown = sinusoid(demonstration.time[steady], demonstration.joints[steady, PITCHES[0]])
        assert info["frequency_hz"] == pytest.approx(FREQUENCY, rel=2e-3)
        assert info["amplitude_rad"] == pytest.approx(shown.amplitude, rel=0.01)
        assert info["frequency_error"] == abs(info["frequency_hz"] / FREQUENCY - 1)
        assert info["amplitude_error"] == abs(info["amplitude_rad"] / AMPLITUDE - 1)


def test_the_reward_comes_at_the_end_of_success(demonstrations):
    env = BottleShakingEnv(fps=50, mode="kinematic")
    joints = demonstrations[0].joints.numpy()
    env.reset(options={"bottle": pose(demonstrations[0]), "joints": joints[0]})
    rewards = []
    for k in range(env.episode_length):
        _, reward, terminated, truncated, info = env.step(joints[min(k, len(joints) - 1)])
        assert not terminated and truncated == info["is_success"]
        rewards.append(reward)
    assert rewards == [0.0] * 799 + [1.0]


@pytest.mark.parametrize("mode", ["dynamic", "kinematic"])
def test_a_demonstration_for_another_bottle_fails(demonstrations, mode):
    env = BottleShakingEnv(fps=50, mode=mode)
    info = replay(env, demonstrations[0], bottle=pose(demonstrations[1]))
    assert not info["is_success"]
    assert info["grasp_mm"] > 10


def test_a_time_shift_does_not_matter(demonstrations):
    env, joints = BottleShakingEnv(fps=50), demonstrations[0].joints.numpy()
    waited = np.concatenate((np.repeat(joints[:1], 60, axis=0), joints))
    for moved in (joints[30:], waited):  # starts on its way, or late
        assert replay(env, demonstrations[0], moved)["is_success"]


def swing_at(half_turns):
    return lambda done, _swing: AMPLITUDE * np.sin(half_turns * np.pi * done)


@pytest.mark.parametrize(
    ("change", "frequency", "amplitude"),
    [
        (lambda _done, swing: 0.0 * swing, None, 0.0),
        (lambda _done, swing: 0.5 * swing, FREQUENCY, 0.5 * AMPLITUDE),
        (lambda _done, swing: 1.3 * swing, FREQUENCY, 1.3 * AMPLITUDE),
        (swing_at(7.8), 1.3 * FREQUENCY, AMPLITUDE),
        (swing_at(4.8), 0.8 * FREQUENCY, AMPLITUDE),
        (lambda _done, swing: swing * [1, 0], FREQUENCY, 0.0),
    ],
    ids=["still", "weak", "strong", "fast", "slow", "one-armed"],
)
def test_another_shaking_is_measured_and_fails(demonstrations, change, frequency, amplitude):
    env = BottleShakingEnv(fps=50, mode="kinematic")
    info = replay(env, demonstrations[2], shaken(demonstrations[2], change))
    assert not info["is_success"]
    assert info["grasp_mm"] < 1
    assert info["amplitude_rad"] == pytest.approx(amplitude, rel=0.06, abs=0.06)
    if frequency is not None:
        assert info["frequency_hz"] == pytest.approx(frequency, rel=0.03)


def test_a_rhythm_can_be_asked_for(demonstrations):
    fast = shaken(demonstrations[2], lambda done, _swing: 0.1 * np.sin(12 * np.pi * done))
    env = BottleShakingEnv(fps=50, mode="kinematic", frequency=2 * FREQUENCY, amplitude=0.1)
    assert replay(env, demonstrations[2], fast)["is_success"]
    assert not replay(env, demonstrations[2])["is_success"]


def test_without_a_grasp_there_are_figures_and_no_success(demonstrations):
    env = BottleShakingEnv(fps=50)
    joints = demonstrations[0].joints.numpy()
    info = replay(env, demonstrations[0], joints[:1])
    first = demonstrations[0]
    nearest, _ = skill().grasp_error(first.joints[0], first.frames["bottle"])
    assert info["grasp_mm"] == pytest.approx(1e3 * float(nearest), abs=5)
    assert info["lift_mm"] == info["frequency_hz"] == info["amplitude_rad"] == 0
    assert info["frequency_error"] == info["amplitude_error"] == 1
    assert env.figures().keys() <= info.keys()


@pytest.mark.parametrize("mode", ["dynamic", "kinematic"])
def test_hands_that_part_lose_the_bottle(demonstrations, mode):
    env = BottleShakingEnv(fps=50, mode=mode)
    joints = demonstrations[0].joints.numpy().copy()
    rest = at(demonstrations[0], "rest")
    elbow = NAMES.index("l_shoulder_yaw")
    joints[rest:, elbow] += np.minimum(np.arange(len(joints) - rest) * 0.03, 0.3)
    info = replay(env, demonstrations[0], joints)
    assert not env._scene.held and not info["is_success"]
    assert info["lift_mm"] == 0
    assert info["frequency_error"] < 0.01
    assert env._scene.bottle[2] < 0.05  # on the table, which has sunk


def test_the_bottle_goes_with_the_hands(demonstrations):
    for mode in ("dynamic", "kinematic"):
        env = BottleShakingEnv(fps=50, mode=mode, track=True)
        demonstration = demonstrations[1]
        joints = demonstration.joints.numpy()
        env.reset(options={"bottle": pose(demonstration), "joints": joints[0]})
        pulls = []
        for k in range(1, at(demonstration, "shake")):
            observation, *_ = env.step(joints[k])
            if env._scene.held and mode == "dynamic":
                pulls.append(max(map(env._scene.pull, HOLDS)))
        seen = torch.from_numpy(observation["environment_state"])
        joints = torch.from_numpy(observation["agent_pos"])
        apart, turned = skill().grasp_error(joints, Frame(seen[:3], seen[3:]))
        assert apart < 1e-3 and turned < 5e-3
        assert np.linalg.norm(seen[:3].numpy() - pose(demonstration)[:3]) > 0.02
        assert max(pulls, default=0) < GRIP_FORCE / 5


def test_a_turned_hand_grasps_badly(demonstrations):
    env = BottleShakingEnv(fps=50)
    joints = demonstrations[0].joints.numpy().copy()
    wrist = NAMES.index("l_wrist_pitch")
    joints[:, wrist] += np.where(joints[:, wrist].mean() > 0, -0.2, 0.2)
    info = replay(env, demonstrations[0], joints)
    assert not info["is_success"]
    assert info["grasp_deg"] == pytest.approx(np.degrees(0.2), abs=2)
    assert info["lift_mm"] > 0  # held all the same
