"""Intervals of success rates, and results as tables."""

import json

import numpy as np
import pytest

from lerobot_policy_tpgmm.evaluation.report.tables import cell_table, episode_table, wilson
from tests.support.comparison import RESULTS
from tpgmm_torch.exceptions import DataError


@pytest.mark.parametrize(
    ("successes", "trials", "confidence", "expected"),
    [
        # Newcombe, Statistics in Medicine 17 (1998), table I, method 3
        (81, 263, 0.95, (0.2553, 0.3662)),
        (15, 148, 0.95, (0.0624, 0.1605)),
        (0, 20, 0.95, (0.0, 0.1611)),
        (1, 29, 0.95, (0.0061, 0.1718)),
        # from the other side
        (20, 20, 0.95, (0.8389, 1.0)),
        # z^2 = 2.7055: z^2 / (10 + z^2)
        (0, 10, 0.9, (0.0, 0.2129)),
    ],
)
def test_wilson_gives_published_values(successes, trials, confidence, expected):
    assert wilson(successes, trials, confidence) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 2)])
def test_wilson_refuses_what_is_no_proportion(successes, trials):
    with pytest.raises(DataError, match="no proportion"):
        wilson(successes, trials)


def test_tables_have_a_row_for_each_cell_and_each_episode():
    cells, episodes = cell_table(RESULTS), episode_table(RESULTS)
    assert len(cells) == 6
    assert len(episodes) == 120
    row = cells.iloc[5]
    assert (row.policy, row.demonstrations, row.successes, row.success) == ("act", 10, 18, 0.9)
    # Wilson's interval of 18 of 20
    assert (row.success_low, row.success_high) == pytest.approx((0.699, 0.972), abs=1e-3)
    assert row.grasp_mm_median == 1.0
    assert row.grasp_mm_p95 == np.inf
    assert json.loads(row.versions) == {"torch": "1"}
    assert {"seed", "training_seed", "condition", "lift_mm"} <= set(episodes.columns)
