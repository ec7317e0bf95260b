"""The suite as gymnasium, Stable-Baselines3 and LeRobot see it; hands, disturbances, noise."""

from functools import partial

import numpy as np
import pytest
from lerobot.envs import make_env_config

import lerobot_env_bimanual  # noqa: F401  registers the environment
from lerobot_env_bimanual.controlled import NOISE_JOINTS, NOISE_POSE, Options
from lerobot_env_bimanual.disturbances import (
    CONDITIONS,
    Displaced,
    Moved,
    Stopped,
    displace_pose,
)
from lerobot_env_bimanual.suite.env import SUITE_CONDITIONS, SuiteEnv
from lerobot_env_bimanual.suite.handover import GRIP, LEFT, RIGHT
from lerobot_env_bimanual.suite.names import ROBOTS, SUITE
from lerobot_env_bimanual.suite.robots.embodiments import EMBODIMENTS, embodiment
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import TRIED, replay, start_of, tick
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError

pytestmark = pytest.mark.slow

FPS = 25
TASK = suite_task("handover")


@pytest.fixture(scope="module")
def motion():
    """A handover by an expert."""
    return TASK.demonstrations(2, seed=1, rate=FPS)[0]


def test_every_option_of_the_environment_is_one_of_the_configuration():
    options = {"task", "robot", "force", *vars(Options())}
    options -= {"mode", "track"}
    config = make_env_config("bimanual", episode_length=9)
    assert set(config.gym_kwargs) == options and config.task == "handover"
    assert SuiteEnv(**config.gym_kwargs).episode_length == 9


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"task": "juggle"}, r"juggle.*handover"),
        ({"task": "shelf", "robot": "viperx"}, r"shelf.*pick_place"),
        ({"task": "lid", "robot": "octopus"}, r"octopus.*upper_body.*viperx"),
    ],
    ids=["no such task", "placed for the upper body", "no such robot"],
)
@pytest.mark.parametrize("make", [SuiteEnv, partial(make_env_config, "bimanual")])
def test_tasks_and_robots_that_do_not_exist_are_refused(make, options, message):
    with pytest.raises(UnknownNameError, match=message):
        make(**options)


def test_every_robot_has_as_many_joints_as_is_known_without_mujoco():
    for name in TRIED:
        assert embodiment(name).robot.n_joints == ROBOTS[name]
    assert set(EMBODIMENTS) == set(ROBOTS)


@pytest.mark.parametrize("robot", TRIED)
@pytest.mark.parametrize("name", SUITE)
def test_an_episode_is_that_of_its_seed(name, robot):
    def episode(seed):
        env = SuiteEnv(name, robot, fps=FPS, pushes=True, noise=1.0)
        seen = [env.reset(seed=seed)[0]]
        seen += [env.step(seen[0]["agent_pos"])[0] for _ in range(20)]
        return np.array([np.concatenate(list(observation.values())) for observation in seen])

    np.testing.assert_array_equal(episode(7), episode(7))
    assert not np.array_equal(episode(7)[0], episode(8)[0])
    # and however often somebody looks
    slow, fast = (SuiteEnv(name, robot, fps=fps).reset(seed=7)[0] for fps in (25, 100))
    for key, value in slow.items():
        np.testing.assert_array_equal(value, fast[key])


def test_the_expert_succeeds_at_any_rate(motion):
    [smooth, _] = TASK.demonstrations(2, seed=1, rate=50)
    one = replay(SuiteEnv("handover", fps=FPS), motion)
    other = replay(SuiteEnv("handover", fps=50), smooth)
    assert one["is_success"] and other["is_success"]
    assert one["place_mm"] == pytest.approx(other["place_mm"], abs=1.0)


def at_the_baton(motion, off=0.0, condition=()):
    """An environment whose left palm is where it grips, or so far from there [m]."""
    env = SuiteEnv("handover", fps=FPS, condition=condition)
    joints = motion.joints[tick(motion, "close")].numpy()
    baton = start_of(motion)["baton"]
    env.reset(seed=0, options={**start_of(motion), "joints": joints, "baton": baton})
    env._scene.put("baton", baton + np.array((0, -off, 0, 0, 0, 0, 0)))
    return env, joints


