"""Bottle shaking with torque motors: gravity, gains, dynamics, and what stands in the way."""

import math
import runpy
from pathlib import Path

import gymnasium as gym
import mujoco
import numpy as np
import pytest

import lerobot_env_bimanual  # noqa: F401  registers the environment
from tpgmm_torch import Demonstration
from tpgmm_torch.exceptions import DataError, ShapeError

EXAMPLES = Path(__file__).parents[3] / "examples"
N = 17
SOFT = np.concatenate((np.full(N, 20.0), np.full(N, 2.0)))
STIFF = np.concatenate((np.full(N, 1000.0), np.full(N, 30.0)))


def made(**options):
    return gym.make("lerobot_env_bimanual/BottleTorque-v0", **options).unwrapped


def path(env, seconds: float) -> np.ndarray:
    """The generator's joints (T, 17) from the present start, at the rate of the control."""
    nominal: Demonstration = env._nominal()
    time = np.arange(0, seconds, 1 / env.fps)
    return np.stack([np.interp(time, nominal.time, row) for row in nominal.joints.T], axis=1)


def played(env, seed: int, gains: np.ndarray, seconds: float = 3.0):
    """The last observation and info after following the path for some time."""
    env.reset(seed=seed)
    for reference in path(env, seconds):
        observation, *_, info = env.step(np.concatenate((reference, gains)))
    return observation, info


def test_soft_joints_stand_under_gravity_and_motors_without_torque_do_not():
    env = made(fps=50)
    start, _ = env.reset(seed=0)
    for _ in range(50):
        held, *_ = env.step(np.concatenate((start["agent_pos"], SOFT)))
    np.testing.assert_allclose(held["agent_pos"], start["agent_pos"], atol=1e-6)
    env = made(control="torque", fps=50)
    env.reset(seed=0)
    for _ in range(50):
        fallen, *_ = env.step(np.zeros(N))
    assert np.abs(fallen["agent_pos"] - start["agent_pos"]).max() > 0.3


def test_stiffness_is_torque_per_angle():
    # at rest against a constant torque from outside, the joint gives way by torque / stiffness
    env = made(fps=50)
    start, _ = env.reset(seed=0)
    elbow, torque = env.joint_names.index("l_elbow"), 2.0
    for _ in range(100):
        env._scene.data.qfrc_applied[elbow] = torque
        observation, *_ = env.step(np.concatenate((start["agent_pos"], SOFT)))
    moved = observation["agent_pos"] - start["agent_pos"]
    assert moved[elbow] == pytest.approx(torque / SOFT[0], rel=1e-3)
    assert np.abs(np.delete(moved, elbow)).max() < 1e-3


def test_torques_accelerate_as_the_dynamics_say():
    env = made(control="torque", fps=1000)
    env.reset(seed=1)
    wanted = np.linspace(-1, 1, N)
    for k in range(1, 11):
        inertia, bias = env.dynamics()
        # the friction at the end of the step: it is integrated implicitly
        friction = env._scene._friction * (env._scene.velocities + wanted / 1000)
        *_, info = env.step(inertia @ wanted + bias + friction)
        np.testing.assert_allclose(info["velocity"], wanted * k / 1000, rtol=1e-3, atol=1e-6)
    np.testing.assert_allclose(inertia, inertia.T, atol=1e-12)
    assert np.linalg.eigvalsh(inertia).min() > 0


def test_references_alone_have_the_gains_of_the_position_control():
    reference, impedance = made(control="reference", fps=50), made(fps=50)
    for env in (reference, impedance):
        env.reset(seed=2)
    for joints in path(reference, 0.5):
        one, *_ = reference.step(joints)
        other, *_ = impedance.step(np.concatenate((joints, STIFF)))
        np.testing.assert_array_equal(one["agent_pos"], other["agent_pos"])


