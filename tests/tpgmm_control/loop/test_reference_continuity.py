"""References move within their bounds, whatever servos, sensors and loops do."""

import numpy as np
import pytest

from tpgmm_evaluation.faults.drawing import HALVES, Fault, Run
from tpgmm_evaluation.faults.measures import measure_runs
from tpgmm_evaluation.faults.servos import Servo

pytestmark = pytest.mark.slow

ALL, ONE = np.ones(4), np.eye(4)[1]
BOUNDS = ("position", "speed", "acceleration", "jerk", "infinite", "raised")

CASES = {
    "nothing is wrong": (50, Servo(), []),
    "a joint sags": (50, Servo(sag=0.2 * ONE), []),
    "a payload is picked up": (50, Servo(), [Fault("payload", 1.5, np.inf, ONE, 0.2)]),
    "an encoder slips": (50, Servo(), [Fault("offset", 1.5, np.inf, ONE, 0.2)]),
    "one sample is off": (100, Servo(), [Fault("offset", 1.2, 1.205, ONE, -0.09)]),
    "samples are off": (100, Servo(), [Fault("offset", 1.2, 1.245, ONE, 0.3)]),
    "the loop stalls": (100, Servo(), [Fault("stall", 1.2, 1.2, ALL, 0.3)]),
    "encoders are dead for a moment": (100, Servo(), [Fault("zeros", 1.2, 1.32, ALL)]),
    "encoders are dead for a second": (100, Servo(), [Fault("zeros", 1.2, 2.2, ALL)]),
    "readings are in degrees": (50, Servo(), [Fault("units", 1.4, 2.6, ALL, 1)]),
    "readings are taken for degrees": (50, Servo(), [Fault("units", 1.4, 2.6, ALL, -1)]),
    "readings are frozen": (50, Servo(), [Fault("frozen", 1.2, 2.2, ALL)]),
    "somebody stops it": (50, Servo(), [Fault("stop", 1.0, 4.0, ALL)]),
    "somebody pushes it back": (50, Servo(), [Fault("push", 3.3, 3.8, ALL, -2.0)]),
    "somebody pushes it ahead": (50, Servo(), [Fault("push", 1.0, 1.5, ALL, 2.0)]),
}


def measures(rate, servo, faults, robot="four joints"):
    """Of one run."""
    run = Run(robot, rate, servo, faults, 0, np.random.default_rng(0))
    [(_, found)] = measure_runs([run])
    return found


@pytest.mark.parametrize("case", CASES)
def test_references_are_continuous_and_the_skill_ends(case):
    found = measures(*CASES[case])
    assert {name: found[name] for name in BOUNDS} == dict.fromkeys(BOUNDS, 0)
    assert not found["open"]
    assert found["runaway"] < 0.05


@pytest.mark.parametrize("rate", [50, 200])
def test_a_gripper_of_which_readings_tell_nothing_keeps_no_robot_held(rate):
    dead = Fault("zeros", 3.77, 5.09, np.ones(3))
    assert not measures(rate, Servo(lag=0.04), [dead], "gripper")["open"]


@pytest.mark.parametrize("size", [0.05, -0.1, 0.2, -0.35])
@pytest.mark.parametrize("begin", [0.3, 1.5, 3.0])
def test_an_offset_that_stays_is_no_reason_to_stop(size, begin):
    joint = int(10 * begin) % 4
    found = measures(50, Servo(), [Fault("offset", begin, np.inf, np.eye(4)[joint], size)])
    assert {name: found[name] for name in BOUNDS} == dict.fromkeys(BOUNDS, 0)
    assert np.isfinite(found["late"])
    assert found["runaway"] < 0.01  # within 1.5 times the offset


@pytest.mark.parametrize("lag", [0.02, 0.08, 0.2, 0.4])
@pytest.mark.parametrize("begin", [0.5, 1.3, 2.9, 3.6])  # 2 to 3 s it rests
def test_a_stopped_robot_is_not_led_far(lag, begin):
    found = measures(50, Servo(lag=lag), [Fault("stop", begin, begin + 3, ALL)])
    # of which braking from 0.8 rad/s within the bound of 8 rad/s^2 takes 0.04
    assert found["gap"] <= 0.12


@pytest.mark.parametrize("robot", ["four joints", "gripper"])
def test_whatever_is_drawn_references_keep_bounds_and_the_status_is_true(robot):
    """A few of those that ``python -m tpgmm_evaluation.faults`` draws."""
    found = measure_runs([Run.draw(HALVES[0], seed, [50.0], [robot]) for seed in range(10)])
    for run, one in found:
        assert {name: one[name] for name in BOUNDS} == dict.fromkeys(BOUNDS, 0), str(run)
        assert not one["open"], str(run)
    # what a hand drags away slowly is taken for an offset, and called one when the hand is gone
    found = [(run, m) for run, m in found if not any(f.kind == "drag" for f in run.faults)]
    assert sum(one["false"] for _, one in found) <= 0.01 * sum(m["ticks"] for _, m in found)
