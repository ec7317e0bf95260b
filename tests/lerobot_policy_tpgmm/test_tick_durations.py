import math

import pytest
import torch

from lerobot_policy_tpgmm.tick_durations import TICKS, TickDurations

USUAL = 0.01


def measure(*timestamps: float) -> list[float]:
    """For how long the reference of each tick of one robot is."""
    ticks = TickDurations()
    seen = torch.tensor(timestamps, dtype=torch.float64).reshape(-1, 1, 1)
    return [float(ticks.next(now, USUAL)) for now in seen]


def times(*durations: float) -> list[float]:
    return [0.0, *torch.tensor(durations).double().cumsum(0).tolist()]


@pytest.mark.parametrize("duration", [0.002, 0.01, 0.05])
def test_equal_ticks_have_their_length_from_the_first_on(duration):
    first, *others = measure(*times(*[duration] * 50))
    assert first == USUAL
    assert others == pytest.approx([duration] * 50, rel=1e-6)


def test_a_late_tick_is_caught_up_in_equal_parts_and_wholly():
    durations = [USUAL] * 30 + [3 * USUAL] + [USUAL] * 30
    _, *passed = measure(*times(*durations))
    late = USUAL * (1 + 2 / TICKS)
    wanted = [USUAL] * 30 + [late] * TICKS + [USUAL] * (31 - TICKS)
    assert passed == pytest.approx(wanted, rel=1e-6)
    assert sum(passed) == pytest.approx(sum(durations), rel=1e-6)


def test_irregular_ticks_lose_no_time_and_pass_evenly():
    draw = torch.rand(2, 1000, generator=torch.manual_seed(0))
    durations = USUAL * (0.5 + draw[0] + (draw[1] < 0.1)).double()
    _, *passed = measure(*times(*durations.tolist()))
    assert sum(passed) == pytest.approx(float(durations.sum()), abs=2 * USUAL)
    assert torch.tensor(passed[TICKS:]).std() < 0.3 * durations.std()


def test_a_loop_that_stood_goes_on_as_if_it_had_stood_for_half_a_second():
    _, *passed = measure(*times(*[USUAL] * 30, 60.0, *[USUAL] * 30))
    assert sum(passed) == pytest.approx(60 * USUAL + 0.5, rel=1e-6)
    assert max(passed) < 0.04


@pytest.mark.parametrize("wrong", [math.nan, 0.28, 0.2, -5.0])
def test_a_time_that_did_not_increase_is_told_and_forgotten(wrong):
    before = times(*[USUAL] * 29)
    resumed = [0.30 if math.isnan(wrong) else wrong + USUAL]
    resumed += [resumed[0] + USUAL]
    *_, refused, first, second = measure(*before, wrong, *resumed)
    assert not refused > 0
    assert first == pytest.approx(USUAL, rel=1e-6)
    assert second == pytest.approx(USUAL, rel=1e-6)


def test_robots_of_a_batch_do_not_know_of_each_other():
    steps = USUAL * (0.5 + torch.rand(50, 3, generator=torch.manual_seed(0))).double()
    steps[20, 1] = -1.0
    moments, ticks = torch.cat((torch.zeros(1, 3), steps)).cumsum(0).double(), TickDurations()
    together = [torch.as_tensor(ticks.next(now, USUAL)).expand(3) for now in moments]
    alone = torch.tensor([measure(*moments[:, robot].tolist()) for robot in range(3)])
    torch.testing.assert_close(torch.stack(together).T, alone.double(), atol=1e-12, rtol=1e-6)
