"""What all detectors share: hysteresis, and events that are left out and told of."""

import warnings
from dataclasses import replace

import numpy as np
import pytest

from tpgmm_datasets import check
from tpgmm_datasets.events import Detection, SignalEvent, find_events
from tpgmm_torch.data.demonstrations import Demonstration
from tpgmm_torch.events import high_stretches
from tpgmm_torch.exceptions import DataError, PlausibilityWarning

TIME = np.arange(0, 10, 0.05)
CLOSE = {"close": SignalEvent(("gripper",))}


def gripping(closes, opens=8.0, seed=0):
    """A gripper that is closed for a while, with noise; None for one that never moves."""
    rng = np.random.default_rng(seed)
    opening = np.full(len(TIME), 1.0)
    if closes is not None:
        opening[(closes <= TIME) & (opens > TIME)] = 0.2
    opening += 0.01 * rng.normal(size=len(TIME))
    joints = np.stack([np.sin(TIME), opening], axis=1)
    return Demonstration(TIME, joints, joint_names=["elbow", "gripper"])


@pytest.mark.parametrize(
    "values, expected",
    [
        ([0, 1, 1, 0], [(1, 3)]),
        ([0, 1, 0.5, 1, 0.5, 0.1, 0.5], [(1, 5)]),
        ([0.5, 0.5, 0.1], []),
        ([1, 0, 0, 1, 1], [(0, 1), (3, 5)]),
        ([0.5, 0.9], [(1, 2)]),
    ],
)
def test_between_the_thresholds_nothing_changes(values, expected):
    assert high_stretches(np.array(values, dtype=float), on=0.7, off=0.3) == expected


def test_what_is_found_with_confidence_is_an_event():
    instants = [2.0, 3.5, 4.0, 3.0]
    shown = [gripping(at, seed=n) for n, at in enumerate(instants)]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        found = find_events(shown, CLOSE)
    assert [d.events["close"] for d in found] == pytest.approx(instants, abs=0.06)


def test_doubtful_events_are_left_out_and_named_in_one_warning():
    shown = [gripping(at, seed=n) for n, at in enumerate([2.0, None, 4.0, None, 3.0])]
    with pytest.warns(PlausibilityWarning) as caught:
        found = find_events(shown, CLOSE)
    assert [sorted(d.events) for d in found] == [["close"], [], ["close"], [], ["close"]]
    [message] = [str(warning.message) for warning in caught]
    assert "'close'" in message
    assert "in demonstrations 1, 3 (there 0." in message
    assert caught[0].filename == __file__


def test_events_that_were_spoilt_in_a_fifth_of_the_episodes_are_named():
    rng = np.random.default_rng(0)
    shown = [gripping(at, seed=n) for n, at in enumerate(rng.uniform(3, 4, size=20))]
    found = find_events(shown, CLOSE)
    assert len(check(found)) == 0
    spoilt = [2, 7, 11, 18]
    for n, at in zip(spoilt, [0.0, 0.0, 9.8, 0.0], strict=True):
        found[n] = replace(found[n], events={"close": at})
    [finding] = [f for f in check(found) if f.check == "events"]
    assert finding.episodes == tuple(spoilt)


def test_nothing_can_be_found_in_one_step():
    with pytest.raises(DataError, match="one time step"):
        CLOSE["close"].find(Demonstration([0.0], [[0.0]], joint_names=["gripper"]))


def test_a_detection_without_a_time_is_none():
    assert not Detection(float("nan"), 1.0).certain
    assert not Detection(1.0, 0.1).certain
    assert Detection(1.0, 0.3).certain
