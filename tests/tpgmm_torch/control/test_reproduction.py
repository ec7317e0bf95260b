"""Reproduction by a fitted model: predict, step, score and sample."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support import oracles, skills
from tests.support.mixtures import both_hands
from tests.support.skills import (
    LAST,
    apart,
    bottle_model,
    canonical,
    few_bottles,
    handlings,
    hands,
    hands_model,
    new_handling,
    same,
    small_bottle,
    waves,
)
from tests.support.worlds import MOVED, OBJECT, OnPoses, OnRobot, moved
from tpgmm_torch import (
    Canonical,
    Frame,
    Situation,
)
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.training.local_data import local_data


@pytest.mark.parametrize("activation", ["time", "product"])
@pytest.mark.parametrize("fusion", ["information", "covariance"])
def test_a_fitted_model_answers_as_table_i_says(fusion, activation):
    epsilon = 1e-4 if fusion == "covariance" else None
    model = bottle_model(8, tol=1e-2, fusion=fusion, activation=activation, negligible=0.0)
    model.fit(few_bottles())
    demonstration = few_bottles()[1]
    state = model.kinematics_.state(demonstration.joints[12])
    at = OnRobot().at(state, {OBJECT: demonstration.frames["bottle"]})
    mixtures = [
        oracles.Local(mean.numpy(), covariance.numpy())
        for mean, covariance in zip(model.means_, model.covariances_, strict=True)
    ]
    # the oracle knows no signs of quaternions
    here = model.operators_[0].coordinates(state, demonstration.frames)
    for start in (3, 10):
        assert bool((model.means_[0][:, 1:][:, start : start + 4] @ here[start:][:4] > 0).all())
    answer = oracles.regress(
        float(demonstration.time[12]),
        at.joints,
        [both_hands(at), oracles.canonical(at)],
        mixtures,
        model.weights_.numpy(),
        activation=activation,
        epsilon=epsilon,
    )
    estimate = model.step(
        demonstration.time[12], state, {"bottle": demonstration.frames["bottle"]}
    )
    assert apart(estimate.joints, torch.from_numpy(answer.mean)) < 1e-5
    assert apart(estimate.activation, torch.from_numpy(answer.activation)) < 1e-5


def test_predict_is_step_after_step():
    model = small_bottle().__sklearn_clone__().set_params(blend=0.0, keep_limits=False)
    model.fit(few_bottles())
    demonstration = few_bottles()[2]
    [trajectory] = model.predict([demonstration])
    joints = demonstration.joints[0]
    for k, now in enumerate(trajectory.time):
        estimate = model.step(now, joints, demonstration.frames, candidates=True)
        joints = estimate.joints
        torch.testing.assert_close(trajectory.joints[k], joints, rtol=0, atol=1e-9)
        for whole, one in zip(trajectory.candidates, estimate.candidates, strict=True):
            torch.testing.assert_close(whole.mean[k], one.mean, rtol=0, atol=1e-8)


def test_a_batch_of_robots_steps_as_each_of_them():
    model, batch = small_bottle(), few_bottles()
    joints = torch.stack([item.joints[9] for item in batch])
    frames = [item.frames["bottle"] for item in batch]
    together = Frame(
        torch.stack([f.position for f in frames]), torch.stack([f.orientation for f in frames])
    )
    times = torch.tensor([2.0, 2.5, 3.0, 3.5], dtype=torch.float64)
    estimate = model.step(times, joints, {"bottle": together}, candidates=True)
    for i in range(4):
        single = model.step(times[i], joints[i], {"bottle": frames[i]})
        torch.testing.assert_close(estimate.joints[i], single.joints, rtol=0, atol=1e-7)


def test_one_situation_is_a_list_of_one():
    [a], [b] = (
        small_bottle().predict(few_bottles()[0]),
        small_bottle().predict(few_bottles()[:1]),
    )
    assert torch.equal(a.joints, b.joints)


def test_a_start_elsewhere_blends_in_without_a_jump():
    start = torch.tensor([0.4, 0.7, -0.3], dtype=torch.float64)
    situation = Situation(start, time=torch.linspace(0, LAST, 101))
    blended = canonical(blend=0.5).fit(waves())
    [soft] = blended.predict([situation])
    [hard] = blended.set_params(blend=0.0).predict([situation])
    torch.testing.assert_close(soft.joints[0], start)
    assert float(soft.joints[:2].diff(dim=0).abs().max()) < 0.07  # the motion's own is 0.06
    assert apart(hard.joints[0], start) > 0.25
    torch.testing.assert_close(soft.joints[26:], hard.joints[26:])


def test_references_keep_limits_of_position_and_speed():
    robot = JointSpace(skills.JOINT_NAMES)
    robot.lower, robot.upper = torch.tensor([-0.3] * 3), torch.tensor([0.8] * 3)
    robot.velocity = torch.tensor([2.0, 2.0, 0.3])
    robot = robot.to(torch.float64)
    situation = Situation([0.0, 0.8, 0.0], time=torch.linspace(0, LAST, 101))
    model = canonical(robot=robot).fit(waves())
    for keep, broken in ((True, False), (False, True)):
        [trajectory] = model.set_params(keep_limits=keep).predict([situation])
        speed = (trajectory.joints.diff(dim=0) / trajectory.time.diff()[:, None]).abs()
        outside = (trajectory.joints < robot.lower - 1e-9) | (
            trajectory.joints > robot.upper + 1e-9
        )
        assert bool(outside.any()) is broken
        assert bool((speed > robot.velocity + 1e-9).any()) is broken


def test_moving_the_world_moves_the_reproduction():
    world = OnPoses()
    there = [
        replace(
            item,
            joints=world.moved_answer(item.joints),
            frames={name: moved(frame) for name, frame in item.frames.items()},
        )
        for item in handlings()
    ]
    situation, _ = new_handling()
    elsewhere = Situation(
        world.moved_answer(situation.joints),
        {"cup": moved(situation.frames["cup"])},
        situation.time,
    )
    assert apart(MOVED.position, torch.zeros(3)) > 0.5
    [here], [there] = (
        hands().predict([situation]),
        hands_model().fit(there).predict([elsewhere]),
    )
    torch.testing.assert_close(there.joints, world.moved_answer(here.joints), rtol=0, atol=1e-6)


def test_signs_of_recorded_quaternions_mean_nothing():
    flipped = [
        replace(
            item,
            joints=OnPoses().flipped_answer(item.joints),
            frames={n: Frame(f.position, -f.orientation) for n, f in item.frames.items()},
        )
        for item in handlings()
    ]
    model = hands()
    np.testing.assert_allclose(
        model.score_samples(flipped), model.score_samples(handlings()), rtol=1e-9
    )
    mixed = hands_model().fit([*handlings()[:2], *flipped[2:]])
    same(mixed, model, 1e-9)
    [a], [b] = model.predict(flipped[:1]), model.predict(handlings()[:1])
    torch.testing.assert_close(OnPoses().flipped_answer(a.joints), b.joints)


def test_a_score_is_the_mean_over_all_time_steps():
    uneven = [*waves(2), *waves(1, length=12)]
    model = canonical().fit(waves())
    values = model.score_samples(uneven)
    assert values.shape == (3,)
    assert model.score(uneven) == pytest.approx(values @ [30, 30, 12] / 72)
    rows = torch.cat(local_data(uneven, [Canonical()], model.kinematics_)).numpy()
    assert model.score(uneven) == pytest.approx(model.mixture_.score(rows))
    assert model.bic(uneven) == pytest.approx(model.mixture_.bic(rows))
    assert model.aic(uneven) == pytest.approx(model.mixture_.aic(rows))


def test_another_motion_is_less_likely():
    model, [one] = canonical().fit(waves()), waves(1)
    other = replace(one, joints=one.joints.flip(0))
    assert model.score([other]) < model.score([one]) - 10


def test_samples_have_the_law_of_the_reproduction_at_every_instant():
    model = canonical(n_components=4).fit(waves())
    situation = Situation([0.0, 1.0, 0.0])
    [mean] = model.predict([situation])
    n = 4000
    samples = torch.stack([s.joints for s in model.sample(situation, n, random_state=0)])
    for at in (0, 11, 29):
        spread = mean.covariance[at].diagonal().sqrt()
        error = (samples[:, at].mean(0) - mean.joints[at]) / spread
        assert float(error.abs().max()) < 5 / np.sqrt(n)
        covariance = torch.cov(samples[:, at].T)
        relative = (covariance - mean.covariance[at]) / torch.outer(spread, spread)
        assert float(relative.abs().max()) < 5 * np.sqrt(2 / n)


def test_samples_are_those_of_their_random_state_and_as_smooth_as_the_model():
    situation, _ = new_handling()
    a, b, c = (hands().sample(situation, 2, random_state=seed) for seed in (0, 0, 1))
    assert torch.equal(a[1].joints, b[1].joints)
    assert not torch.equal(a[0].joints, a[1].joints)
    assert not torch.equal(a[0].joints, c[0].joints)
    assert float(a[0].joints.diff(dim=0).abs().max()) < 0.2
    quaternions = a[0].joints.unflatten(-1, (2, 7))[..., 3:]
    torch.testing.assert_close(quaternions.norm(dim=-1), torch.ones(30, 2, dtype=torch.float64))