def test_the_linear_quadratic_tracker_follows_by_torques():
    env = made(control="torque", fps=200)
    observation, info = env.reset(seed=3)
    joints = path(env, 2.5)
    example = runpy.run_path(str(EXAMPLES / "linear_quadratic_tracking.py"))
    covariance = np.broadcast_to(0.01**2 * np.eye(N), (len(joints), N, N))
    gains, feedforward = example["track"](joints, covariance, 1 / env.fps, effort=5.0)
    state = np.concatenate((observation["agent_pos"] + 0.0, info["velocity"]))
    errors = []
    for step in range(len(joints)):
        inertia, bias = env.dynamics()
        control = feedforward[step] - gains[step] @ state
        friction = env._scene._friction * state[N:]
        observation, *_, info = env.step(inertia @ control + bias + friction)
        state = np.concatenate((observation["agent_pos"], info["velocity"]))
        errors.append(np.abs(observation["agent_pos"] - joints[min(step + 1, len(joints) - 1)]))
    assert np.max(errors) < 0.02
    assert np.max(errors[-1]) < 0.005


def test_what_stands_in_the_way_is_hit_softly_by_soft_joints():
    env = made(fps=50, obstacle=math.inf)
    for seed in range(2):
        peaks = [played(env, seed, gains)[1]["peak_contact_N"] for gains in (SOFT, STIFF)]
        assert 0 < peaks[0] < 0.5 * peaks[1]


def test_it_stands_clear_of_the_robot_and_changes_nothing_else():
    env, free = made(fps=50, obstacle=1.0), made(fps=50)
    for seed in range(5):
        (one, info), (other, _) = env.reset(seed=seed), free.reset(seed=seed)
        assert info["peak_contact_N"] == 0
        np.testing.assert_array_equal(one["agent_pos"], other["agent_pos"])
        np.testing.assert_array_equal(one["environment_state"], other["environment_state"])
        place = env._scene.model.geom_pos[env._scene._obstacle].copy()
        assert env._scene.block(place) > 0.03
        env.reset(seed=seed)
        np.testing.assert_array_equal(env._scene.model.geom_pos[env._scene._obstacle], place)


def test_it_goes_away_some_time_after_it_was_touched():
    env = made(fps=50, obstacle=0.2)
    blocked, _ = played(made(fps=50, obstacle=math.inf), 0, SOFT)
    passed, info = played(env, 0, SOFT)
    free, _ = played(made(fps=50), 0, SOFT)
    assert info["peak_contact_N"] > 0
    assert np.abs(blocked["agent_pos"] - free["agent_pos"]).max() > 0.02
    np.testing.assert_allclose(passed["agent_pos"], free["agent_pos"], atol=0.01)


def test_its_force_is_what_the_robot_feels():
    env = made(fps=50, obstacle=math.inf)
    played(env, 1, SOFT, 2.5)
    model, data = env._scene.model, env._scene.data
    assert data.ncon
    mujoco.mj_forward(model, data)
    mujoco.mj_rnePostConstraint(model, data)
    robot = range(1, model.body("table").id)
    felt = np.linalg.norm(sum(data.cfrc_ext[body, 3:] for body in robot))
    assert felt == pytest.approx(env._scene._obstacle_force(), rel=1e-6)


def test_options_and_actions_that_cannot_be_are_refused():
    for wrong, message in (
        ({"control": "magic"}, r"one of \['impedance', 'reference', 'torque'\], got 'magic'"),
        ({"mode": "kinematic"}, "torques need mode='dynamic'"),
        ({"obstacle": -1.0}, "obstacle is a time from 0 to infinity"),
        ({"control": "torque", "condition": "stopped-3"}, "'nominal' for control='torque'"),
    ):
        with pytest.raises(DataError, match=message):
            made(**wrong)
    env = made()
    start = env.reset(seed=0)[0]["agent_pos"]
    for action, error, message in (
        (start, ShapeError, r"shape \(17,\); it holds references, stiffness and"),
        (np.concatenate((start, -SOFT)), DataError, "not below 0"),
        (np.concatenate((start, np.nan * SOFT)), DataError, r"not finite for \['waist_roll'"),
    ):
        with pytest.raises(error, match=message):
            env.step(action)
