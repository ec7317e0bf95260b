"""Several ways of one skill: each robot goes the one that suits its situation."""

import numpy as np
import pytest
import torch

from tests.support.refusals import refused
from tests.support.two_ways import (
    Handles,
    Obstacle,
    another_handle_each,
    fitted,
    reach_of_one_handle,
)
from tpgmm_control import Controller, rollout
from tpgmm_torch import Frame, Sequence, Situation, ViaPoints, Ways
from tpgmm_torch.exceptions import DataError, PlausibilityWarning


@pytest.mark.parametrize("task", [Obstacle, Handles])
def test_new_situations_are_reproduced_in_a_way_that_succeeds(task):
    selection, work = fitted(task), task()
    situations = work.situations(10, 1)
    done = rollout(selection.skill_, situations, bounds="robot", blend=1.0)
    assert sum(map(work.succeeded, done, situations)) >= 9


def test_a_choice_has_reasons_and_the_trajectory_is_that_of_the_way():
    selection = fitted(Obstacle)
    [situation] = Obstacle().situations(1, 2)
    [choice] = selection.skill_.choose(situation.joints, situation.frames)
    assert choice.way == int(choice.probabilities.argmax())
    assert choice.probabilities.sum() == pytest.approx(1.0)
    assert f"way {choice.way} (way 0: p = " in str(choice)
    [whole] = rollout(selection.skill_, [situation])
    [alone] = rollout(selection.models_[choice.way].skill, [situation])
    torch.testing.assert_close(whole.joints, alone.joints, rtol=0, atol=1e-12)


def test_robots_of_a_batch_each_go_their_own_way():
    selection = fitted(Handles)
    situations = [*another_handle_each(), *Handles().situations(4, 3)]
    starts = torch.stack([one.joints for one in situations])
    names = situations[0].frames
    frames = {name: Frame.stack([one.frames[name] for one in situations]) for name in names}
    begun = selection.skill_.start(starts, frames)
    choices = [selection.skill_.choose(one.joints, one.frames)[0] for one in situations]
    assert begun.chosen.tolist() == [one.way for one in choices]
    assert len(set(begun.chosen.tolist())) == 2
    together = begun.estimate(torch.tensor(1.0), starts, frames).joints
    times, state = begun.time[:9], begun.kinematics.state(starts)
    likely = begun.log_likelihood(times, state, frames)
    for row, one in enumerate(situations):
        way = selection.models_[begun.chosen[row]].skill
        alone = way.estimate(torch.tensor(1.0), one.joints, one.frames).joints
        torch.testing.assert_close(together[row], alone)
        own = {name: frame[row : row + 1] for name, frame in frames.items()}
        alone = way.log_likelihood(times, way.kinematics.state(starts[row : row + 1]), own)
        torch.testing.assert_close(likely[row], alone[0])


def test_a_controller_runs_the_way_that_was_chosen():
    selection = fitted(Obstacle)
    [situation] = Obstacle().situations(1, 2)
    [choice] = selection.skill_.choose(situation.joints, situation.frames)
    commands = []
    for skill in (selection.skill_, selection.models_[choice.way].skill):
        running = Controller(skill, situation.joints, situation.frames, clock="even")
        commands.append(torch.stack([running.step(0.05).reference for _ in range(20)]))
    torch.testing.assert_close(*commands, rtol=0, atol=1e-6)


def test_objects_far_from_those_of_every_way_are_named():
    skill, [one] = fitted(Obstacle).skill_, Obstacle().situations(1, 2)
    [known] = rollout(skill, [one])  # warnings are errors
    name = next(iter(one.frames))
    pose = one.frames[name]
    away = {**one.frames, name: Frame(pose.position + 4.0, pose.orientation)}
    with pytest.warns(PlausibilityWarning, match=f"place: {name}: .* shown") as caught:
        [done] = rollout(skill, [Situation(one.joints, away)])
    with pytest.warns(PlausibilityWarning, match=f"place: {name}: .* shown"):
        Controller(skill, one.joints, away)
    assert len(caught) == 1 and known.novelty < 1.5 < done.novelty


def test_ways_that_do_not_fit_together_are_refused():
    one = fitted(Obstacle).models_[0].skill
    for weights, limits, message in (
        ((0.5,), (), "2 ways with 1 weights"),
        ((0.5, 0.0), (), "weights positive"),
        ((0.5, 0.5), (np.inf, 1.0), "finite"),
    ):
        refused(
            lambda limits=limits, weights=weights: Ways((one, one), weights, limits),
            DataError,
            message,
        )
    refused(lambda: Ways(()), DataError)


@pytest.mark.filterwarnings("ignore:.*one thing is implausible")  # one handle is far away
def test_the_way_is_one_that_the_robot_can_do():
    ways, chosen = fitted(Handles).skill_, set()
    for situation in (*reach_of_one_handle(2), *reach_of_one_handle(2, angles=(-0.6, 0))):
        [choice] = ways.choose(situation.joints, situation.frames)
        assert choice.misfit[1 - choice.way] > choice.misfit[choice.way]
        assert choice.probabilities[choice.way] > 0.9
        chosen.add(choice.way)
        # what was shown more often does not help the arm to reach
        other = np.where(np.arange(2) == choice.way, 0.01, 0.99)
        biased = Ways(ways.skills, tuple(other), ways.limits)
        assert biased.choose(situation.joints, situation.frames)[0].way == choice.way
    assert chosen == {0, 1}


@pytest.mark.filterwarnings("ignore:.*one thing is implausible")
@pytest.mark.parametrize(
    "wrapped",
    [lambda ways: Sequence((ways,)), lambda ways: ViaPoints(ways, ["1.5:canonical=wrist:0.7"])],
    ids=["sequence", "via-points"],
)
def test_ways_inside_of_other_skills_are_chosen_for_each_robot(wrapped):
    ways, situations = fitted(Handles).skill_, another_handle_each()
    starts = torch.stack([one.joints for one in situations])
    frames = {"object": Frame.stack([one.frames["object"] for one in situations])}
    begun = wrapped(ways).start(starts, frames)
    inner = begun.skill if isinstance(begun, ViaPoints) else begun.skills[0]
    assert sorted(inner.chosen.tolist()) == [0, 1]
    now = torch.tensor(1.2, dtype=torch.float64)
    together = begun.estimate(now, starts, frames)
    after = begun.advance(together)
    for row in range(2):
        only = torch.arange(2) == row
        frame = {"object": frames["object"][only]}
        alone = begun.of_robots(only).estimate(now, starts[only], frame)
        torch.testing.assert_close(alone.joints[0], together.joints[row], rtol=0, atol=1e-9)
        again = after.of_robots(only).estimate(now + 0.1, starts[only], frame)
        both = after.estimate(now + 0.1, starts, frames)
        torch.testing.assert_close(again.joints[0], both.joints[row], rtol=0, atol=1e-9)
