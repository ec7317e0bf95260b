"""Pour: the expert succeeds, each criterion can fail, and streams fall as they should."""

import math

import numpy as np
import pytest

from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.pour import (
    BRIM,
    CUP,
    CUP_HALF,
    FLOW,
    JUG,
    JUG_HALF,
)
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import replay, start_of, tick

FPS = 25
TASK = suite_task("pour")


@pytest.fixture(scope="module")
def motions():
    return TASK.demonstrations(2, seed=5, rate=FPS)


@pytest.fixture
def env():
    return SuiteEnv("pour", fps=FPS)


def failing(info):
    """The criteria that are not met."""
    return {name for name, f in TASK.figures.items() if not f.low <= info[name] <= f.high}


def test_experts_pour_all_of_it(motions, env):
    for seed, motion in enumerate(motions):
        info = replay(env, motion, seed=seed)
        assert info["is_success"] and not failing(info)
        assert info["poured"] > 0.98 and info["poured"] + info["spilled"] == pytest.approx(1)


def test_the_cup_sways_while_it_is_poured_into(motions, env):
    state = TASK.robot.state(motions[0].joints)
    begin, end = (tick(motions[0], event) for event in ("bring", "back"))
    way = state.position("r_hand")[begin:end]
    assert (way.amax(0) - way.amin(0)).norm() > 0.01


def test_jugs_come_from_different_sides():
    """What is free about the vertical, while the mouth stays above the cup."""
    sides, mouths = [], []
    for motion in TASK.demonstrations(4, seed=6, rate=5.0):
        instant = tick(motion, "pour")
        state = TASK.robot.state(motion.joints[instant])
        jug, cup = (state.position(hand) for hand in ("l_hand", "r_hand"))
        away = (jug - cup).tolist()
        sides.append(math.degrees(math.atan2(away[1], away[0])))
        mouths.append(away[2])
    assert max(sides) - min(sides) > 5
    assert max(mouths) - min(mouths) < 0.01


def test_without_a_tilt_nothing_flows(motions, env):
    references = motions[0].joints.numpy()
    info = replay(env, motions[0], references[: tick(motions[0], "bring")])
    assert failing(info) == {"poured"}
    assert info["poured"] == info["spilled"] == 0


def test_half_a_tilt_pours_little(motions, env):
    """The jug stops in the middle of its tilt, and is set upright again."""
    references = motions[0].joints.numpy()
    begin, end = (tick(motions[0], event) for event in ("bring", "tilt"))
    way = references[begin : (begin + end) // 2]
    info = replay(env, motions[0], np.concatenate((references[:begin], way, way[::-1])))
    assert failing(info) == {"poured"}


def test_beside_the_cup_it_is_spilled(motions, env):
    references = motions[0].joints.numpy().copy()
    begin, end = (tick(motions[0], event) for event in ("grip", "bring"))
    share = np.clip((np.arange(len(references)) - begin) / (end - begin), 0, 1)
    references[:, env.joint_names.index("r_shoulder_yaw")] -= 0.25 * share
    info = replay(env, motions[0], references)
    assert {"poured", "spilled"} <= failing(info)
    assert info["held"] == 1


def test_a_cup_that_leans_takes_nothing(motions, env):
    references = motions[0].joints.numpy().copy()
    begin, end = (tick(motions[0], event) for event in ("grip", "bring"))
    share = np.clip((np.arange(len(references)) - begin) / (end - begin), 0, 1)
    references[:, env.joint_names.index("r_forearm_yaw")] += 0.6 * share
    info = replay(env, motions[0], references)
    assert info["cup_deg"] > 20
    assert {"poured", "spilled", "cup_deg"} <= failing(info)


def test_the_jug_has_to_be_upright_in_the_end(motions, env):
    references = motions[0].joints.numpy()
    info = replay(env, motions[0], references[: tick(motions[0], "pour")])
    assert failing(info) == {"jug_deg"} and info["jug_deg"] > 80


def test_without_a_jug_there_is_nothing_to_pour(motions, env):
    references = motions[0].joints.numpy().copy()
    left = [i for i, name in enumerate(env.joint_names) if name.startswith("l_")]
    references[:, left] = references[0, left]
    info = replay(env, motions[0], references)
    assert failing(info) == {"poured", "held"}


def at(position, tilt=0.0):
    """A pose tilted about x [deg]."""
    half = math.radians(tilt) / 2
    return np.array([*position, math.cos(half), math.sin(half), 0.0, 0.0])


def poured(env, beside, tilt, seconds=1.0, lean=0.0, speed=0.0):
    """Figures after a jug was tilted so far, its lip so far beside a cup's middle."""
    scene, judge = env._scene, TASK.judge()
    cup = np.array((0.3, 0.0, 0.5))
    scene.put("cup", at(cup, lean))
    turn = math.radians(tilt)
    lip = np.array((-JUG, JUG_HALF)) @ np.array(
        ((math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn)))
    )
    for step in range(round(seconds * 100) + 30):
        # it is taken away in time, for the last drops to fall
        late = step >= round(seconds * 100)
        mouth = cup + np.array((beside, -speed * step / 100, CUP_HALF + 0.05))
        scene.put("jug", at(mouth - (0, *lip), 0.0 if late else tilt))
        judge.note(scene, 0.01)
    return judge.figures(scene)


@pytest.mark.parametrize("tilt", [70.0, 90.0])
def test_it_flows_in_proportion_to_the_tilt(env, tilt):
    env.reset(seed=0)
    figures = poured(env, 0.0, tilt, seconds=0.5)
    assert figures["poured"] == pytest.approx(FLOW * (tilt - BRIM) * 0.49)  # from the second on
    assert figures["spilled"] == 0


def test_the_stream_has_to_meet_the_opening(env):
    env.reset(seed=0)
    inside, outside = (poured(env, share * CUP, 90.0) for share in (0.95, 1.05))
    assert inside["poured"] > 0.6 and inside["spilled"] == 0
    assert outside["spilled"] == pytest.approx(inside["poured"]) and outside["poured"] == 0
    assert poured(env, 0.0, 90.0, lean=14.0)["spilled"] == 0
    assert poured(env, 0.0, 90.0, lean=16.0)["poured"] == 0


def test_what_leaves_a_moving_jug_flies_on(env):
    """It falls 5 cm in a tenth of a second, and so far it flies at the jug's speed."""
    env.reset(seed=0)
    still = poured(env, 0.0, 90.0, seconds=0.05)
    moving = poured(env, 0.0, 90.0, seconds=0.05, speed=0.5)
    assert still["poured"] > 0 and moving["poured"] == 0
    assert moving["spilled"] == pytest.approx(still["poured"])


def test_cups_and_jugs_are_drawn_where_they_are_usual():
    rng = np.random.default_rng(0)
    for _ in range(50):
        poses = TASK.draw(rng)
        assert TASK.usual(poses["cup"]) and not TASK.usual(poses["jug"])
        assert poses["cup"][2] - CUP_HALF == pytest.approx(poses["jug"][2] - JUG_HALF)
        assert poses["cup"][1] < 0 < poses["jug"][1]


def test_a_seed_stands_for_an_episode(env):
    first, second = (env.reset(seed=3)[0]["environment_state"] for _ in range(2))
    np.testing.assert_array_equal(first, second)
    assert (env.reset(seed=4)[0]["environment_state"] != first).any()
    assert start_of(TASK.demonstrations(1, seed=2, rate=5.0)[0])["cup"].shape == (7,)