def wait(env, joints, seconds):
    for _ in range(round(seconds * env.fps)):
        env.step(joints)


def test_a_hand_that_is_there_and_comes_no_nearer_takes_hold(motion):
    env, joints = at_the_baton(motion)
    assert abs(env._scene.gap(LEFT)) < 0.002 and GRIP["l_hand"][1] > 0
    wait(env, joints, 0.16)
    assert not env._scene.held
    wait(env, joints, 0.12)
    assert env._scene.held == {LEFT}


def test_a_hand_that_is_too_far_does_not(motion):
    for off, holds in ((0.010, True), (0.020, False)):
        env, joints = at_the_baton(motion, off)
        wait(env, joints, 0.6)
        assert (LEFT in env._scene.held) == holds
    assert env._scene.gap(RIGHT) > 0.05


def test_hands_do_not_close_while_the_robot_is_stopped(motion):
    env, joints = at_the_baton(motion, condition=(Stopped(1.0, moment=0.0),))
    wait(env, joints, 1.0)
    assert not env._scene.held
    wait(env, joints, 0.32)
    assert env._scene.held == {LEFT}


@pytest.mark.parametrize(("newtons", "lost"), [(80.0, False), (130.0, True)])
def test_a_grip_gives_way_at_100_newtons_and_is_not_taken_again(motion, newtons, lost):
    env, joints = at_the_baton(motion)
    wait(env, joints, 0.4)
    scene = env._scene
    scene.data.body("baton").xfrc_applied[0] = newtons
    wait(env, joints, 0.2)
    assert (not scene.held) == lost and scene.taken == {LEFT}
    if lost:
        scene.data.body("baton").xfrc_applied[0] = 0
        scene.put("baton", env._start.poses["baton"])
        wait(env, joints, 1.0)
        assert not scene.held


def on_tick(seconds):
    return round(seconds * FPS) / FPS


def run(motion, seconds, *condition):
    env = SuiteEnv("handover", fps=FPS, condition=condition)
    replay(env, motion, seconds=seconds)
    return env


def test_pushed_back_hands_and_judge_are_what_they_were(motion):
    early, passed = on_tick(motion.events["close"] + 0.6), on_tick(motion.events["pass"] + 0.2)
    before = run(motion, early)
    assert before._scene.held == {LEFT}
    taken = run(motion, early, Displaced(-2.0, moment=early))
    assert not taken._scene.held and not taken._scene.taken
    baton = taken._start.poses["baton"]
    np.testing.assert_allclose(taken._scene.pose("baton"), baton, atol=1e-3)
    before = run(motion, passed)
    assert before._scene.held == {RIGHT} and before._scene.taken == {LEFT, RIGHT}
    back = run(motion, passed, Displaced(-2.0, moment=passed))
    assert back._scene.held == back._scene.taken == {LEFT}
    assert back._judge.time == pytest.approx(passed - 2.0, abs=0.05)


def test_pushed_back_hands_wait_as_long_as_ever(motion):
    """However long it was before that they were there."""
    env, joints = at_the_baton(motion, condition=(Displaced(-1.0, moment=1.12),))
    wait(env, joints, 1.12)  # since 0.12 s after the beginning
    assert not env._scene.held
    wait(env, joints, 0.3 + 0.16)  # somebody keeps it there for 0.3 s
    assert not env._scene.held
    wait(env, joints, 0.16)
    assert env._scene.held == {LEFT}


@pytest.mark.parametrize(
    "condition", ["pushed-ahead", "started-midway", "stopped-1+pushed-ahead-1"]
)
def test_conditions_that_skip_a_part_are_refused(condition):
    with pytest.raises(DataError, match=r"skips a part of the task, which handover does not"):
        SuiteEnv("handover", condition=condition)


def test_all_other_conditions_are_offered():
    assert set(CONDITIONS) - set(SUITE_CONDITIONS) == {"pushed-ahead", "started-midway"}
    for condition in SUITE_CONDITIONS:
        env = SuiteEnv("handover", fps=FPS, condition=condition)
        observation, _ = env.reset(seed=0)
        observation, *_ = env.step(observation["agent_pos"])
        assert observation["environment_state"].shape == (14,)


