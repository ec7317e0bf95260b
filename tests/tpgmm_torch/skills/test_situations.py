"""Situations and first ticks that are unlike the demonstrations are named."""

import warnings

import pytest
import torch

from tests.support.skills import bottle_model, few_bottles, small_bottle
from tpgmm_control import Controller
from tpgmm_torch import Frame, Situation, TaskParameterizedGMM, save
from tpgmm_torch.exceptions import PlausibilityError, PlausibilityWarning
from tpgmm_torch.persistence import load_model
from tpgmm_torch.skills.situations import check_situations

ODD = {"bottle": Frame([0.3, 0.0, 2.0])}


def given(count=1):
    return [Situation(d.joints[0], d.frames) for d in few_bottles()[:count]]


def learn_model():
    return bottle_model(3, tol=1e6).fit(few_bottles())


def report(joints, frames):
    return check_situations(small_bottle().skill, joints, frames, torch.tensor(0.0))


def test_a_batch_names_the_most_unlike_robot():
    [one] = given()
    joints, bottle = one.joints.expand(3, -1), one.frames["bottle"].expand((3,))
    assert report(joints, {"bottle": bottle}).findings == ()
    away = bottle.position + torch.tensor([[0.0], [5.0], [0.0]])
    [finding] = report(joints, {"bottle": Frame(away, bottle.orientation)})
    assert finding.check == "place" and finding.value > 5
    assert "situation 1, bottle: " in finding.message


def test_only_the_first_tick_is_checked_and_a_posture_only_at_the_start():
    model, [one] = learn_model(), given()
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
        Controller(model.skill, bent, one.frames)


def test_a_saved_model_knows_its_demonstrations(tmp_path):
    model, [one] = learn_model(), given()
    save(model, tmp_path / "model")
    again = load_model(tmp_path / "model")
    assert again.summary_ == model.summary_
    with pytest.warns(PlausibilityWarning, match="bottle: z = 2, shown"):
        again.predict([Situation(one.joints, ODD)])
    with pytest.raises(PlausibilityError, match="cannot be in radians"):
        again.predict([one, Situation(one.joints * 60, one.frames)])


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_a_trajectory_has_the_novelty_of_its_situation():
    model, [one] = learn_model(), given()
    away = Frame(one.frames["bottle"].position + 0.3, one.frames["bottle"].orientation)
    situations = [one, Situation(one.joints, {"bottle": away})]
    novelty = [t.novelty for t in model.predict(situations, candidates=False)]
    measured = [float(model.summary_.novelty(s.joints, s.frames)) for s in situations]
    assert novelty == measured and novelty[0] <= 1 < novelty[1]
    assert model.sample(situations[1])[0].novelty == novelty[1]


@pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
def test_a_command_has_the_novelty_of_the_situation_now():
    model, [one] = learn_model(), given()
    bottle = one.frames["bottle"]
    away = Frame(bottle.position + 0.3, bottle.orientation)
    controller = Controller(model.skill, one.joints.expand(2, -1), one.frames, trust=None)
    [before, _] = controller.step(0.02).novelty.tolist()
    after = controller.step(0.02, frames={"bottle": Frame.stack([bottle, away])}).novelty
    assert after[0] == before == pytest.approx(model.predict([one])[0].novelty)
    assert after[1] > 1
    # a posture from which nobody starts counts only where the skill begins
    begun = Controller(
        model.skill, one.joints + 0.5, one.frames, clock="localizing:initial=anywhere"
    )
    middle = model.predict([one])[0].joints[len(model.time_) // 2]
    resumed = Controller(model.skill, middle, one.frames, clock="localizing:initial=anywhere")
    assert float(begun.step(0.02).novelty) > 1 >= float(resumed.step(0.02).novelty)


def test_a_model_without_a_summary_gives_no_novelty():
    model, [one] = small_bottle(), given()
    bare = TaskParameterizedGMM.from_parameters(
        model.weights_, model.means_, model.covariances_, model.time_,
        operators=model.operators_, robot=model.kinematics_,
    )  # fmt: skip
    assert bare.predict([one])[0].novelty is None
    assert Controller(bare.skill, one.joints, one.frames).step(0.02).novelty is None
