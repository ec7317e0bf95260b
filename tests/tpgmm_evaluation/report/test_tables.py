"""Intervals of success rates, and results as tables."""

import json

import numpy as np
import pandas as pd
import pytest

from tests.support.comparison import RESULTS, result
from tpgmm_evaluation.report import tables
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
    assert tables.wilson(successes, trials, confidence) == pytest.approx(expected, abs=5e-5)


@pytest.mark.parametrize(("successes", "trials"), [(0, 0), (3, 2), (-1, 2)])
def test_wilson_refuses_what_is_no_proportion(successes, trials):
    with pytest.raises(DataError, match="no proportion"):
        tables.wilson(successes, trials)


def test_tables_have_a_row_for_each_cell_and_each_episode():
    cells, episodes = tables.cell_table(RESULTS), tables.episode_table(RESULTS)
    assert len(cells) == 6
    assert len(episodes) == 120
    row = cells.iloc[5]
    assert (row.policy, row.demonstrations, row.successes, row.success) == ("act", 10, 18, 0.9)
    # Wilson's interval of 18 of 20
    assert (row.success_low, row.success_high) == pytest.approx((0.699, 0.972), abs=1e-3)
    assert row.grasp_mm_median == 1.0
    assert row.grasp_mm_p95 == np.inf
    assert json.loads(row.versions) == {"torch": "1"}
    assert {"evaluation_seed", "training_seed", "condition", "lift_mm"} <= set(episodes.columns)


def test_results_go_through_a_file_as_they_are(tmp_path):
    other = result("tpgmm", 5, 4, env="carry_and_put")
    other["episodes"] = [{"seed": 9, "success": True, "put_mm": 0.5}]
    episodes = tables.episode_table([*RESULTS, other])
    tables.write_table(episodes, tmp_path / "results")
    read = pd.read_parquet(tmp_path / "results.parquet")
    pd.testing.assert_frame_equal(read, episodes)
    last = read.iloc[-1]
    assert (last.env, last.put_mm, last.evaluation_seed) == ("carry_and_put", 0.5, 9)
    assert np.isnan(last.grasp_mm) and np.isinf(read.grasp_mm).any()
    assert json.loads(last.versions) == {"torch": "1"}
    assert list(read)[:6] == [
        *("env", "policy", "demonstrations"),
        *("condition", "training_seed", "demonstration_seed"),
    ]


def test_demonstrations_are_counted_by_seed(tmp_path):
    for seed, successes in ((10, [True, False]), (2, [True])):
        folder = tmp_path / "episodes" / f"s{seed}"
        folder.mkdir(parents=True)
        (folder / "summary.json").write_text(json.dumps({"successes": successes}))
    table = tables.count_demonstrations(tmp_path)
    assert table.to_dict("list") == {"seed": [2, 10], "tried": [1, 2], "succeed": [1, 1]}
    assert tables.count_demonstrations(tmp_path / "none").empty
