"""``tpgmm compare``, small: from the demonstrations to the report, and on after a stop."""

import shutil
from dataclasses import replace

import pandas as pd
import pytest

from lerobot_policy_tpgmm.evaluation import jobs
from lerobot_policy_tpgmm.evaluation.cells import Cell, Results
from lerobot_policy_tpgmm.evaluation.compare import Comparison, compare
from lerobot_policy_tpgmm.evaluation.rollouts import Runner
from lerobot_policy_tpgmm.evaluation.settings import Settings
from lerobot_policy_tpgmm.evaluation.variants import OPEN_LOOP

SETTINGS = Settings(
    options={"mode": "kinematic"},
    rate=20,
    episodes=2,
    budget=0.0,
    validation=2,
    n_components=20,
)
NEAREST, TPGMM = (Cell("bottle_shaking", policy, 3, 0) for policy in ("nearest", "tpgmm"))


def compared(out, **arguments):
    said = []
    policies = [NEAREST.policy, TPGMM.policy]
    comparison = compare(SETTINGS, out, policies, [3], workers=2, say=said.append, **arguments)
    return comparison, said


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A finished comparison."""
    out = tmp_path_factory.mktemp("compare") / "out"
    comparison, said = compared(out, command="tpgmm compare ...")
    assert comparison == Comparison(2, {}), said
    return out


def test_both_policies_were_rolled_out_on_the_same_seeds(folder):
    results = Results(folder / "cells")
    seeds = [SETTINGS.evaluation_seed, SETTINGS.evaluation_seed + 1]
    for cell in (NEAREST, TPGMM):
        result = results.read(cell)
        assert [episode["seed"] for episode in result["episodes"]] == seeds
        assert result["latency"]["step_median_ms"] > 0
        assert result["training"]["fps"] == 20
    grasps = {
        cell: [episode["grasp_mm"] for episode in results.read(cell)["episodes"]]
        for cell in (NEAREST, TPGMM)
    }
    assert max(grasps[TPGMM]) < min(grasps[NEAREST])


def test_tables_and_report_say_what_the_cells_hold(folder):
    cells = pd.read_parquet(folder / "cells.parquet")
    assert list(cells.policy) == ["nearest", "tpgmm"]
    episodes = pd.read_csv(folder / "episodes_evaluated.csv")
    assert len(episodes) == 4
    for policy, rows in episodes.groupby("policy"):
        row = cells.set_index("policy").loc[policy]
        assert row.success == rows.success.mean()
        assert row.success_low <= row.success <= row.success_high
        assert row.grasp_mm_median == pytest.approx(rows.grasp_mm.median())
    report = (folder / "report.md").read_text()
    assert "tpgmm compare ..." in report
    assert "the 3 recorded demonstrations succeed" in report
    for line in report.splitlines():
        if line.startswith("!["):
            assert (folder / line.partition("(")[2].rstrip(")")).is_file()


def test_what_is_finished_is_not_run_again(folder, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    results = Results(out / "cells")
    kept = results.path(NEAREST).stat().st_mtime_ns
    results.path(TPGMM).write_text("{")
    trained = (out / "policies" / TPGMM.training / "training.json").stat().st_mtime_ns
    comparison, said = compared(out)
    assert comparison == Comparison(2, {})
    assert said[0].endswith("the cell is run again")
    assert said[1] == "2 cells, 1 of them finished before"
    assert results.path(NEAREST).stat().st_mtime_ns == kept
    again, before = (Results(place / "cells").read(TPGMM) for place in (out, folder))
    assert again["episodes"] == before["episodes"]
    # nor is a policy trained again, whose evaluation was stopped
    assert (out / "policies" / TPGMM.training / "training.json").stat().st_mtime_ns == trained
    assert compared(out)[1][0] == "2 cells, 2 of them finished before"


def test_conditions_are_tried_with_the_policy_that_is_there(folder, tmp_path):
    out = tmp_path / "out"
    shutil.copytree(folder, out)
    conditions = ["stopped-1", "moved+pose-stale"]
    policies = ["tpgmm", OPEN_LOOP, "tpgmm --policy.follow_frames=true"]
    said = []
    few = replace(SETTINGS, episodes=1)
    few.keep(out / "few.json")
    (out / "few.json").replace(out / "settings.json")
    comparison = compare(few, out, policies, [3], conditions=conditions, say=said.append)
    assert comparison.finished == 6, said
    trained = [path.name for path in (out / "policies").iterdir()]
    assert sorted(trained) == [NEAREST.training, TPGMM.training]
    results = Results(out / "cells")
    stop = {
        policy: results.read(replace(TPGMM, policy=policy, condition="stopped-1"))
        for policy in policies
    }
    assert stop["tpgmm"]["settings"]["options"]["condition"] == "stopped-1"
    for row in (result["episodes"][0] for result in stop.values()):
        assert row["peak_speed"] > 0 and row["peak_acceleration"] > 0
    moved = [
        results.read(replace(TPGMM, policy=policy, condition=conditions[1]))["episodes"][0]
        for policy in policies[1:]
    ]
    assert moved[1]["grasp_mm"] < 10 < 20 < moved[0]["grasp_mm"]
    cells = pd.read_csv(out / "cells.csv")
    assert {"success_low", "success_high", "peak_speed_median", "grasp_mm_p95"} <= set(cells)
    assert len(cells) == 8
    report = (out / "report.md").read_text()
    for condition in conditions:
        for policy in policies:
            assert f"| {condition} | {policy} | " in report


@pytest.mark.parametrize("policy", ["act", "diffusion-phase"])
def test_baselines_go_through_the_same_code(folder, tmp_path, policy, monkeypatch):
    shutil.copytree(folder / "episodes", tmp_path / "episodes")
    recipe = replace(jobs.RECIPES[policy], check_every=5, batch_size=8)
    monkeypatch.setitem(jobs.RECIPES, policy, recipe)
    cell = Cell("bottle_shaking", policy, 2, 1)
    jobs.run(tmp_path, SETTINGS, [cell])
    result = Results(tmp_path / "cells").read(cell)
    [point] = result["training"]["curve"]
    assert point["step"] == 5
    assert 0 < point["validation_error"] < 3
    assert "budget" in result["training"]["outcome"]
    size = recipe.options["n_action_steps"]
    assert result["latency"]["chunk_size"] == size
    assert result["latency"]["chunk_median_ms"] > result["latency"]["step_median_ms"]
    assert not result["episodes"][0]["success"]
    runner = Runner.load(tmp_path / "policies" / cell.training)
    width = runner.policy.config.env_state_feature.shape[0]
    assert width == (40 if "phase" in policy else 7)
