"""The 1-euro filter on poses."""

import math

import numpy as np
import pytest

from tpgmm_control.sensing.pose_filter import OneEuro, PoseFilter
from tpgmm_torch.exceptions import DataError

POSE = np.array([0.4, 0.1, 0.2, 1.0, 0.0, 0.0, 0.0])


def noisy(rng: np.random.Generator, deviation: float, angle: float, pose=POSE) -> np.ndarray:
    out = pose.copy()
    out[:3] += deviation * rng.standard_normal(3)
    out[4:] += angle / 2 * rng.standard_normal(3)
    out[3:] /= np.linalg.norm(out[3:])
    return out


def test_what_stands_still_passes_unchanged():
    state = PoseFilter.first(OneEuro(), POSE)
    for _ in range(5):
        assert state.update(POSE.copy(), 0.01) is state


@pytest.mark.parametrize("jump", [0.0, 0.03])
def test_what_moves_without_noise_passes_unchanged(jump):
    """Quickly, and with a slip of 3 cm in the middle."""
    state = PoseFilter.first(OneEuro(), POSE)
    for k in range(100):
        pose = POSE.copy()
        pose[0] += 0.2 * math.sin(k / 50) + (jump if k > 60 else 0.0)
        state = state.update(pose, 0.01)
        assert np.abs(state.pose - pose).max() < (0.06 * jump if 60 < k < 65 else 0) + 1.5e-4


def test_a_first_order_low_pass_of_constant_cutoff():
    """Of all-noisy input with no slope: the response of the discrete low pass."""
    cutoff, dt = 1.5, 0.02
    settings = OneEuro(cutoff, 0.0, noise=1e-9)
    rng = np.random.default_rng(0)
    state, expected = PoseFilter.first(settings, POSE), POSE[:3]
    share = 1 / (1 + 1 / (2 * math.pi * cutoff * dt))
    for k in range(60):
        seen = POSE + np.concatenate((0.01 * rng.standard_normal(3), np.zeros(4)))
        state = state.update(seen, dt)
        if k < 10:  # the noise is not known yet
            expected = state.pose[:3]
            continue
        expected = expected + share * (seen[:3] - expected)
        assert np.abs(state.pose[:3] - expected).max() < 1e-9


@pytest.mark.parametrize(("rate", "least"), [(25, 2.5), (100, 5.0)])
def test_noise_is_taken_away(rate, least):
    rng, errors = np.random.default_rng(0), []
    state = PoseFilter.first(OneEuro(), noisy(rng, 5e-3, math.radians(2)))
    for k in range(30 * rate):
        seen = noisy(rng, 5e-3, math.radians(2))
        state = state.update(seen, 1 / rate)
        if k > 3 * rate:
            errors.append(np.linalg.norm(state.pose[:3] - POSE[:3]))
            assert abs(np.linalg.norm(state.pose[3:]) - 1) < 1e-12
    assert np.sqrt(np.mean(np.square(errors))) < 5e-3 * math.sqrt(3) / least


@pytest.mark.parametrize("rate", [20, 100, 500])
def test_what_moves_is_followed(rate):
    """Moved by 4 cm within 2 s, with noise: behind by no more than the noise at 25 Hz."""
    rng, state, lag = np.random.default_rng(0), PoseFilter.first(OneEuro(), POSE), []
    for k in range(5 * rate):
        pose = POSE.copy()
        pose[0] += 0.04 * min(max(k / rate - 2, 0) / 2, 1)
        state = state.update(noisy(rng, 2e-3, 0.01, pose), 1 / rate)
        lag.append(state.pose[0] - pose[0])
    # the mean over a quarter of a second: what is no noise
    mean = np.abs(np.mean(np.reshape(lag, (20, -1)), axis=1))
    assert mean.max() < 6e-3
    assert mean[-1] < 1.5e-3


def test_each_side_of_a_quaternion_is_one_rotation():
    rng = np.random.default_rng(1)
    one = other = PoseFilter.first(OneEuro(), POSE)
    for k in range(30):
        seen = noisy(rng, 1e-3, 0.1)
        flipped = np.concatenate((seen[:3], -seen[3:])) if k % 2 else seen
        one, other = one.update(seen, 0.02), other.update(flipped, 0.02)
        assert np.abs(one.pose - other.pose).max() < 1e-15


def test_robots_do_not_know_of_each_other():
    rng = np.random.default_rng(2)
    start = np.stack([POSE, POSE])
    batch, alone = PoseFilter.first(OneEuro(), start), [PoseFilter.first(OneEuro(), POSE)] * 2
    for _ in range(20):
        seen = np.stack([noisy(rng, 0.01, 0.1), noisy(rng, 1e-3, 0.01)])
        batch = batch.update(seen, 0.02)
        alone = [one.update(pose, 0.02) for one, pose in zip(alone, seen, strict=True)]
        assert np.abs(batch.pose - np.stack([one.pose for one in alone])).max() < 1e-15


def test_no_filter():
    state = PoseFilter.first(OneEuro(cutoff=math.inf), POSE).update(POSE + 0.1, 0.02)
    assert state.pose.tolist() == (POSE + 0.1).tolist()


def test_settings():
    with pytest.raises(DataError, match="cutoff of OneEuro"):
        OneEuro(cutoff=0)
