"""Where robots are in a skill that reaches, brings, shakes and rests."""

import numpy as np
import pytest
import torch
from torch import Tensor

from tests.support.motions import ease
from tpgmm_control import Clock, Controller
from tpgmm_control.loop.places import Places
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.regression import Regression
from tpgmm_torch.skills.holding import Holding

END = 17.0


@pytest.fixture(scope="module")
def shaking() -> Regression:
    """Five joints; no posture comes twice, but for the shaking and the pauses."""
    time = np.arange(0, END + 1e-9, 0.1)
    reach, bring = np.array([0.8, -0.5, 0, 0, 0.6]), np.array([0, 0.6, 0.7, -0.8, 0])
    path = np.outer(ease(time, 0, 5), reach) + np.outer(ease(time, 6, 10), bring)
    envelope = ease(time, 10, 10.6) * (1 - ease(time, 15.4, 16))
    path[:, 2:4] += (0.4 * envelope * np.sin(np.pi * (time - 10)))[:, None]
    shifts = np.random.default_rng(0).uniform(-0.03, 0.03, (5, 5))
    demonstrations = [Demonstration(time, path + shift) for shift in shifts]
    return TaskParameterizedGMM(34).fit(demonstrations).skill


def posture(skill: Regression, time: float | Tensor) -> Tensor:
    """Where a robot is that follows."""
    time = torch.as_tensor(time, dtype=torch.float64)
    return skill.estimate(time, torch.zeros(*time.shape, 5, dtype=torch.float64), {}).joints


def found(skill: Regression, joints: Tensor, now: float) -> float | None:
    places, holding = Places(skill, 0.0, END), Holding.start(skill.kinematics, (), (), {})
    return places.find(0, joints.numpy(), now, holding, torch.zeros(5, dtype=torch.float64))


@pytest.mark.parametrize("time", [1.5, 2.0, 3.5, 7.5, 8.5])
@pytest.mark.parametrize("now", [0.5, 6.0, 12.0])
def test_a_posture_is_found_from_anywhere(shaking, time, now):
    assert found(shaking, posture(shaking, time), now) == pytest.approx(time, abs=0.3)


@pytest.mark.parametrize("now", [11.3, 13.3])
def test_of_periods_that_look_alike_the_nearest_is_taken(shaking, now):
    assert found(shaking, posture(shaking, now), now) == pytest.approx(now, abs=0.3)


def test_where_no_time_explains_a_posture_there_is_no_place(shaking):
    away = torch.tensor([0, 0.8, 0, 0, -0.8], dtype=torch.float64)
    assert found(shaking, posture(shaking, 8.0) + away, 8.0) is None


@pytest.mark.parametrize("batch", [(), (3,)])
def test_the_start_may_be_anywhere(shaking, batch):
    clock = Clock(initial="anywhere")
    for time in (2.0, 3.5, 7.5, 8.5):
        joints = posture(shaking, time).expand(*batch, 5)
        controller = Controller(shaking, joints, clock=clock, trust=None)
        assert controller.time.shape == batch
        assert (controller.time - time).abs().max() < 0.3
    away = torch.tensor([0, 0.8, 0, 0, -0.8], dtype=torch.float64)
    controller = Controller(shaking, posture(shaking, 8.0) + away, clock=clock, trust=None)
    assert float(controller.time) == 0.0


def test_robots_that_are_pushed_go_on_from_where_they_are(shaking):
    """Some of them, back or ahead, for 0.4 s; references stay within bounds."""
    start = posture(shaking, torch.zeros(4, dtype=torch.float64))
    bounds = MotionBounds.of(shaking.kinematics, velocity=1.5, acceleration=8.0, jerk=200.0)
    controller, rng = Controller(shaking, start, bounds=bounds), np.random.default_rng(0)
    there = posture(shaking, torch.tensor([2.0, 4.0, 8.2, 4.0], dtype=torch.float64))
    pushed, relocalized = torch.tensor([True, False, True, False]), torch.zeros(4)
    for tick in range(300):
        joints = controller.reference + torch.from_numpy(1e-5 * rng.standard_normal((4, 5)))
        if 200 <= tick < 220:
            joints = torch.where(pushed[:, None], there + 1e-5 * joints, joints)
        before = controller.reference
        command = controller.step(0.02, joints)
        step = (command.reference - before).abs()
        assert bool((step <= bounds.velocity * 0.02 * (1 + 1e-9)).all())
        relocalized += command.relocalized
    assert relocalized.tolist() == [1, 0, 1, 0]
    assert controller.time[1] == pytest.approx(6.0, abs=0.1)
    assert controller.time[0] == pytest.approx(3.6, abs=0.5)
    assert controller.time[2] == pytest.approx(9.8, abs=0.5)
