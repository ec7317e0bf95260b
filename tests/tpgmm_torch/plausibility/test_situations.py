"""Situations and first ticks: the model says what it was not shown."""

import math
import warnings

import pytest
import torch

from tests.support.skills import bottle_model, few_bottles, small_bottle
from tests.support.worlds import upper_body
from tpgmm_torch import Frame, Situation, TaskParameterizedGMM
from tpgmm_torch.exceptions import PlausibilityError, PlausibilityWarning
from tpgmm_torch.plausibility.situations import situations_report, tick_report


def given(count=1):
    return [Situation(d.joints[0], d.frames) for d in few_bottles()[:count]]


def report(*situations):
    model = small_bottle()
    return situations_report(situations, model.shown_, model.time_, model.kinematics_)


def test_what_was_shown_is_plausible():
    assert report(*given(4)).findings == ()


def test_many_situations_are_told_apart():
    one, two = given(2)
    odd = Situation(two.joints, {"bottle": Frame([0.3, 0.0, 2.0])})
    [finding] = report(one, odd)
    assert "situation 1, bottle: z = 2 m" in finding.message


def test_degrees_are_an_error_and_told_once():
    [one] = given()
    [finding] = report(Situation(one.joints * 180 / math.pi, one.frames))
    assert (finding.severity, finding.check) == ("error", "units")


def test_a_model_without_memory_knows_the_limits_alone():
    [one] = given()
    model = small_bottle()
    odd = Situation(one.joints, {"bottle": Frame([9.0, 9, 9])})
    assert situations_report([odd], None, model.time_, upper_body()).findings == ()


def test_a_batch_of_ticks_names_the_worst_robot():
    model, [one] = small_bottle(), given()
    joints = one.joints.expand(3, -1)
    places = one.frames["bottle"].position + torch.tensor([[0.0], [5.0], [0.0]])
    frames = {"bottle": Frame(places, one.frames["bottle"].orientation.expand(3, 4))}
    now = torch.tensor(0.0)
    found = tick_report(now, joints, frames, model.shown_, model.time_, upper_body())
    assert [f.check for f in found] == ["place"] and found.findings[0].value > 5


def test_only_the_first_tick_is_looked_at_and_a_posture_only_at_the_start():
    model, [one] = bottle_model(3, tol=1e6).fit(few_bottles()), given()
    bent = one.joints.clone()
    bent[4] += 1.2
    middle = float(model.time_[len(model.time_) // 2])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        model.step(middle, bent, one.frames)
        model.step(0.0, bent, one.frames)  # not looked at
    with pytest.warns(PlausibilityWarning, match="start posture"):
        model.fit(few_bottles()).step(0.0, bent, one.frames)
    with pytest.warns(PlausibilityWarning, match="start posture"):
        model.controller(bent, one.frames)


def test_a_saved_model_remembers_and_strictness_is_kept(tmp_path):
    model = bottle_model(3, tol=1e6, plausibility="error").fit(few_bottles())
    model.save(tmp_path / "model")
    again = TaskParameterizedGMM.load(tmp_path / "model")
    assert again.shown_ == model.shown_
    [one] = given()
    odd = Situation(one.joints, {"bottle": Frame([0.3, 0.0, 2.0])})
    with pytest.raises(PlausibilityError, match="bottle: z = 2 m, shown"):
        again.predict([odd])


def test_a_trajectory_says_how_new_its_situation_was(tmp_path):
    model, [one] = bottle_model(3, tol=1e6, plausibility="ignore").fit(few_bottles()), given()
    away = Frame(one.frames["bottle"].position + 0.3, one.frames["bottle"].orientation)
    situations = [one, Situation(one.joints, {"bottle": away})]
    novelty = [t.novelty for t in model.predict(situations, candidates=False)]
    measured = [float(model.shown_.novelty.ratio(s.joints, s.frames)) for s in situations]
    assert novelty == measured and novelty[0] <= 1 < novelty[1]
    assert model.sample(situations[1])[0].novelty == novelty[1]
    model.save(tmp_path / "model")
    again = TaskParameterizedGMM.load(tmp_path / "model")
    assert [t.novelty for t in again.predict(situations, candidates=False)] == novelty


def test_a_command_says_how_new_the_situation_is_now():
    model, [one] = bottle_model(3, tol=1e6, plausibility="ignore").fit(few_bottles()), given()
    bottle = one.frames["bottle"]
    away = Frame(bottle.position + 0.3, bottle.orientation)
    controller = model.controller(one.joints.expand(2, -1), one.frames, trust=None)
    [before, _] = controller.step(0.02).novelty.tolist()
    both = Frame.stack([bottle, away])
    after = controller.step(0.02, frames={"bottle": both}).novelty
    assert after[0] == before == pytest.approx(model.predict([one])[0].novelty)
    assert after[1] > 1
    # a posture from which nobody starts counts only where the skill begins
    bent = one.joints + 0.5
    begun = model.controller(bent, one.frames, clock="localizing:initial=anywhere")
    middle = model.predict([one])[0].joints[len(model.time_) // 2]
    resumed = model.controller(middle, one.frames, clock="localizing:initial=anywhere")
    assert float(begun.step(0.02).novelty) > 1 >= float(resumed.step(0.02).novelty)


def test_a_model_that_does_not_know_its_demonstrations_says_nothing():
    model, [one] = small_bottle(), given()
    bare = TaskParameterizedGMM.from_parameters(
        model.weights_, model.means_, model.covariances_, model.time_,
        operators=model.operators_, robot=model.kinematics_,
    )  # fmt: skip
    assert bare.predict([one])[0].novelty is None
    assert bare.controller(one.joints, one.frames).step(0.02).novelty is None
