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