def test_where_an_object_may_not_be_turned_as_far_it_is_moved_less():
    env = SuiteEnv("lid", fps=FPS, condition="moved")
    shares = []
    for seed in range(20):
        env.reset(seed=seed)
        [part] = env._drawn
        assert env._task.usual(displace_pose(env._first, part.step))
        shares.append(np.linalg.norm(part.step[:3]) / part.distance)
        assert abs(part.step[5]) == pytest.approx(shares[-1] * part.angle)
    assert 0.3 < min(shares) < 1


def test_the_first_object_is_moved_before_it_is_held_and_within_its_places(motion):
    for seed in range(20):
        env = SuiteEnv("handover", fps=FPS, condition="moved")
        observation, _ = env.reset(seed=seed)
        [part] = env._drawn
        assert TASK.usual(displace_pose(env._first, part.step))
        assert part.moment <= TASK.ends()["close"] - 1.5
    while env._time < part.moment + 0.1:
        observation, *_ = env.step(observation["agent_pos"])
    wanted = displace_pose(env._first, part.step)
    np.testing.assert_allclose(observation["environment_state"][:7], wanted, atol=1e-3)
    stand = env._start.poses["stand"]
    np.testing.assert_array_equal(observation["environment_state"][7:], stand)
    step = np.array((0.03, 0.0, 0.0, 0.0, 0.0, 0.0))
    hold = motion.events["hold"]
    late = run(motion, hold + 0.3, Moved(moment=hold, step=step))
    assert LEFT in late._scene.held
    away = late._scene.pose("baton")[:3] - late._first[:3]
    assert np.linalg.norm(away) < 0.01


def test_sensors_are_as_bad_as_is_said():
    noise, exact = 2.0, SuiteEnv("handover", fps=FPS)
    env = SuiteEnv("handover", fps=FPS, noise=noise)
    joints, positions, turns = [], [], []
    for seed in range(60):
        (seen, _), (true, _) = env.reset(seed=seed), exact.reset(seed=seed)
        later, *_ = env.step(true["agent_pos"])
        for shown in (seen, later):  # anew at each tick
            errors = shown["environment_state"] - true["environment_state"]
            positions += [errors[:2], errors[7:10]]
            turns += [errors[4:6], errors[11:13]]  # yaw is near zero
        joints.append(seen["agent_pos"] - true["agent_pos"])
        assert not np.array_equal(later["environment_state"], seen["environment_state"])
    assert np.std(joints) == pytest.approx(noise * NOISE_JOINTS, rel=0.1)
    position, turn = np.std(np.concatenate(positions)), 2 * np.std(np.concatenate(turns))
    assert position == pytest.approx(noise * NOISE_POSE[0], rel=0.15)
    assert turn == pytest.approx(noise * NOISE_POSE[3], rel=0.15)


def test_a_start_can_be_chosen_and_impossible_ones_are_refused(motion):
    env, start = SuiteEnv("handover", fps=FPS), start_of(motion)
    observation, info = env.reset(seed=3, options={**start, "other": 1})
    assert info == {"is_success": False}
    np.testing.assert_array_equal(observation["agent_pos"], start["joints"])
    poses = np.concatenate((start["baton"], start["stand"]))
    np.testing.assert_allclose(observation["environment_state"], poses, atol=1e-12)
    drawn = env.reset(seed=3)[0]["environment_state"]
    alone = env.reset(seed=3, options={"stand": start["stand"]})[0]["environment_state"]
    np.testing.assert_array_equal(alone[:7], drawn[:7])
    np.testing.assert_allclose(alone[7:], start["stand"], atol=1e-12)
    refused = (
        ({"baton": np.zeros(6)}, ShapeError, "baton needs 7 values"),
        ({"stand": np.zeros(7)}, DataError, "stand is x, y, z and a unit quaternion"),
        ({"baton": np.full(7, np.nan)}, DataError, "baton is not finite"),
        ({"joints": np.zeros(14)}, ShapeError, "joints needs 17 values"),
        ({"joints": start["joints"] + 4}, DataError, "out of its range"),
    )
    for options, error, message in refused:
        with pytest.raises(error, match=message):
            env.reset(options=options)
