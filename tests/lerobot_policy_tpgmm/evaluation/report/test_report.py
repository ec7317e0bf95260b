"""The report, tables and pictures from given results."""

import json

import numpy as np
import pandas as pd
import pytest

from lerobot_policy_tpgmm.evaluation.cells import Cell
from lerobot_policy_tpgmm.evaluation.report.report import write_report
from lerobot_policy_tpgmm.evaluation.report.tables import cell_table, episode_table
from lerobot_policy_tpgmm.evaluation.settings import Settings

LATENCIES = ("step_median_ms", "step_p99_ms", "chunk_median_ms", "chunk_p99_ms")
SETTINGS = Settings(episodes=20, budget=120.0)


def result(policy, count, successes, condition="nominal", curve=(), outcome="learned", seed=0):
    rng = np.random.default_rng(count)
    episodes = [
        {
            "seed": 100 + i,
            "success": i < successes,
            "grasp_mm": 1.0 if i < successes else float("inf"),
            "grasp_deg": float(rng.uniform(0, 4)),
            "lift_mm": 80.0,
            "frequency_error": 0.01,
            "amplitude_error": 0.3 if i % 2 else 0.1,
        }
        for i in range(20)
    ]
    return {
        "cell": vars(Cell("bottle_shaking", policy, count, seed, condition)),
        "settings": {"env": "bottle_shaking", "options": {}, "demonstration_seed": 0},
        "training": {
            "fps": 10,
            "seconds": 12.0,
            "parameters": 1234567,
            "bytes": 5e6,
            "outcome": outcome,
            "recipe": {"check_every": 200},
            "curve": list(curve),
        },
        "evaluation_seconds": 3.0,
        "latency": {
            "chunk_size": 8.0,
            **dict.fromkeys(LATENCIES, 0.5),
        },
        "episodes": episodes,
        "versions": {"torch": "1"},
        "machine": {"processors": 2},
    }


def curve(*errors):
    return [
        {
            "step": 200 * (i + 1),
            "seconds": 10.0 * (i + 1),
            "train_loss": 0.5 / (i + 1),
            "validation_loss": 0.6 / (i + 1),
            "validation_error": error,
        }
        for i, error in enumerate(errors)
    ]


BUDGET = "the budget of 2 min was used up"
RESULTS = [
    result("nearest", 5, 0),
    result("tpgmm", 5, 20),
    result("act", 5, 0, curve=curve(0.03, 0.02, 0.025), outcome="it stopped falling"),
    result("tpgmm", 10, 20),
    result("tpgmm", 10, 17, condition="pushes+noise"),
    result("act", 10, 18, curve=curve(0.03, 0.01), outcome=BUDGET),
]


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


@pytest.fixture(scope="module")
def report(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    failures = {Cell("bottle_shaking", "diffusion", 5, 0): "bad luck"}
    write_report(folder, SETTINGS, RESULTS, failures, "tpgmm compare --out x")
    text = (folder / "report.md").read_text()
    pictures = [line.partition("(")[2][:-1] for line in text.splitlines() if line[:2] == "!["]
    assert len(pictures) == 3
    assert all((folder / picture).stat().st_size > 10_000 for picture in pictures)
    pd.testing.assert_frame_equal(
        pd.read_parquet(folder / "cells.parquet"), pd.read_csv(folder / "cells.csv")
    )
    return text


@pytest.mark.parametrize(
    "line",
    [
        "| tpgmm | 20/20 = 100 % (84 to 100 %) | 20/20 = 100 % (84 to 100 %) |",
        "| act | 0/20 = 0 % (0 to 16 %) | 18/20 = 90 % (70 to 97 %) |",
        "| nearest | 0/20 = 0 % (0 to 16 %) | - |",
        'Condition: pushes and noise (`{"pushes": true, "noise": 1.0}`).',
        # criteria, at ten demonstrations
        "| act | 90 % | 100 % | 100 % | 100 % | 50 % |",
        # errors
        "| 10 | act | 1.0 / inf | ",
        # training
        "| act | 5 | 0 | 600 | 0.5 | 20.00 | 400 | it stopped falling |",
        "| act | 12 | 1 234 567 | 5.0 | 10 | 0.50 / 0.50 | 8 | 0.50 / 0.50 |",
        # remarks
        "- From 5 demonstrations tpgmm succeeds in 100 % and ",
        "in 0 %; their intervals do not overlap.",
        "and act, the best of the others, in 90 %; their intervals overlap.",
        "- The budget ended the training of act (10: the error fell by 67 %); in brackets",
        "- Each policy was trained with one seed",
        "- `bottle_shaking-diffusion-n5-s0-nominal`: bad luck",
        "tpgmm compare --out x",
    ],
)
def test_the_report_says(report, line):
    assert line in report


def test_several_seeds_are_taken_together(tmp_path):
    results = [result("tpgmm", 5, 20), result("tpgmm", 5, 10, seed=1)]
    text = write_report(tmp_path, SETTINGS, results, {}, "").read_text()
    assert "| tpgmm | 30/40 = 75 % (" in text
    assert "Episodes of 2 training seeds are taken together" in text
