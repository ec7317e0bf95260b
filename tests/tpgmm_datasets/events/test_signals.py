"""Grippers and forces: when the longest stretch begins and ends, whatever else is there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tpgmm_datasets.events import SignalEvent, gripper_signals
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.events import LEAST_CONFIDENCE
from tpgmm_torch.exceptions import DataError

TIME = np.arange(0, 12, 1 / 30)
CLOSES, OPENS = 4.0, 9.0


def shown(*signals, names=None):
    names = names or [f"finger_{n}" for n in range(len(signals))]
    return Demonstration(TIME, np.stack(signals, axis=1), joint_names=names)


def opening(change=0.3):
    """Open, closed from 4 to 9 s, open: 1, 0.2, 1; each change is that long [s]."""
    points = [0, CLOSES - change / 2, CLOSES + change / 2, OPENS - change / 2]
    return np.interp(TIME, [*points, OPENS + change / 2], [1, 1, 0.2, 0.2, 1])


def both(signal, level="low"):
    found = [
        SignalEvent(("finger_0",), edge, level).find(shown(signal)) for edge in ("begin", "end")
    ]
    return [one.time for one in found], [one.confidence for one in found]


def noise(scale):
    return scale * np.random.default_rng(0).normal(size=len(TIME))


SPOILT = {
    "as it is": lambda x: x,
    "noise": lambda x: x + noise(0.05),
    "chatter": lambda x: np.where(np.arange(len(x)) % 29 == 0, 1.2 - x, x),
    "drift": lambda x: x + 0.02 * TIME,
    "closed at first": lambda x: np.where(TIME < 2, 0.2, x),
    "half closed at first": lambda x: np.where(TIME < 2, 0.6, x),
    "closed again in the end": lambda x: np.where(TIME > 10.5, 0.2, x),
    "closed less": lambda x: np.where(TIME < 6, np.maximum(x, 0.35), x),
    "an offset": lambda x: x + 1.5,
}


@pytest.mark.parametrize("kind", SPOILT)
def test_a_grasp_is_found_whatever_the_signal_does_besides(kind):
    times, confidences = both(SPOILT[kind](opening()))
    assert times == pytest.approx([CLOSES, OPENS], abs=0.15)
    assert min(confidences) > 0.4


@given(scale=st.floats(1e-3, 1e3), offset=st.floats(-1, 1), shift=st.floats(-2, 2))
def test_units_and_clocks_do_not_matter(scale, offset, shift):
    signal = opening() + noise(0.01)
    one = SignalEvent(("finger_0",))
    found = one.find(shown(signal))
    there = Demonstration(
        TIME + shift, scale * (signal + offset)[:, None], joint_names=["finger_0"]
    )
    other = one.find(there)
    assert other.time == pytest.approx(found.time + shift, abs=1e-6)
    assert other.confidence == pytest.approx(found.confidence, abs=1e-6)


def test_a_gripper_that_is_closed_from_the_start_has_opened_and_not_closed():
    (close, opened), (not_at_all, sure) = both(np.where(TIME < CLOSES, 0.2, 1.0))
    assert opened == pytest.approx(CLOSES, abs=0.05) and sure > 0.9
    assert np.isnan(close) and not_at_all == 0


NOTHING = {
    "still": np.full(len(TIME), 0.7),
    "noise": 0.7 + noise(0.01),
    "a slow drift": 1 - 0.05 * TIME,
    "many closings alike": np.cos(4 * TIME),
    "a small step of a large value": 100 + (TIME > 4),
}


@pytest.mark.parametrize("kind", NOTHING)
def test_what_is_no_grasp_has_no_confidence(kind):
    assert max(both(NOTHING[kind])[1]) < LEAST_CONFIDENCE


def test_confidence_falls_with_noise_slowness_and_rivals():
    def confidence(signal):
        return both(signal)[1][0]

    noisy = [confidence(opening() + noise(scale)) for scale in (0.05, 0.1, 0.2)]
    slow = [confidence(opening(change)) for change in (0.1, 0.5, 1.0, 2.0)]
    rival = [
        confidence(np.where((TIME > 1) & (width > TIME - 1), 0.2, opening()))
        for width in (0.0, 0.5, 1.0, 2.0)
    ]
    for falling in (noisy, slow, rival):
        assert (np.diff(falling) < 0).all()


def test_the_fingers_of_a_hand_are_one_signal():
    rng = np.random.default_rng(1)
    fingers = [opening() * size + 0.1 * rng.random() for size in (0.5, 0.8, 1.0)]
    thumb = 0.05 * rng.normal(size=len(TIME))  # has nothing to do with it
    hand = shown(*fingers, thumb)
    found = SignalEvent(("finger_*",)).find(hand)
    assert found.time == pytest.approx(CLOSES, abs=0.1) and found.confidence > 0.6


def test_signals_that_are_not_there_are_named():
    with pytest.raises(DataError, match=r"'jaw'; there are \['finger_0'\]"):
        SignalEvent(("jaw",)).find(shown(opening()))
    with pytest.raises(DataError, match="edge is one of"):
        SignalEvent(("jaw",), "middle")
    with pytest.raises(DataError, match="level is one of"):
        SignalEvent(("jaw",), "end", "middle")


def test_grippers_are_known_by_name_and_side():
    g1 = ["kLeftElbow", "kLeftHandPinky", "kRightHandPinky", "kRightHandThumbBend"]
    right = "kRightHandPinky", "kRightHandThumbBend"
    assert gripper_signals(g1, "right_rubber_hand") == right
    assert gripper_signals(g1, "l_hand") == ("kLeftHandPinky",)
    assert gripper_signals(["elbow", "gripper.pos"], "left_hand") == ("gripper.pos",)
    assert gripper_signals(["elbow", "gripper.pos"]) == ("gripper.pos",)
    tracked = [f"gripper.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    assert gripper_signals([*tracked, "l_gripper"], "l_hand") == ("l_gripper",)
    with pytest.raises(DataError, match="of both hands"):
        gripper_signals(g1, "hand")
    for names in (["elbow"], tracked, ["r_gripper"]):
        with pytest.raises(DataError, match="no signal is called a gripper's"):
            gripper_signals(names, "l_hand")
