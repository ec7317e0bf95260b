"""``tpgmm compare``, small: from the demonstrations to the report, and on after a stop."""

import shutil
from dataclasses import replace

import pandas as pd
import pytest

from tpgmm_evaluation import jobs, trainings
from tpgmm_evaluation.baselines import RECIPES
from tpgmm_evaluation.benchmarks import benchmark
from tpgmm_evaluation.cells import Cell, Results
from tpgmm_evaluation.compare import (
    Comparison,
    choose_conditions,
    compare,
    rewrite_report,
)
from tpgmm_evaluation.rollouts import Runner
from tpgmm_evaluation.settings import Settings
from tpgmm_evaluation.variants import OPEN_LOOP
from tpgmm_torch import Canonical
from tpgmm_torch.exceptions import UnknownNameError

pytestmark = pytest.mark.slow

OPTIONS = {"mode": "kinematic"}
SETTINGS = Settings(
    options=OPTIONS, rate=20, episodes=2, budget=0.0, validation=2, n_components=20
)
NEAREST, TPGMM = (Cell("bottle_shaking", policy, 3, 0) for policy in ("nearest", "tpgmm"))


def run_comparison(out, **arguments):
    said = []
    policies = [NEAREST.policy, TPGMM.policy]
    comparison = compare(SETTINGS, out, policies, [3], workers=2, say=said.append, **arguments)
    return comparison, said


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A finished comparison."""
    out = tmp_path_factory.mktemp("compare") / "out"
    comparison, said = run_comparison(out, command="tpgmm compare ...")
    assert comparison == Comparison(2, {}), said
    return out


@pytest.fixture
def out(whole, tmp_path):
    """A copy, which may be changed."""
    return shutil.copytree(whole, tmp_path / "out")


@pytest.fixture(scope="module")
def folder(whole):
    """What it has of the environment."""
    return whole / SETTINGS.env


def test_both_policies_were_rolled_out_on_the_same_seeds(folder):
    results = Results(folder / "cells")
    seeds = [SETTINGS.evaluation_seed, SETTINGS.evaluation_seed + 1]
    for cell in (NEAREST, TPGMM):
        result = results.read(cell)
        assert [episode["seed"] for episode in result["episodes"]] == seeds
        assert result["latency"]["step_median_ms"] > 0
        assert result["training"]["fps"] == 20
    theirs, ours = (results.read(cell)["episodes"] for cell in (NEAREST, TPGMM))
    assert max(one["grasp_mm"] for one in ours) < min(one["grasp_mm"] for one in theirs)


def test_tables_and_report_say_what_the_cells_hold(whole):
    cells = pd.read_parquet(whole / "cells.parquet")
    assert list(cells.policy) == ["nearest", "tpgmm"]
    assert (cells.evaluation_cpu_seconds > 0).all()
    episodes = pd.read_parquet(whole / "results.parquet")
    assert len(episodes) == 4
    assert set(episodes.evaluation_seed) == set(SETTINGS.seeds)
    for policy, rows in episodes.groupby("policy"):
        row = cells.set_index("policy").loc[policy]
        assert row.success == rows.success.mean()
        assert row.success_low <= row.success <= row.success_high
        assert row.grasp_mm_median == pytest.approx(rows.grasp_mm.median())
    report = (whole / "report.md").read_text()
    assert "tpgmm compare ..." in report
    assert "| bottle_shaking | 0 | 3/3 = 100 % (44 to 100 %) | yes |" in report
    for line in report.splitlines():
        if line.startswith("!["):
            assert (whole / line.partition("(")[2].rstrip(")")).is_file()


def test_the_report_can_be_written_again(out):
    before = (out / "report.md").read_text()
    (out / "report.md").unlink()
    (out / "results.parquet").unlink()
    path = rewrite_report(out, [].append)
    assert path.read_text() == before
    assert len(pd.read_parquet(out / "results.parquet")) == 4


def test_seeds_learn_from_demonstrations_of_their_own(out):
    compare(SETTINGS, out, ["nearest"], [3], seeds=[0, 1], say=[].append)
    results = Results(out / SETTINGS.env / "cells")
    one, other = (results.read(replace(NEAREST, seed=seed)) for seed in (0, 1))
    assert [cell["settings"]["demonstration_seed"] for cell in (one, other)] == [0, 1]
    # which is all that could change what it replays
    assert one["episodes"] != other["episodes"]
    episodes = pd.read_parquet(out / "results.parquet")
    drawn = zip(episodes.training_seed, episodes.demonstration_seed, strict=True)
    assert set(drawn) == {(0, 0), (1, 1)}


def test_a_folder_grows_by_an_environment(out):
    carry = replace(SETTINGS, env="carry_and_put", episodes=1)
    said, arguments = [], {"conditions": ["nominal", "stopped-1"]}
    result = compare([SETTINGS, carry], out, ["nearest"], [3], say=said.append, **arguments)
    assert result == Comparison(4, {}), said
    assert said[0] == "4 cells, 1 of them finished before"
    episodes = pd.read_parquet(out / "results.parquet")
    assert dict(episodes.groupby("env").size()) == {"bottle_shaking": 6, "carry_and_put": 1 + 1}
    assert "carry_and_put" in (out / "report.md").read_text()


def test_conditions_are_tried_where_they_are_known():
    said = []
    tasks = [replace(SETTINGS, options={}), Settings("aloha_state")]
    bottle, aloha = choose_conditions(tasks, ["nominal", "pushes", "all"], said.append)
    assert bottle[:2] == ["nominal", "pushes"] and "stopped-3" in bottle
    assert "pushes" not in aloha and aloha[0] == "nominal"
    assert said == ["aloha_state: not tried in 'pushes', which is unknown there"]
    with pytest.raises(UnknownNameError, match="disturbance 'rain'"):
        choose_conditions(tasks, ["nominal", "rain"], said.append)


def test_what_is_finished_is_not_run_again(whole, out):
    place, name = out / SETTINGS.env, "training.json"
    results = Results(place / "cells")
    kept = results.path(NEAREST).stat().st_mtime_ns
    results.path(TPGMM).write_text("{")
    trained = (place / "policies" / TPGMM.training / name).stat().st_mtime_ns
    comparison, said = run_comparison(out)
    assert comparison == Comparison(2, {})
    assert said[0].endswith("the cell is run again")
    assert said[1] == "2 cells, 1 of them finished before"
    assert results.path(NEAREST).stat().st_mtime_ns == kept
    again, before = (
        Results(folder / SETTINGS.env / "cells").read(TPGMM) for folder in (out, whole)
    )
    assert again["episodes"] == before["episodes"]
    # nor is a policy trained again, whose evaluation was stopped
    assert (place / "policies" / TPGMM.training / name).stat().st_mtime_ns == trained
    assert run_comparison(out)[1][0] == "2 cells, 2 of them finished before"


def test_conditions_are_tried_with_the_policy_that_is_there(out):
    place = out / SETTINGS.env
    conditions = ["stopped-1", "moved+pose-stale"]
    policies = ["tpgmm", OPEN_LOOP, "tpgmm --policy.control.follow_frames=true"]
    said = []
    few = replace(SETTINGS, episodes=1)
    few.keep(out / "few.json")
    (out / "few.json").replace(place / "settings.json")
    comparison = compare(few, out, policies, [3], conditions=conditions, say=said.append)
    assert comparison.finished == 6, said
    trained = [path.name for path in (place / "policies").iterdir()]
    assert sorted(trained) == [NEAREST.training, TPGMM.training]
    results = Results(place / "cells")
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
    assert "figures/conditions.webp" in report
    for policy in policies:
        assert f"\n{policy}:\n" in report


@pytest.mark.parametrize("policy", ["act", "diffusion-phase"])
def test_baselines_go_through_the_same_code(folder, tmp_path, policy, monkeypatch):
    shutil.copytree(folder / "episodes", tmp_path / "episodes")
    recipe = replace(RECIPES[policy], check_every=5, batch_size=8)
    monkeypatch.setitem(RECIPES, policy, recipe)
    cell = Cell("bottle_shaking", policy, 2, 0)
    jobs.run(tmp_path, SETTINGS, [cell])
    result = Results(tmp_path / "cells").read(cell)
    [point] = result["training"]["curve"]
    assert point["step"] == 5 and 0 < point["validation_error"] < 3
    assert "budget" in result["training"]["outcome"]
    size = recipe.options.get("n_action_steps", 8)
    assert result["latency"]["chunk_size"] == size
    assert result["latency"]["chunk_median_ms"] > result["latency"]["step_median_ms"]
    assert not result["episodes"][0]["success"]
    runner = Runner.load(tmp_path / "policies" / cell.training)
    width = runner.policy.config.env_state_feature.shape[0]
    assert width == (40 if "phase" in policy else 7)


@pytest.mark.parametrize("policy", ["key-poses-posture", "mean", "tpgmm-no-joints"])
def test_what_no_gradient_trains_goes_through_the_same_code(folder, tmp_path, policy):
    shutil.copytree(folder / "episodes", tmp_path / "episodes")
    cell = Cell("bottle_shaking", policy, 2, 0)
    jobs.run(tmp_path, SETTINGS, [cell])
    result = Results(tmp_path / "cells").read(cell)
    assert result["training"]["curve"] == []
    assert result["training"]["outcome"]
    assert len(result["episodes"]) == SETTINGS.episodes
    reached = max(episode["grasp_mm"] for episode in result["episodes"])
    assert (reached < 10) == (policy in ("key-poses-posture", "tpgmm-no-joints"))
    runner = Runner.load(tmp_path / "policies" / cell.training)
    own = "lerobot_policy_tpgmm", "tpgmm_evaluation"
    assert type(runner.policy).__module__.startswith(own)


def test_without_joints_grippers_keep_their_coordinate():
    operators = trainings.operators_of("tpgmm-no-joints", benchmark("aloha_state"))
    [joints] = [one for one in operators if isinstance(one, Canonical)]
    assert joints.joints == ("left_arm_gripper", "right_arm_gripper")
    bottle = trainings.operators_of("tpgmm-no-joints", benchmark("bottle_shaking"))
    assert not [one for one in bottle if isinstance(one, Canonical)]
