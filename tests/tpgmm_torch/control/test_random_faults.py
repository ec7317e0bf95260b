"""Random servos and faults, a few of those that ``python -m tpgmm_evaluation.faults`` draws."""

import warnings

import pytest

from tests.tpgmm_torch.control.test_reference_continuity import BOUNDS, pytestmark
from tpgmm_evaluation.faults.drawing import HALVES, Run
from tpgmm_evaluation.faults.measures import measure
from tpgmm_evaluation.faults.runs import simulate

__all__ = ["pytestmark"]


@pytest.mark.parametrize("robot", ["four joints", "gripper"])
def test_references_stay_within_bounds_and_the_status_is_true(robot):
    runs = [Run.draw(HALVES[0], seed, [50.0], [robot]) for seed in range(10)]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        found = [measure(log) for log in simulate(runs)]
    for run, one in zip(runs, found, strict=True):
        assert {name: one[name] for name in BOUNDS} == dict.fromkeys(BOUNDS, 0), str(run)
    assert sum(one["false"] for one in found) <= 0.01 * sum(one["ticks"] for one in found)
    assert not any(one["open"] for one in found)
