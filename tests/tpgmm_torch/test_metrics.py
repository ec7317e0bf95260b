"""Measures of reproductions, against signals whose answer is known."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.skills import JOINT_NAMES, handlings, hands, wave, waves
from tpgmm_torch import Demonstration, Trajectory
from tpgmm_torch.exceptions import DataError, ShapeError, UnknownNameError
from tpgmm_torch.metrics import (
    joint_rmse,
    largest_acceleration,
    largest_velocity,
    reproduction_scorer,
    sinusoid,
)


def trajectory(time: torch.Tensor, joints: torch.Tensor, names=JOINT_NAMES) -> Trajectory:
    n = joints.shape[1]
    return Trajectory(time, joints, torch.eye(n).expand(len(time), n, n), (), names)


def test_the_error_of_joints_is_their_root_mean_square():
    [wanted] = waves(1)
    shift = torch.tensor([0.3, 0.0, -0.4], dtype=torch.float64)
    moved = trajectory(wanted.time, wanted.joints + shift)
    assert joint_rmse(moved, wanted) == pytest.approx(0.5 / np.sqrt(3))
    assert joint_rmse(trajectory(wanted.time, wanted.joints), wanted) == 0.0


def test_joints_are_compared_by_name():
    [wanted] = waves(1)
    names = JOINT_NAMES[::-1]
    assert joint_rmse(trajectory(wanted.time, wanted.joints.flip(1), names), wanted) == 0.0
    unknown = trajectory(wanted.time, wanted.joints, ("a", "b", "z"))
    with pytest.raises(UnknownNameError, match=r"'z'.*\['a', 'b', 'c'\]"):
        joint_rmse(unknown, wanted)


def test_other_lengths_are_refused():
    [wanted], [longer] = waves(1), waves(1, length=31)
    with pytest.raises(ShapeError, match=r"\(31, 3\).*\(30, 3\)"):
        joint_rmse(trajectory(longer.time, longer.joints), wanted)


def test_the_scorer_is_minus_the_mean_error():
    given = handlings(2)
    errors = [joint_rmse(t, d) for t, d in zip(hands().predict(given), given, strict=True)]
    assert reproduction_scorer(hands(), given) == pytest.approx(-np.mean(errors))
    assert -5e-3 < reproduction_scorer(hands(), given) < 0
    spoilt = [replace(d, joints=d.joints.flip(0)) for d in given]
    assert reproduction_scorer(hands(), spoilt) < -0.1
    with pytest.raises(DataError, match="empty"):
        reproduction_scorer(hands(), [])


@pytest.mark.parametrize("kind", [trajectory, lambda t, q: Demonstration(t, q)])
def test_speed_and_acceleration_are_those_of_a_parabola(kind):
    rng = np.random.default_rng(0)
    time = torch.from_numpy(np.sort(rng.uniform(0, 2, 60)))  # uneven steps
    joints = torch.stack((time, 1.5 * time**2, -3 * time), dim=1)
    motion = kind(time, joints)
    last = float(3 * (time[-1] + time[-2]) / 2)
    assert largest_velocity(motion) == pytest.approx(max(3.0, last))
    assert largest_acceleration(motion) == pytest.approx(3.0, rel=1e-6)


def test_the_speed_of_a_wave_is_its_derivative():
    time = torch.linspace(0, 4, 4001, dtype=torch.float64)
    motion = trajectory(time, wave(time))
    assert largest_velocity(motion) == pytest.approx(3, rel=1e-4)
    assert largest_acceleration(motion) == pytest.approx(9, rel=1e-4)


@pytest.mark.parametrize("frequency", [0.4, 0.667, 1.9, 7.3])
@pytest.mark.parametrize("phase", [0.0, 1.0, -2.5])
def test_a_sinusoid_is_found_again(frequency, phase):
    time = np.linspace(2.0, 6.5, 120)
    found = sinusoid(time, 0.3 + 0.25 * np.sin(2 * np.pi * frequency * time + phase))
    assert found.frequency == pytest.approx(frequency, rel=1e-6)
    assert found.amplitude == pytest.approx(0.25, rel=1e-5)
    assert found.offset == pytest.approx(0.3, abs=1e-5)
    assert np.cos(found.phase - phase) == pytest.approx(1, abs=1e-6)
    assert found.residual < 1e-5


def test_what_a_sinusoid_leaves_is_the_noise():
    time = torch.linspace(0, 4.5, 450, dtype=torch.float64)
    noise = 0.02 * np.random.default_rng(0).standard_normal(450)
    found = sinusoid(time, torch.sin(5 * time) + torch.from_numpy(noise))
    assert found.frequency == pytest.approx(5 / (2 * np.pi), rel=2e-3)
    assert found.amplitude == pytest.approx(1, rel=5e-3)
    assert found.residual == pytest.approx(0.02, rel=0.1)


@pytest.mark.parametrize(
    ("time", "signal"),
    [(np.arange(7), np.arange(7)), (np.arange(9), np.arange(8)), (np.eye(9), np.eye(9))],
)
def test_signals_too_short_or_of_other_shapes_are_refused(time, signal):
    with pytest.raises(ShapeError, match="two equal vectors of 8 or more"):
        sinusoid(time, signal)
