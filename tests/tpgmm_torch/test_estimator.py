"""The estimator: what it learns from demonstrations."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support import skills
from tests.support.skills import (
    HANDLING,
    HANDS,
    apart,
    canonical,
    handlings,
    hands_model,
    new_handling,
    same,
    small_bottle,
    tensors,
    wave,
    waves,
)
from tpgmm_torch import (
    Canonical,
    Demonstration,
    Situation,
)
from tpgmm_torch.metrics import joint_rmse
from tpgmm_torch.mixture.block_gaussian_mixture import BlockGaussianMixture
from tpgmm_torch.robots.joint_space import JointSpace
from tpgmm_torch.training.local_data import local_data


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
    mixture = BlockGaussianMixture(**model.mixture_.get_params()).fit(rows)
    same(model, mixture, 1e-8)
    assert model.lower_bound_ == pytest.approx(mixture.lower_bound_)


def test_instants_are_learned_by_the_mixture_of_groups():
    model = hands_model().fit(handlings(3))
    rows = local_data(handlings(3), HANDLING, HANDS)
    interleaved = torch.stack([row[t] for t in range(30) for row in rows]).numpy()
    assert model.mixture_.group_size == 3
    mixture = BlockGaussianMixture(**model.mixture_.get_params()).fit(interleaved)
    same(model, mixture, 1e-8)


def test_different_grids_are_learned_point_by_point():
    uneven = [*waves(2), *waves(1, length=25)]
    model = canonical().fit(uneven)
    assert model.mixture_.group_size == 1
    same(model, canonical(responsibilities="point").fit(uneven))


def test_covariance_types_are_those_of_the_mixture():
    strict = {"operators": [Canonical(tolerance=0.0)]}
    cov = canonical(**strict, covariance_type="diag").fit(waves()).covariances_[0]
    assert torch.equal(cov, torch.diag_embed(cov.diagonal(dim1=1, dim2=2)))
    cov = canonical(**strict, covariance_type="spherical").fit(waves()).covariances_[0]
    assert torch.equal(cov, cov[:, :1, :1] * torch.eye(4, dtype=cov.dtype))
    cov = canonical(**strict, covariance_type="tied", tol=0.1).fit(waves()).covariances_[0]
    assert torch.equal(cov, cov[:1].expand_as(cov))


def test_several_starts_are_not_worse_than_one():
    bounds = [
        hands_model(n_components=3, init_params="random", random_state=4, n_init=n)
        .fit(handlings())
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
    operators = [*HANDLING, Canonical()]
    double, single = (
        hands_model(operators=operators, dtype=name).fit(handlings())
        for name in ("float64", "float32")
    )
    assert {t.dtype for t in (single.weights_, *single.means_)} == {torch.float32}
    [wanted], [found] = double.predict(handlings()[:1]), single.predict(handlings()[:1])
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


def test_coordinates_that_vary_by_rounding_alone_do_not_become_certain():
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
