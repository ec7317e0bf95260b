"""Meta-World's tables, files of episodes, and the prior: without Meta-World."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pandas as pd
import pytest
import torch

from lerobot_env_bimanual.metaworld.hand import metaworld_operators, metaworld_robot
from lerobot_env_bimanual.metaworld.tasks import TASKS, TUNED, difficulty
from tests.support.reaching import reaching
from tpgmm_evaluation.cells import Cell, Results
from tpgmm_evaluation.metaworld import learners, recordings
from tpgmm_evaluation.metaworld.__main__ import report
from tpgmm_evaluation.metaworld.nearness import Nearness
from tpgmm_evaluation.metaworld.recordings import (
    demonstration_seeds,
    evaluation_seeds,
    read,
    successes,
    validation_seeds,
    write,
)
from tpgmm_evaluation.metaworld.summary import (
    GROUPS,
    LOOKS,
    comparison_table,
    cost_table,
    panels,
    summary,
    task_table,
)
from tpgmm_evaluation.report.tables import episode_table
from tpgmm_torch import TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.training.hold_detection import with_holds


def cell(task, n, solved, of=4, seed=0, policy="tpgmm", seconds=2.0, outcome="done"):
    names = {"env": task, "policy": policy, "demonstrations": n, "seed": seed}
    took = {"steps": 50, "acting_seconds": seconds / 100}
    return {
        "cell": {**names, "condition": "nominal"},
        "episodes": [{"seed": i, "success": i < solved, **took} for i in range(of)],
        "training_seconds": seconds,
        "training_outcome": outcome,
    }


def episodes_of(cells):
    rest = {"settings": {"demonstration_seed": 0}, "versions": {}}
    return episode_table([one | rest for one in cells])


def test_groups_are_all_tasks_and_two_halves_that_share_none():
    assert set(GROUPS["tuned half"]).isdisjoint(GROUPS["held half"])
    assert sorted((*GROUPS["tuned half"], *GROUPS["held half"])) == list(TASKS)
    assert set(LOOKS) == set(learners.LEARNERS)


def test_the_summary_has_means_over_tasks_with_intervals_and_every_seed():
    results = [cell("push-v3", 3, 4), cell("reach-v3", 3, 2), cell("push-v3", 3, 2, seed=1)]
    rows = {
        row.split("|")[1].strip(): row for row in summary(episodes_of(results)).splitlines()
    }
    # push 6 of 8, reach 2 of 4: (75 + 50) / 2; the interval is that of 7.5 of 12, rounded.
    # Seed 1 was tried in one task only
    assert "| 62.5 (39 to 86), in 2 of 50 |" in rows["all (50)"]
    assert "| 75.0 (41 to 93) [100, 50], in 1 of 6 |" in rows["hard (6)"]
    assert "medium (11)" not in rows
    whole = [cell(task, 3, i % 3 + 1, seed=s) for s in (0, 1) for i, task in enumerate(TASKS)]
    assert "[50, 50] |" in summary(episodes_of(whole)).splitlines()[2]


def test_tables_put_tpgmm_first_and_leave_room_where_nothing_was_measured():
    results = [cell("push-v3", 1, 1, policy="perceptron"), cell("reach-v3", 3, 2)]
    heading, _, push, reach = task_table(episodes_of(results)).splitlines()
    assert heading == "| task |  | tpgmm, 3 | perceptron, 1 |"
    assert push.endswith("|  | 1/4 |")
    assert reach.endswith("| 2/4 |  |")
    assert ("tuned" in push) == ("push-v3" in TUNED)


def test_costs_are_medians_over_trainings_and_ends_are_counted():
    ends = {2.0: "it stopped", 3.0: "the budget", 9.0: "it stopped"}
    results = [
        cell(task, 3, 1, seconds=seconds, outcome=outcome)
        for task, (seconds, outcome) in zip(TASKS, ends.items(), strict=False)
    ]
    # 30 ms of each episode's 50 steps
    assert "| tpgmm, 3 | 3 | 3 | 0.6 | it stopped: 2; the budget: 1 |" in cost_table(results)


def test_a_report_is_written_of_all_cells_that_are_there(tmp_path):
    results = Results(tmp_path / "cells")
    for solved, seed in ((4, 0), (2, 7)):
        place = Cell("push-v3", "tpgmm", 3, seed)
        rest = {"settings": {"pace": 0.8}, "versions": {"numpy": "2"}}
        expert = {"episodes": 12, "successes": 11}
        results.write(place, cell("push-v3", 3, solved, seed=seed) | rest | {"expert": expert})
    report(results, tmp_path)
    text = (tmp_path / "results.md").read_text(encoding="utf-8")
    assert "solved 22 of 24" in text and "| push-v3 | hard, tuned | 6/8 |" in text
    assert {"success.pdf", "success.webp"} <= {file.name for file in tmp_path.iterdir()}
    table = pd.read_parquet(tmp_path / "episodes.parquet")
    assert table["demonstration_seed"].tolist() == [0] * 4 + [7] * 4
    assert table["success"].sum() == 6


def test_policies_are_compared_over_the_tasks_that_both_were_tried_in():
    ours = {"push-v3": 4, "reach-v3": 2, "sweep-v3": 1, "soccer-v3": 3}
    theirs = {"push-v3": 1, "reach-v3": 3, "sweep-v3": 1, "hammer-v3": 4}
    table = comparison_table(
        episodes_of(
            [cell(task, 3, solved) for task, solved in ours.items()]
            + [cell(task, 3, solved, policy="act") for task, solved in theirs.items()]
        )
    ).splitlines()
    row = [entry.strip() for entry in table[2].split("|")[1:-1]]
    # 4, 2 and 1 of 4 beside 1, 3 and 1
    assert row[:4] == ["act, 3", "3", "58.3", "41.7"]
    assert row[4].startswith("16.7 (") and row[5:7] == ["1", "1"]
    assert row[8] == "reach-v3 -25"
    assert comparison_table(episodes_of([cell("push-v3", 3, 1)])) == ""


def test_a_picture_leaves_out_who_was_tried_in_fewer_tasks():
    pair = [task for task in TASKS if difficulty(task) == "hard"][:2]
    cells = [cell(task, 3, 1, policy=policy) for task in pair for policy in ("tpgmm", "act")]
    cells += [cell(pair[0], 3, 1, seed=1), cell(pair[0], 3, 1, policy="diffusion")]
    shown = panels(episodes_of(cells))
    assert {"all", "hard"} <= set(shown.env) <= set(GROUPS)
    assert set(shown[shown.env == "all"].policy) == {"tpgmm", "act"}
    assert set(shown[shown.env == "all"].training_seed) == {0}


def test_situations_of_demonstrations_tuning_and_evaluation_are_different():
    shown = {seed for s in (0, 1, 2, 999) for seed in demonstration_seeds(s, 1000)}
    tried, tuned = set(evaluation_seeds(500)), set(evaluation_seeds(500, tuning=True))
    assert len(shown) == 4000
    checked = set(validation_seeds())
    assert shown.isdisjoint(tried | tuned) and tried.isdisjoint(tuned)
    assert checked.isdisjoint(shown | tried | tuned)
    with pytest.raises(DataError, match="training seeds"):
        demonstration_seeds(1000, 1)


def test_episodes_are_read_back_as_they_were(tmp_path):
    episodes = [reaching(1, 30), replace(reaching(2, 20), success=False)]
    write(tmp_path / "a" / "push.npz", episodes)
    for was, found in zip(episodes, read(tmp_path / "a" / "push.npz"), strict=True):
        assert (found.seed, found.success) == (was.seed, was.success)
        for name in ("observed", "references", "actions"):
            assert np.array_equal(getattr(found, name), getattr(was, name))
    (tmp_path / "damaged.npz").write_bytes(b"nothing")
    with pytest.raises(DataError, match="delete it"):
        read(tmp_path / "damaged.npz")


def test_too_few_successes_are_refused():
    episodes = [reaching(1), replace(reaching(2), success=False)]
    assert successes(episodes, 1, "push-v3") == episodes[:1]
    with pytest.raises(DataError, match="solved 1 of 2"):
        successes(episodes, 2, "push-v3")


@pytest.mark.parametrize(
    ("solves", "n", "least", "asked"),
    [
        (lambda seed: True, 2, 4, 4),
        (lambda seed: True, 3, 2, 3),
        (lambda seed: seed % 3 == 0, 4, 5, 10),
        (lambda seed: False, 2, 1, 10),
    ],
    ids=["at least", "no fewer than needed", "more where it fails", "given up"],
)
def test_the_expert_is_asked_for_more_where_it_fails(
    tmp_path, monkeypatch, solves, n, least, asked
):
    said = []

    def record(env, seeds):
        said.extend(seeds)
        return [replace(reaching(seed, 5), success=solves(seed)) for seed in seeds]

    monkeypatch.setattr(recordings, "record_metaworld", record)
    monkeypatch.setattr(recordings, "MetaworldStateEnv", Mock())
    episodes = recordings.record_expert(tmp_path, "push-v3", 0, n, least)
    assert [episode.seed for episode in episodes] == said == [*range(asked)]
    # a second run asks for nothing, and one that needs fewer has the first of them
    again = recordings.record_expert(tmp_path, "push-v3", 0, n, least)
    assert [episode.seed for episode in again] == [*range(asked)] == said
    if any(episode.success for episode in episodes):
        assert len(recordings.record_expert(tmp_path, "push-v3", 0, 1, 2)) == 2


def test_switches_are_where_the_gripper_jumps():
    assert learners.switches(reaching(0).references) == [30]


def test_events_are_the_switches_that_all_demonstrations_have():
    once, twice = reaching(0), reaching(1)
    twice.references[50:, -1] = 1.0
    first, second = learners.slow_down([once, twice], 1.0)
    assert first.events == second.events == {"switch 1": pytest.approx(30 / 80)}
    once.references[30:, -1] = 1.0  # never closed: nothing is common
    assert not any(one.events for one in learners.slow_down([once, twice], 0.5))


def test_fingers_are_told_later_where_the_hand_is_slower():
    shown = reaching(0)
    [one] = learners.slow_down([shown], 0.5)
    assert float(one.time[-1]) == pytest.approx(59 / 80 / 0.5)
    # the hand takes twice as long to where it was 0.19 s after the switch, fingers do not
    assert one.events["switch 1"] == pytest.approx(2 * 30 / 80 + 0.19, abs=0.5 / 80 / 0.5)
    assert one.joints[:, 3].tolist() == [1.0] * 38 + [0.0] * 22
    assert np.array_equal(one.joints[:, :3], shown.references[:, :3])


def test_second_tries_are_not_learned_from():
    episodes = [reaching(seed, length) for seed, length in enumerate((80, 60, 84, 85, 60))]
    assert learners.drop_slow(episodes, longest=1.4) == [episodes[i] for i in (0, 1, 2, 4)]
    assert learners.drop_slow(episodes, longest=1.3) == [episodes[i] for i in (1, 4)]
    assert learners.drop_slow(episodes[:1], longest=1.4) == episodes[:1]
    learner = learners.TaskParameterized()
    few, all_of_them = (learner.fit(some, 0).policy for some in (episodes[:3], episodes[:4]))
    most = replace(learner, longest=2.0).fit(episodes[:4], 0).policy
    means = [
        one.skill.skills[0].conditionals[0].mean.tolist() for one in (few, all_of_them, most)
    ]
    assert means[0] == means[1] != means[2]


def test_a_gripper_that_switches_at_the_ends_or_twice_at_once_can_be_learned():
    shown = reaching(1)
    for step in (1, 40, 41, 58, 59):
        shown.references[step:, -1] = 1 - shown.references[step:, -1]
    assert learners.switches(shown.references) == [1, 30, 40, 41, 58, 59]
    [one] = learners.slow_down([shown], 1.0)
    assert [round(80 * instant) for instant in one.events.values()] == [30, 40]
    learners.TaskParameterized().fit([shown], 0)


def test_a_rhythm_that_begins_after_different_waits_is_brought_into_step():
    """Its means at equal shares of the time are flat: 3 cm apart, of an amplitude of 5 cm."""
    shown, steps = [], np.arange(110)
    for seed, wait in enumerate((0, 10, 20)):
        one = reaching(seed, 110)
        one.references[:, 3] = 1.0
        clock = np.clip(steps - wait, 0, None) * 110 / (110 - wait)
        one.references[:, 2] = 0.2 + 0.05 * np.sin(2 * np.pi * clock / 24)
        shown.append(one)
    for warping, largest in (({}, 0.015), ({"max_slope": 1}, 0.04)):
        learner = learners.TaskParameterized()
        learner = replace(learner, warping=learner.warping | warping)
        aligned = learner.align(learners.slow_down(shown, learner.pace), metaworld_robot())
        heights = torch.stack([one.joints[:, 2] for one in aligned])
        assert largest / 3 < float(heights.std(0).mean()) < largest


def test_the_prior_is_what_its_formula_says_and_parts_the_gripper_from_the_hand():
    prior = Nearness(ratio=0.1, floor=0.0001, power=1.0, reach=0.3, strength=2.0)
    assert prior.deviation(torch.tensor(0.2)).item() == pytest.approx(0.0201)
    shown = with_holds([reaching(seed).demonstration() for seed in range(3)], ())
    model = TaskParameterizedGMM(5, metaworld_operators(["goal"]), metaworld_robot())
    before = model.fit(shown).skill
    after = prior.apply(before, 3)
    (joints, new), (seen, near) = zip(before.conditionals, after.conditionals, strict=True)
    deviation = prior.deviation(seen.mean.norm(dim=1))[:, None].expand(-1, 3)
    torch.testing.assert_close(
        near.covariance, (3 * seen.covariance + 2 * (deviation**2).diag_embed()) / 5
    )
    for one, other in ((joints, new), (seen, near)):  # slopes over time stay
        assert torch.equal(one.gain, other.gain)
    assert not new.covariance[:, 3, :3].any() and joints.covariance[:, 3, :3].any()
    torch.testing.assert_close(new.covariance[:, 0, 1], 0.6 * joints.covariance[:, 0, 1])


def test_one_demonstration_is_enough_to_reach_another_goal():
    """Nothing but the prior can say that the end belongs to the goal and not to the world."""
    shown, new = reaching(1), reaching(2)
    actor = learners.TaskParameterized().fit([shown], 0)
    actor.begin(new.observed[:1])
    goal = new.references[-1, :3]
    assert np.linalg.norm(actor.act(0, 10**6, new.observed[-1])[:3] - goal) < 0.02
    blind = learners.TaskParameterized(nearness=None).fit([shown], 0)
    blind.begin(new.observed[:1])
    assert np.linalg.norm(blind.act(0, 10**6, new.observed[-1])[:3] - goal) > 0.02


def test_the_gripper_switches_as_it_was_shown():
    shown, new = [reaching(i) for i in (1, 2, 3)], reaching(4)
    actor = learners.TaskParameterized().fit(shown, 0)
    actor.begin(new.observed[:1])
    plan = np.array([actor.act(0, step, new.observed[0])[3] for step in range(90)])
    # from all to nothing within two steps, and no further; as an arm's joint it took five
    assert np.flatnonzero(plan < 0.1)[0] - np.flatnonzero(plan > 0.9)[-1] <= 2
    assert plan.min() >= -1e-6 and plan.max() <= 1 + 1e-6


def test_reading_the_hand_at_every_step_gives_the_same_references_if_it_follows():
    shown, new = [reaching(i) for i in (1, 2, 3)], reaching(4)
    plan = learners.TaskParameterized().fit(shown, 0)
    closed = learners.TaskParameterized(clock="even").fit(shown, 0)
    for actor in (plan, closed):
        actor.begin(new.observed[:1])
    for step in range(20):
        wanted = plan.act(0, step, new.observed[step])
        assert np.allclose(closed.act(0, step, new.observed[step]), wanted, atol=1e-4)
