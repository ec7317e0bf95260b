"""Objects that are moved, and links that stop."""

import numpy as np
import pytest

from tpgmm_datasets.events import ObjectMoves, Stop
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.data.frames import Frame
from tpgmm_torch.events import LEAST_CONFIDENCE
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.robots.tracked_poses import Poses

TIME = np.arange(0, 10, 0.02)
HAND = Poses(["hand"])


def carried(way, noise=0.0):
    rng = np.random.default_rng(0)
    position = np.outer(way, [0.6, 0.0, 0.8]) + noise * rng.normal(size=(len(TIME), 3))
    return Demonstration(TIME, TIME[:, None], {"cup": Frame(position)})


@pytest.mark.parametrize("noise", [0.0, 0.001])
def test_an_object_moves_when_it_leaves_its_place(noise):
    found = ObjectMoves("cup").find(carried(np.interp(TIME, [4, 6], [0, 0.3]), noise))
    assert found.time == pytest.approx(4, abs=0.1)
    assert found.confidence > 0.8


def test_an_object_that_lies_still_or_is_jolted_has_no_event():
    assert ObjectMoves("cup").find(carried(0 * TIME)).confidence == 0
    for way, noise in ((0 * TIME, 0.0005), (0.05 * np.exp(-(((TIME - 4) / 0.1) ** 2)), 0.0)):
        assert ObjectMoves("cup").find(carried(way, noise)).confidence < LEAST_CONFIDENCE


def test_an_object_that_was_recorded_once_cannot_be_asked():
    still = Demonstration(TIME, TIME[:, None], {"cup": Frame([0, 0, 0])})
    with pytest.raises(DataError, match="'cup' was recorded once"):
        ObjectMoves("cup").find(still)
    with pytest.raises(UnknownNameError, match="'mug'"):
        ObjectMoves("mug").find(still)


def halting(*rests):
    """A hand that moves at 0.1 m/s, and rests during the intervals."""
    speed = np.full(len(TIME), 0.1)
    for start, stop in rests:
        speed[(start <= TIME) & (stop > TIME)] = 0
    position = np.outer(np.cumsum(speed) * 0.02, [0, 1, 0])
    joints = Poses.joints({"hand": Frame(position)})
    return Demonstration(TIME, joints, joint_names=HAND.joint_names)


def test_the_longest_stop_and_stops_by_number():
    shown = halting((1, 1.6), (3, 4.8), (7, 8))
    found = Stop("hand").find(shown, HAND)
    assert found.time == pytest.approx(3, abs=0.15)
    assert 0.3 < found.confidence < 0.6  # another is more than half as long
    for number, start in ((1, 1), (2, 3), (3, 7)):
        found = Stop("hand", number).find(shown, HAND)
        assert found.time == pytest.approx(start, abs=0.15) and found.confidence > 0.8
    assert Stop("hand", 4).find(shown, HAND).confidence == 0


def test_rest_at_the_ends_is_no_stop():
    assert Stop("hand").find(halting((0, 2), (8, 10)), HAND).confidence == 0
    assert Stop("hand").find(halting(), HAND).confidence == 0
    assert Stop("hand").find(halting((0, 10)), HAND).confidence == 0


def test_stops_need_a_robot_with_that_link():
    with pytest.raises(DataError, match="needs the robot"):
        Stop("hand").find(halting())
    with pytest.raises(UnknownNameError, match="'foot'"):
        Stop("foot").find(halting(), HAND)
