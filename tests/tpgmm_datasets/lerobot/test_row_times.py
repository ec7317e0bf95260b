"""Time of the rows of an episode."""

import numpy as np
import pytest

from tests.support.lerobot_sets import FPS
from tpgmm_datasets import load_lerobot
from tpgmm_datasets.lerobot.row_times import row_times, time_problems


def test_time_is_the_grid_of_the_rate(root):
    for demonstration in load_lerobot(root):
        assert demonstration.time.tolist() == [k / FPS for k in range(len(demonstration))]


@pytest.mark.parametrize(
    ("steps", "check"),
    [
        ([0.1] * 9, None),
        ([0.109, 0.091] * 5, None),
        ([0.1] * 4 + [0.14] + [0.1] * 4, None),
        ([0.1] * 4 + [0.16] + [0.1] * 4, "gaps"),
        ([0.1] * 4 + [0.0] + [0.1] * 4, "time"),
        ([0.12] * 9, "metadata"),
        ([np.nan] * 9, "nan"),
    ],
)
def test_steps_may_differ_a_little(steps, check):
    stamps = np.cumsum([0.0, *steps]).astype(np.float32)
    assert [problem.check for problem in time_problems(stamps, 10.0)] == [check] * bool(check)


def test_times_off_the_grid_stay_as_they_are():
    grid = np.arange(5) / 10
    assert row_times(None, 5, 10.0).tolist() == grid.tolist()
    assert row_times((grid + 3).astype(np.float32), 5, 10.0).tolist() == grid.tolist()
    late = grid + np.array([0, 0.03, 0, 0, 0])
    assert row_times(late + 3, 5, 10.0) == pytest.approx(late, abs=1e-12)
