"""Peaks of acceleration and jerk, with and without noise."""

import numpy as np
import pytest

from tpgmm_torch import Demonstration
from tpgmm_torch.motion.demonstrated_peaks import joint_peaks, typical_peaks

NAMES = ("a", "b")


def demonstrated_peaks(demonstrations, names):
    return typical_peaks([joint_peaks(one.reorder(names)) for one in demonstrations])


def swing(amplitude=0.5, rate=100.0, noise=0.0, seed=0, order=NAMES, uneven=False):
    """Joint a swings at 3 rad/s, joint b stands."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, 6, 1 / rate)
    if uneven:
        time = np.sort(time + 0.3 / rate * rng.uniform(size=len(time)))
    joints = {"a": amplitude * np.sin(3 * time), "b": np.full_like(time, 0.7)}
    columns = np.stack([joints[name] for name in order], 1)
    return Demonstration(
        time, columns + noise * rng.standard_normal(columns.shape), joint_names=order
    )


@pytest.mark.parametrize("rate", [30.0, 100.0, 500.0])
@pytest.mark.parametrize("uneven", [False, True])
def test_peaks_of_a_smooth_motion_are_its_own(rate, uneven):
    acceleration, jerk = demonstrated_peaks([swing(rate=rate, uneven=uneven)], NAMES)
    np.testing.assert_allclose(acceleration.numpy(), [4.5, 0], atol=0.2)
    np.testing.assert_allclose(jerk.numpy(), [13.5, 0], atol=1.5)


def test_noise_is_not_motion():
    # 1 mrad at 100 Hz: second differences of 24 rad/s^2, third ones of 4500 rad/s^3
    noisy = [swing(noise=1e-3, seed=seed) for seed in range(5)]
    assert float(noisy[0].joints.diff(n=2, dim=0).abs().max()) * 1e4 > 30
    acceleration, jerk = demonstrated_peaks(noisy, NAMES)
    np.testing.assert_allclose(acceleration.numpy(), [4.5, 0], atol=0.6)
    np.testing.assert_allclose(jerk.numpy(), [13.5, 0], atol=20)


def test_one_broken_demonstration_of_many_does_not_count():
    broken = swing()
    joints = broken.joints.clone()
    joints[200:203] += 3.0
    spoiled = Demonstration(broken.time, joints, joint_names=NAMES)
    assert float(demonstrated_peaks([spoiled], NAMES)[0][0]) > 100
    shown = [spoiled, *(swing(1 + 0.01 * k) for k in range(10))]
    assert 9 < float(demonstrated_peaks(shown, NAMES)[0][0]) < 10


def test_what_is_too_short_tells_nothing():
    short = Demonstration(np.arange(5) * 0.1, np.random.default_rng(0).normal(size=(5, 2)))
    assert [peak.tolist() for peak in demonstrated_peaks([short], NAMES)] == [[0, 0], [0, 0]]
