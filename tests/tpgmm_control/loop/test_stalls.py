"""Every skill ends, or says for which joint it waits: soft drives, contact, grippers."""

import numpy as np
import pytest

from tests.tpgmm_control.loop.test_reference_continuity import BOUNDS, measures
from tpgmm_evaluation.faults.drawing import Fault
from tpgmm_evaluation.faults.servos import Servo
from tpgmm_evaluation.faults.skills import situations

pytestmark = pytest.mark.slow

LAGS = (0.02, 0.14, 0.4)


def touched(size):
    """Something stands in the way of a joint of the arm with a gripper, when it arrives."""
    way = np.sign(np.diff(situations("gripper")[0].path[[50, 100], 1])) * np.eye(3)[1]
    return Fault("contact", 1.5, 3.0, way, size)


@pytest.mark.parametrize("lag", LAGS)
@pytest.mark.parametrize("size", [0.02, 0.045, 0.1])
def test_contact_while_a_gripper_closes_on_something(size, lag):
    grasped = Fault("grasp", 2.1, 100.0, np.eye(3)[2], 0.8)  # and does not open again
    found = measures(20, Servo(lag=lag), [touched(size), grasped], "gripper")
    assert {name: found[name] for name in BOUNDS} == dict.fromkeys(BOUNDS, 0)
    assert not found["open"]


@pytest.mark.parametrize("lag", LAGS)
def test_contact_alone(lag):
    found = measures(50, Servo(lag=lag), [touched(0.045)], "gripper")
    assert not found["open"]


@pytest.mark.parametrize("robot", ["four joints", "seven joints", "gripper"])
@pytest.mark.parametrize("lag", LAGS)
def test_soft_drives_reach_the_end(lag, robot):
    found = measures(50, Servo(lag=lag), [], robot)
    assert found["late"] < 1.0
    assert not found["false"]


@pytest.mark.parametrize("stiction", [0.02, 0.045, 0.08])
def test_joints_that_stick_are_named_or_reached(stiction):
    found = measures(50, Servo(stiction=stiction), [])
    assert not found["open"]
