"""Pour: the expert succeeds, each criterion can fail, and streams fall as they should."""

import math

import numpy as np
import pytest

from lerobot_env_bimanual.suite import pour
from lerobot_env_bimanual.suite.env import SuiteEnv
from lerobot_env_bimanual.suite.tasks import suite_task
from tests.support.suite_expert import tick

FPS = 25
TASK = suite_task("pour")


@pytest.fixture
def env():
    return SuiteEnv("pour", fps=FPS)


def test_the_cup_sways_while_it_is_poured_into():
    motion = TASK.demonstrations(2, seed=5, rate=FPS)[0]
    state = TASK.robot.state(motion.joints)
    begin, end = (tick(motion, event) for event in ("bring", "back"))
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
    lip = np.array((-pour.JUG, pour.JUG_HALF)) @ np.array(
        ((math.cos(turn), math.sin(turn)), (-math.sin(turn), math.cos(turn)))
    )
    for step in range(round(seconds * 100) + 30):
        # it is taken away in time, for the last drops to fall
        late = step >= round(seconds * 100)
        mouth = cup + np.array((beside, -speed * step / 100, pour.CUP_HALF + 0.05))
        scene.put("jug", at(mouth - (0, *lip), 0.0 if late else tilt))
        judge.note(scene, 0.01)
    return judge.figures(scene)


@pytest.mark.parametrize("tilt", [70.0, 90.0])
def test_it_flows_in_proportion_to_the_tilt(env, tilt):
    env.reset(seed=0)
    figures = poured(env, 0.0, tilt, seconds=0.5)
    assert figures["poured"] == pytest.approx(
        pour.FLOW * (tilt - pour.BRIM) * 0.49
    )  # from the second on
    assert figures["spilled"] == 0


def test_the_stream_has_to_meet_the_opening(env):
    env.reset(seed=0)
    inside, outside = (poured(env, share * pour.CUP, 90.0) for share in (0.95, 1.05))
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
