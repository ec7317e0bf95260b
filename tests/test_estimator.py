"""The estimator: what it learns, and what predict, step, score and sample make of it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests import oracles, skills
from tests.mixtures import both_hands
from tests.skills import (
    HANDLING,
    HANDS,
    LAST,
    bottle_model,
    few_bottles,
    handling,
    handlings,
    hands,
    hands_model,
    small_bottle,
    tensors,
    wave,
    waves,
)
from tests.worlds import MOVED, OBJECT, OnPoses, OnRobot, moved
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Frame,
    Situation,
    TaskParameterizedGMM,
)
from tpgmm_torch.block_gaussians import SMALLEST_SHARE
from tpgmm_torch.joint_space import JointSpace
from tpgmm_torch.local_data import local_data
from tpgmm_torch.metrics import joint_rmse
from tpgmm_torch.mixture import BlockGaussianMixture


def canonical(**options) -> TaskParameterizedGMM:
    return TaskParameterizedGMM(**{"n_components": 6, "blend": 0.0, **options})


def same(a: TaskParameterizedGMM, b: TaskParameterizedGMM, tolerance: float = 0.0) -> None:
    """Two models are one, to a relative tolerance."""
    close = {"rtol": tolerance, "atol": tolerance}
    torch.testing.assert_close(a.weights_, b.weights_, **close)
    torch.testing.assert_close(a.means_, b.means_, **close)
    torch.testing.assert_close(a.covariances_, b.covariances_, **close)


def apart(a, b) -> float:
    return float((a.double() - b.double()).abs().max())


def new_handling(moves: bool = False, seed: int = 7) -> tuple[Situation, torch.Tensor]:
    """A situation never seen, and the motion that fits it."""
    time = torch.linspace(0, LAST, 30, dtype=torch.float64)
    cup = skills.cups(1, seed)[0]
    cup = skills.moving(cup, time) if moves else cup
    wanted = handling(cup, time)
    return Situation(wanted[0], {"cup": cup}, time), wanted


# Learning


def test_what_is_learned_has_the_shapes_of_the_documentation():
    model, K = small_bottle(), 8
    assert model.weights_.shape == (K,)
    assert [tuple(mean.shape) for mean in model.means_] == [(K, 15), (K, 18)]
    assert [tuple(c.shape) for c in model.covariances_] == [(K, 15, 15), (K, 18, 18)]
    assert model.frame_names_ == ("bottle",)
    assert model.n_iter_ >= 1 and model.converged_ is True
    assert np.isfinite(model.lower_bound_)


def test_without_operators_and_robot_it_learns_the_joints():
    model = canonical().fit(waves())
    assert model.operators_ == (Canonical(),)
    assert model.kinematics_ == JointSpace(skills.JOINT_NAMES)
    [trajectory] = model.predict([Situation([0.0, 1.0, 0.0])])
    assert trajectory.joint_names == skills.JOINT_NAMES
    assert apart(trajectory.joints, wave(trajectory.time)) < 0.08  # 0.057 measured


def test_the_grid_is_that_of_the_demonstration_of_median_duration():
    short, middle, long = (
        Demonstration(torch.linspace(0, end, 20), torch.rand(20, 1)) for end in (1.0, 2.0, 5.0)
    )
    assert torch.equal(canonical().fit([long, middle, short]).time_, middle.time.double())


@pytest.mark.parametrize("moves", [False, True], ids=["standing", "moving"])
def test_hands_are_reproduced_about_a_cup_never_seen(moves):
    model = hands_model(n_components=10).fit(handlings(moves=moves))
    situation, wanted = new_handling(moves)
    [trajectory] = model.predict([situation])
    assert apart(trajectory.joints, wanted) < 2e-3  # 0.8e-3 measured; noise of 1e-3
    [seen] = model.predict(handlings(moves=moves)[:1])
    assert apart(seen.joints, handlings(moves=moves)[0].joints) < 3e-3  # 1.2e-3 measured


def test_a_demonstrated_situation_is_reproduced_closely():
    demonstration = skills.bottle_demonstrations()[0]
    [trajectory] = skills.bottle().predict([demonstration], candidates=False)
    assert joint_rmse(trajectory, demonstration) < 0.03  # 0.0143 measured
    at = int(torch.searchsorted(trajectory.time, demonstration.events["grasp"]))
    errors = skills.generator().grasp_error(
        trajectory.joints[at], demonstration.frames["bottle"]
    )
    assert float(errors[0]) < 1e-3 and float(errors[1]) < 2e-3  # 0.02 mm, 0.06 mrad measured


def test_a_bottle_never_seen_is_grasped():
    situations = skills.generator().situations(8, seed=99)
    trajectories = skills.bottle().predict(situations, candidates=False)
    event = skills.bottle_demonstrations()[0].events["grasp"]
    at = int(torch.searchsorted(trajectories[0].time, event))
    for trajectory, situation in zip(trajectories, situations, strict=True):
        position, turn = skills.generator().grasp_error(
            trajectory.joints[at], situation.frames["bottle"]
        )
        assert float(position) < 2e-3  # at most 0.43 mm measured
        assert float(turn) < np.radians(1)


def test_one_demonstration_has_the_responsibilities_of_its_points():
    one = waves(1)
    models = [canonical(responsibilities=r).fit(one) for r in ("auto", "instant", "point")]
    same(models[0], models[2])
    same(models[1], models[2])


def test_points_are_learned_by_the_mixture_of_points():
    model = hands_model(responsibilities="point").fit(handlings())
    rows = torch.cat(local_data(handlings(), HANDLING, HANDS)).numpy()
    mixture = BlockGaussianMixture(6, blocks=(8, 8)).fit(rows)
    same(model, mixture)
    assert model.lower_bound_ == mixture.lower_bound_


def test_instants_are_learned_by_the_mixture_of_groups():
    model = hands_model().fit(handlings(3))
    rows = local_data(handlings(3), HANDLING, HANDS)
    interleaved = torch.stack([row[t] for t in range(30) for row in rows]).numpy()
    same(model, BlockGaussianMixture(6, blocks=(8, 8), group_size=3).fit(interleaved))


def test_different_grids_are_learned_point_by_point():
    uneven = [*waves(2), *waves(1, length=25)]
    model = canonical().fit(uneven)
    assert model.mixture_.group_size == 1
    same(model, canonical(responsibilities="point").fit(uneven))


def test_covariance_types_are_those_of_the_mixture():
    cov = canonical(covariance_type="diag").fit(waves()).covariances_[0]
    assert torch.equal(cov, torch.diag_embed(cov.diagonal(dim1=1, dim2=2)))
    cov = canonical(covariance_type="spherical").fit(waves()).covariances_[0]
    assert torch.equal(cov, cov[:, :1, :1] * torch.eye(4, dtype=cov.dtype))
    cov = canonical(covariance_type="tied", tol=0.1).fit(waves()).covariances_[0]
    assert torch.equal(cov, cov[:1].expand_as(cov))


def test_several_starts_are_not_worse_than_one():
    bounds = [
        canonical(init_params="random", random_state=0, tol=0.1, n_init=n)
        .fit(waves())
        .lower_bound_
        for n in (1, 5)
    ]
    assert bounds[0] < bounds[1]


def test_the_same_random_state_gives_the_same_model():
    fits = [
        canonical(init_params="random", random_state=seed, tol=0.1).fit(waves())
        for seed in (3, 3, 4)
    ]
    same(fits[0], fits[1])
    assert not torch.equal(fits[0].means_[0], fits[2].means_[0])


def test_a_warm_start_goes_on_from_the_last_model():
    model = canonical(tol=1e-6, warm_start=True).fit(waves())
    cold, bound = model.n_iter_, model.lower_bound_
    model.fit(waves())
    assert model.n_iter_ < cold and model.n_iter_ <= 3
    assert model.lower_bound_ >= bound - 1e-9


def test_order_of_joints_does_not_matter():
    order = (2, 0, 1)
    names = tuple(skills.JOINT_NAMES[i] for i in order)
    shuffled = [
        replace(item, joints=item.joints[:, order], joint_names=names) for item in waves()
    ]
    model = canonical().fit(waves())
    same(canonical().fit([waves()[0], *shuffled[1:]]), model)
    on_robot = canonical(robot=JointSpace(skills.JOINT_NAMES)).fit(shuffled)
    same(on_robot, model)
    assert on_robot.score(shuffled) == model.score(waves())
    [a], [b] = on_robot.predict(shuffled[:1]), model.predict(waves()[:1])
    assert torch.equal(a.joints, b.joints)


def test_arrays_of_numpy_serve_as_tensors_do():
    arrays = [
        Demonstration(d.time.numpy(), d.joints.numpy(), joint_names=d.joint_names)
        for d in waves()
    ]
    model = canonical().fit(arrays)
    same(model, canonical().fit(waves()))
    start = np.array([0.0, 1.0, 0.0])
    [a], [b] = model.predict(Situation(start)), model.predict(Situation(torch.tensor(start)))
    assert torch.equal(a.joints, b.joints)
    estimate = model.step(0.5, start)
    assert torch.equal(estimate.joints, model.step(torch.tensor(0.5), start.tolist()).joints)


def test_single_precision_agrees_with_double():
    double, single = hands(), hands_model(dtype="float32").fit(handlings())
    assert {t.dtype for t in (single.weights_, *single.means_)} == {torch.float32}
    situation, _ = new_handling()
    [wanted], [found] = double.predict([situation]), single.predict([situation])
    assert found.joints.dtype == found.covariance.dtype == torch.float32
    assert apart(found.joints, wanted.joints) < 2e-3
    assert single.score(handlings()) == pytest.approx(double.score(handlings()), rel=1e-2)


def test_nothing_given_is_modified():
    demonstrations, (situation, _) = handlings(moves=True), new_handling(moves=True)
    state = situation.joints.clone()
    given = [*demonstrations, situation]
    before, raw = tensors(given), state.clone()
    model = hands_model().fit(demonstrations)
    model.predict([situation, demonstrations[0]])
    model.score(demonstrations)
    model.sample(situation, 2, random_state=0)
    model.step(0.3, state, {"cup": situation.frames["cup"][4]})
    assert all(torch.equal(a, b) for a, b in zip(before, tensors(given), strict=True))
    assert torch.equal(state, raw)


# Reproduction


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


def test_coordinates_that_vary_by_rounding_alone_do_not_become_certain():
    assert SMALLEST_SHARE[torch.float64] < 1e-6
    # a cup and hands that turn about one axis: two of the quaternions' columns are rounding
    rng = np.random.default_rng(0)
    exact = handlings()
    noisy = [
        replace(item, joints=item.joints + 1e-17 * torch.from_numpy(rng.standard_normal(14)))
        for item in exact
    ]
    model = hands_model(operators=[HANDLING[0], Canonical()]).fit(noisy)
    deviations = model.covariances_[0].diagonal(dim1=1, dim2=2).sqrt()
    assert float(deviations.min()) > 1e-7
