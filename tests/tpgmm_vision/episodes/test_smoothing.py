"""Smoothing over an episode: rests, gaps, and what a hand carries."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tpgmm_torch.exceptions import DataError
from tpgmm_vision.episodes.smoothing import Track
from tpgmm_vision.poses import inverse, rigid

FPS, NOISE, TURN = 25, 0.0015, np.radians(0.5)
TIME = np.arange(250) / FPS
#: When the hand takes the object, and when it lets go [s].
TAKEN, PUT = 3.0, 6.2


def smooth_step(share):
    share = np.clip(share, 0, 1)
    return share**2 * (3 - 2 * share)


def carried(seed):
    """Poses of a hand and of an object that it carries, true and with the noise of a camera."""
    parts = ((0, 2.5), (TAKEN, 3), (6.5, 2))
    shares = [smooth_step((TIME - begin) / length)[:, None] for begin, length in parts]
    come, go, leave = shares
    way = np.array([[0.1, -0.3, 0.4], [0.3, 0, 0.1], [0.35, 0.25, 0.12], [0.1, 0.2, 0.4]])
    place = way[0] + sum(a * b for a, b in zip(shares, np.diff(way, axis=0), strict=True))
    place[:, 2] += 0.15 * np.sin(np.pi * go[:, 0]) ** 2
    yaw = 0.5 * come[:, 0] + 0.8 * go[:, 0] - 0.4 * leave[:, 0]
    hand = np.array([rigid([0.3 * a, 0.1, a], p) for a, p in zip(yaw, place, strict=True)])
    first, last = int(TAKEN * FPS), int(PUT * FPS)
    grasp = inverse(hand[first]) @ rigid([0, 0, 0.7], way[1] + [0, 0, 0.05])
    true = hand[np.clip(np.arange(len(TIME)), first, last)] @ grasp
    rng, noisy = np.random.default_rng(seed), true.copy()
    noisy[:, :3, 3] += rng.normal(scale=NOISE, size=(len(TIME), 3))
    turns = Rotation.from_rotvec(rng.normal(scale=TURN, size=(len(TIME), 3)))
    noisy[:, :3, :3] = turns.as_matrix() @ true[:, :3, :3]
    other = np.array([rigid([0, 0, 0.1 * t], [0.1 * t, 0, 1]) for t in TIME])
    return noisy, true, {"other": other, "hand": hand}


def smoothed(noisy, seen, hands):
    track = Track(TIME)
    track.poses[seen], track.seen[:] = noisy[seen], seen
    track.smooth(hands)
    return track


def errors(track, true):
    return np.linalg.norm(track.poses[:, :3, 3] - true[:, :3, 3], axis=1)


@pytest.mark.parametrize("seed", range(3))
def test_at_rest_noise_is_averaged_and_the_pose_is_constant(seed):
    noisy, true, hands = carried(seed)
    track = smoothed(noisy, np.ones(len(TIME), bool), hands)
    rest = TIME < TAKEN - 0.1
    assert errors(track, true)[rest].max() < NOISE / 2
    assert np.ptp(track.poses[rest], axis=0).max() == 0
    moving = (TIME > TAKEN + 0.6) & (TIME < TAKEN + 2.4)
    assert np.array_equal(track.poses[moving], noisy[moving])  # as measured
    assert track.spread == pytest.approx(np.sqrt(3) * NOISE, rel=0.3)


@pytest.mark.parametrize(
    ("begin", "end"),
    [(2.2, 6.8), (4.0, 5.0), (4.0, 6.8), (2.2, 4.0), (0.0, 0.4)],
    ids=["whole way", "on the way", "while put down", "while taken", "at first"],
)
@pytest.mark.parametrize("seed", range(3))
def test_what_a_hand_carries_is_known_while_it_is_covered(begin, end, seed):
    noisy, true, hands = carried(seed)
    seen = ~((begin <= TIME) & (end > TIME))
    track = smoothed(noisy, seen, hands)
    assert track.known.all()
    assert not track.seen[~seen].any()
    assert errors(track, true)[~seen].max() < 2 * NOISE


def test_without_the_hand_a_gap_on_the_way_stays_unknown():
    noisy, _, _ = carried(0)
    seen = ~((TIME > 4) & (TIME < 5))
    track = smoothed(noisy, seen, {})
    assert not track.known[~seen].any()
    last = np.flatnonzero(seen & (TIME <= 4))[-1]
    assert (track.poses[~seen] == track.poses[last]).all()


def test_a_hand_that_went_another_way_explains_nothing():
    noisy, _, hands = carried(0)
    seen = ~((TIME > 4) & (TIME < 5))
    assert not smoothed(noisy, seen, {"other": hands["other"]}).known[~seen].any()


def test_lost_frames_are_filled_and_short_gaps_in_a_motion_interpolated():
    noisy, true, hands = carried(1)
    seen = np.random.default_rng(0).random(len(TIME)) > 0.3
    seen[0] = True
    for given in ({}, hands):
        track = smoothed(noisy, seen, given)
        assert track.known.mean() > 0.95
        assert errors(track, true)[track.known & ~seen].max() < 4 * NOISE


def test_a_gap_at_the_end_is_unknown_at_rest_and_goes_on_with_the_hand_in_motion():
    noisy, true, hands = carried(0)
    track = smoothed(noisy, TIME < 2, hands)
    assert not track.known[TIME >= 2].any()
    track = smoothed(noisy, TIME < 4.5, hands)
    assert track.known.all()
    assert errors(track, true)[(TIME > 4.5) & (TIME < PUT)].max() < 3 * NOISE


def test_a_slow_motion_is_no_rest():
    poses = np.array([rigid([0, 0, 0], [0.01 * t, 0, 0]) for t in TIME])  # 1 cm a second
    track = smoothed(poses, np.ones(len(TIME), bool), {})
    assert errors(track, poses).max() < 1e-9


def test_what_was_never_seen_or_first_seen_late_is_refused():
    noisy, _, hands = carried(0)
    late = r"first seen {}\.00 s after the start, "
    for seen, given, message in (
        (TIME < 0, hands, "never seen"),
        (TIME >= 2.8, hands, r"first seen 2\.80 s after the start, standing, and a"),
        (TIME >= 1, {}, late.format(1) + "standing, and a"),  # nobody knows where hands were
        (TIME >= 4, hands, late.format(4) + "moving"),
    ):
        with pytest.raises(DataError, match=message):
            smoothed(noisy, seen, given)


def test_what_no_hand_has_touched_stood_where_it_is_first_seen():
    noisy, true, hands = carried(0)
    noisy[24:28, 0, 3] += 0.0025  # half hidden still
    track = smoothed(noisy, TIME >= 24 / FPS, hands)
    assert track.known.all() and not track.seen[:24].any()
    assert errors(track, true)[TIME < 2].max() < NOISE
