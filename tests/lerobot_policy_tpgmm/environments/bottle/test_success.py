"""What counts as success in the bottle-shaking environment: demonstrations, and less."""

import numpy as np
import pytest
import torch

from lerobot_policy_tpgmm.environments.bottle.conditions import skill
from lerobot_policy_tpgmm.environments.bottle.shaking import (
    AMPLITUDE,
    FREQUENCY,
    GRIP_FORCE,
    BottleShakingEnv,
)
from tpgmm_datasets.bottle.skill import SHOULDERS, BottleShaking
from tpgmm_torch import Frame
from tpgmm_torch.metrics import sinusoid

NAMES = skill().robot.joint_names
PITCHES = [NAMES.index(name) for name in SHOULDERS]


@pytest.fixture(scope="module")
def demonstrations():
    return BottleShaking(rate=50, steady_rhythm=True).demonstrations(3, seed=3)


def pose(demonstration):
    frame = demonstration.frames["bottle"]
    return torch.cat((frame.position, frame.orientation)).numpy()


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
        shown = [
            sinusoid(demonstration.time[steady], demonstration.joints[steady, i])
            for i in PITCHES
        ]
        assert info["frequency_hz"] == pytest.approx(FREQUENCY, rel=2e-3)
        assert info["amplitude_rad"] == pytest.approx(shown[0].amplitude, rel=0.01)
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
    env = BottleShakingEnv(fps=50)
    joints = demonstrations[0].joints.numpy()
    early = replay(env, demonstrations[0], joints[30:])  # starts on its way
    waited = np.concatenate((np.repeat(joints[:1], 60, axis=0), joints))
    late = replay(env, demonstrations[0], waited)
    assert early["is_success"] and late["is_success"]


@pytest.mark.parametrize(
    ("change", "frequency", "amplitude"),
    [
        (lambda _done, swing: 0.0 * swing, None, 0.0),
        (lambda _done, swing: 0.5 * swing, FREQUENCY, 0.5 * AMPLITUDE),
        (lambda _done, swing: 1.3 * swing, FREQUENCY, 1.3 * AMPLITUDE),
        (
            lambda done, _swing: AMPLITUDE * np.sin(7.8 * np.pi * done),
            1.3 * FREQUENCY,
            AMPLITUDE,
        ),
        (
            lambda done, _swing: AMPLITUDE * np.sin(4.8 * np.pi * done),
            0.8 * FREQUENCY,
            AMPLITUDE,
        ),
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
    nearest, _ = skill().grasp_error(
        demonstrations[0].joints[0], demonstrations[0].frames["bottle"]
    )
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
                pulls.append(env._scene.pull())
        seen = torch.from_numpy(observation["environment_state"])
        apart, turned = skill().grasp_error(
            torch.from_numpy(observation["agent_pos"]), Frame(seen[:3], seen[3:])
        )
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
