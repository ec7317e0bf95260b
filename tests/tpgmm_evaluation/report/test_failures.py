"""Failed episodes: which criterion was missed, and how they are run again."""

import math

import pytest

from tests.support.comparison import result
from tpgmm_evaluation.benchmarks import benchmark
from tpgmm_evaluation.report.failures import (
    criterion,
    evaluation_command,
    list_failures,
    missed_criteria,
)
from tpgmm_evaluation.report.tables import episode_table
from tpgmm_evaluation.settings import Settings

BOTTLE, CARRY, ALOHA = map(benchmark, ("bottle_shaking", "carry_and_put", "aloha_state"))
GOOD = {"grasp_mm": 1.0, "grasp_deg": 1.0, "lift_mm": 80.0}
GOOD |= {"frequency_error": 0.0, "amplitude_error": 0.0}


@pytest.mark.parametrize(
    ("where", "key", "text"),
    [
        (BOTTLE, "grasp_mm", "grasp [mm] ≤ 10"),
        (BOTTLE, "lift_mm", "lift [mm] ≥ 50"),
        (CARRY, "standing", "put down = 1"),
    ],
)
def test_criteria_are_told_with_their_bound(where, key, text):
    assert criterion(where, key) == text


@pytest.mark.parametrize("key", GOOD)
def test_each_criterion_alone_is_missed(key):
    assert missed_criteria(GOOD, BOTTLE) == []
    bad = 0.0 if key == "lift_mm" else 99.0
    for figures in (GOOD | {key: bad}, GOOD | {key: math.nan}, GOOD | {key: math.inf}):
        expected = [] if key == "lift_mm" and figures[key] == math.inf else [key]
        assert missed_criteria(figures, BOTTLE) == expected
    assert missed_criteria({k: v for k, v in GOOD.items() if k != key}, BOTTLE) == [key]


def test_list_failures_are_listed_with_what_was_missed():
    bottle = result("tpgmm", 5, 18, seed=3)
    for episode in bottle["episodes"]:
        episode["amplitude_error"] = 0.1
    late = result("tpgmm", 5, 20)
    late["episodes"] = [{"seed": 5, "success": False, **GOOD}]
    aloha = result("tpgmm", 5, 20, env="aloha_state")
    aloha["episodes"] = [{"seed": 7, "success": False, "max_reward": 2.0, "lift_mm": 3.0}]
    benchmarks = {"bottle_shaking": BOTTLE, "aloha_state": ALOHA}
    table = list_failures(episode_table([bottle, late, aloha]), benchmarks)
    assert list(table.evaluation_seed) == [118, 119, 5, 7]
    assert list(table.training_seed) == [3, 3, 0, 0]
    assert list(table.missed) == [
        *["grasp [mm] ≤ 10 (inf)"] * 2,
        "all of them are met, but not in time",
        "stage, 0 to 4: 2; lift [mm]: 3",
    ]
    assert list_failures(episode_table([result("tpgmm", 5, 20)]), benchmarks).empty


def test_an_episode_is_run_again_by_lerobot():
    settings = Settings("aloha_insertion", {"yaw_range": 0.5})
    command = evaluation_command(settings, "nominal", "p/a", 50, 100_007, 1)
    assert "--policy.path=p/a " in command and "--env.type=aloha_state " in command
    assert "--env.task=insertion --env.yaw_range=0.5 --eval.n_episodes=1 " in command
    assert command.endswith("--seed=100007")
    pushed = evaluation_command(Settings(), "pushes+stopped-3", "p", 100, 1, 1)
    assert "--env.pushes=true --env.condition=stopped-3 " in pushed
