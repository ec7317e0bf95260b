import numpy as np
import pytest

from tpgmm_vision.detection.estimation import PoseEstimate
from tpgmm_vision.detection.tracker import Tracker
from tpgmm_vision.poses import rigid

TICK = 0.04


def found(position, turn=(0.0, 0.0, 0.0), *, valid=True, reason="", alternative=None):
    pose, covariance = rigid(turn, position), np.diag([1e-6] * 3 + [1e-5] * 3)
    return PoseEstimate(pose, covariance, 0.05, valid, reason, (3,), alternative)


def test_what_is_seen_is_passed_on_and_what_moves_is_followed():
    tracker = Tracker()
    assert tracker.update(None, 0.0, "no tag of it is seen") is None
    for tick in range(50):
        position = (0.3 + 0.02 * tick, 0.0, 0.1)  # half a metre per second
        track = tracker.update(found(position), TICK * tick)
        assert track.valid and np.allclose(track.pose[:3, 3], position)


def test_what_is_not_seen_is_where_it_was_and_not_valid():
    tracker = Tracker()
    first = tracker.update(found((0.3, 0, 0.1)), 0.0)
    lost = tracker.update(None, 0.24, "no tag of it is seen")
    assert not lost.valid and lost.reason == "no tag of it is seen, for 0.2 s"
    np.testing.assert_array_equal(lost.pose, first.pose)


@pytest.mark.parametrize("turn", [(0, 0, 0), (2.0, 0, 0)])
def test_a_jump_counts_when_three_in_a_row_agree(turn):
    tracker, there = Tracker(), (0.5, 0.2, 0.1)
    tracker.update(found((0.3, 0, 0.1)), 0.0)
    for tick in (1, 2):
        assert np.allclose(
            tracker.update(found(there, turn), TICK * tick).pose[:3, 3], (0.3, 0, 0.1)
        )
    assert np.allclose(tracker.update(found(there, turn), 3 * TICK).pose[:3, 3], there)


def test_single_outliers_never_count():
    tracker, rng = Tracker(), np.random.default_rng(0)
    for tick in range(100):
        outlier = tick % 3 == 1
        position = rng.uniform(0.5, 1, 3) if outlier else (0.3, 0.0, 0.1)
        track = tracker.update(found(position), TICK * tick)
        assert track.valid != outlier and np.allclose(track.pose[:3, 3], (0.3, 0, 0.1))


def test_of_two_poses_the_one_counts_that_was_seen_shortly_before():
    right, wrong = (0.1, 0.0, 0.0), (-0.6, 0.2, 0.0)
    both = found(
        (0.3, 0, 0.1), wrong, valid=False, reason="two", alternative=rigid(right, (0.3, 0, 0.1))
    )
    tracker = Tracker()
    assert tracker.update(both, 0.0) is None
    tracker.update(found((0.3, 0, 0.1), right), TICK)
    track = tracker.update(both, 2 * TICK)
    assert track.valid and np.allclose(track.pose, rigid(right, (0.3, 0, 0.1)))
    late = tracker.update(both, 2 * TICK + 0.6)
    assert not late.valid and late.reason.startswith("two")
