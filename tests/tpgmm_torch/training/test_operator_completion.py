"""Completion of operators from demonstrations: mean orientations, axes of forces."""

import math
from dataclasses import replace
from functools import cache, partial

import numpy as np
import pytest
import torch

from tests.support.local_coordinates import local_coordinates
from tests.support.pressing import FRICTION, PRESS, slides, wipes
from tests.support.skills import few_bottles
from tests.support.worlds import OBJECT, moved, upper_body
from tpgmm_torch import (
    AbsoluteOrientation,
    Canonical,
    Demonstration,
    Frame,
    RelativeOrientation,
    RelativePosition,
    Situation,
    Stack,
    TaskParameterizedGMM,
    quaternions,
)
from tpgmm_torch.exceptions import DataError
from tpgmm_torch.operators import Wrench
from tpgmm_torch.regression.conditionals import TimeMarginals
from tpgmm_torch.regression.fusion_forms import CovarianceFusion
from tpgmm_torch.regression.posture import PostureCost
from tpgmm_torch.regression.time_likelihood import TimeLikelihood
from tpgmm_torch.robots import Poses
from tpgmm_torch.skills.compiled import compile_skill
from tpgmm_torch.training.local_data import Motion
from tpgmm_torch.training.operator_completion import (
    shares_of_work,
    with_force_axes,
    with_mean_orientations,
)

HAND = Poses(("hand",))
TIME = torch.linspace(0, 3, 60, dtype=torch.float64)
ABSOLUTE = AbsoluteOrientation("hand", geometry="tangent")
pytestmark = pytest.mark.filterwarnings("ignore::tpgmm_torch.exceptions.PlausibilityWarning")
RELATIVE = RelativeOrientation("hand", OBJECT, geometry="tangent")


def recordings(seed=0, count=8, spread=0.7, signs=True):
    """A hand that turns by two radians, differently each time, seen with random signs."""
    rng = np.random.default_rng(seed)
    share = ((1 - torch.cos(math.pi * TIME / 3)) / 2)[:, None]
    turn = quaternions.exp(2 * share * torch.tensor([0.6, 0.0, 0.8]).double())
    shown = []
    for _ in range(count):
        apart, other = torch.from_numpy(spread * rng.standard_normal((2, 3)))
        vector = apart + 0.2 * torch.sin(math.pi * TIME / 3)[:, None] * other
        long = vector.norm(dim=1, keepdim=True)
        q = quaternions.product(turn, quaternions.exp(vector * (2.4 / long).clamp(max=1)))
        if signs:
            q = q * torch.from_numpy(rng.choice([-1.0, 1.0], (len(TIME), 1)))
        pose = torch.cat((0.1 * share * torch.ones(3), q), 1)
        seen = quaternions.exp(torch.from_numpy(rng.standard_normal(3)))
        frame = Frame(torch.from_numpy(rng.standard_normal(3)), seen)
        shown.append(Demonstration(TIME, pose, {OBJECT: frame}))
    return shown


def complete(operators, demonstrations):
    motions = [Motion.of(one, HAND, ()) for one in demonstrations]
    return with_mean_orientations(operators, motions, HAND)


def fit_model(demonstrations, *operators, **settings):
    return TaskParameterizedGMM(5, operators, HAND, **settings).fit(demonstrations)


@cache
def model(*operators):
    return fit_model(recordings(), *operators)


def angles(a, b):
    """Between orientations [rad]."""
    turn = quaternions.product(quaternions.conjugate(a), b)
    return torch.linalg.vector_norm(quaternions.log(turn), dim=-1)


def reproduce(skill, start, frames):
    [found] = skill.predict([Situation(start, frames)])
    return quaternions.normalize(found.joints[:, 3:])


def orientations(demonstrations):
    return torch.stack([one.joints[:, 3:] for one in demonstrations], 1)


def mean_of(demonstrations):
    return quaternions.mean(orientations(demonstrations))


def test_the_path_is_the_karcher_mean_at_each_instant():
    shown = recordings()
    [found] = complete([ABSOLUTE], shown)
    local = torch.stack([local_coordinates(found, one, HAND) for one in shown])
    assert float(local.mean(0).abs().max()) < 1e-12
    together = complete([Stack(RelativePosition("hand", OBJECT), RELATIVE), Canonical()], shown)
    assert together[0].operators[1].path is not None
    assert complete(together, shown[:2]) == together


def test_a_demonstration_that_is_over_counts_with_its_last_orientation():
    one, other = recordings(count=2)
    short = Demonstration(TIME[:30], other.joints[:30], other.frames)
    [found] = complete([ABSOLUTE], [one, short])
    last = torch.stack((one.joints[-1, 3:], other.joints[29, 3:]))
    row = torch.tensor(found.path[-1][1:], dtype=torch.float64)
    assert float(angles(row, quaternions.mean(last))) < 1e-9


def test_turning_the_world_turns_what_is_reproduced():
    shown = recordings()
    turned = [
        Demonstration(
            TIME,
            torch.cat((pose.position, pose.orientation), 1),
            {OBJECT: moved(one.frames[OBJECT])},
        )
        for one in shown
        for pose in [moved(Frame(one.joints[:, :3], one.joints[:, 3:]))]
    ]
    here, there = model(ABSOLUTE, RELATIVE), fit_model(turned, ABSOLUTE, RELATIVE)
    for one, other in zip(
        (*here.means_, *here.covariances_), (*there.means_, *there.covariances_), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-8, atol=1e-10)
    frame = recordings(seed=9, count=1)[0].frames[OBJECT]
    start = torch.cat((torch.zeros(3).double(), mean_of(shown)[0]))
    pose = moved(Frame(start[:3], start[3:]))
    found = reproduce(here, start, {OBJECT: frame})
    other = reproduce(
        there, torch.cat((pose.position, pose.orientation)), {OBJECT: moved(frame)}
    )
    expected = moved(Frame(torch.zeros(60, 3).double(), found)).orientation
    assert float(angles(other, expected).max()) < 1e-6


@pytest.mark.parametrize("seed", range(4))
def test_orientations_far_apart_are_reproduced_better_than_in_four_coordinates(seed):
    """The mean of demonstrations that lie more than 90 degrees apart, at half the error."""
    shown = recordings(seed)
    q = orientations(shown)
    assert float(angles(q[:, :, None], q[:, None]).max()) > math.pi / 2
    wanted = mean_of(shown)
    start = torch.cat((torch.zeros(3).double(), wanted[0]))
    plain, tangent = (
        angles(reproduce(fit_model(shown, operator), start, {}), wanted).mean()
        for operator in (AbsoluteOrientation("hand"), ABSOLUTE)
    )
    assert float(tangent) <= 0.5 * float(plain)


def test_gradients_are_finite_where_nothing_is_left_to_turn_and_elsewhere():
    skill = model(RELATIVE)
    for turn in ([0.0, 0.0, 0.0], [1.0, -2.0, 0.5]):
        frame = quaternions.exp(torch.tensor([0.1, 0.3, 0.2]).double()).requires_grad_()
        base = skill.operators_[0]._path[1][0]
        q = quaternions.product(
            quaternions.product(frame.detach(), base),
            quaternions.exp(torch.tensor(turn).double()),
        )
        start = torch.cat((torch.zeros(3).double(), q)).requires_grad_()
        found = skill.step(
            0.0, start, {OBJECT: Frame.from_checked(torch.zeros(3).double(), frame)}
        )
        gradients = torch.autograd.grad(
            found.joints.square().sum() + found.covariance.sum(), (start, frame)
        )
        assert all(bool(g.isfinite().all()) for g in gradients)
        assert all(float(g.abs().max()) > 0 for g in gradients)


def test_batches_lie_about_the_mean_of_the_first():
    shown = recordings()
    streamed = fit_model([shown[:5], shown[5:]], ABSOLUTE)
    assert streamed.operators_ == complete([ABSOLUTE], shown[:5])
    wanted = mean_of(shown)
    start = torch.cat((torch.zeros(3).double(), wanted[0]))
    assert float(angles(reproduce(streamed, start, {}), wanted).mean()) < 0.1


def test_orientations_that_never_vary_are_as_certain_as_in_four_coordinates():
    """Rounding is no spread: what all demonstrations share is regularised like the rest."""
    still = torch.tensor([0.1, -0.7, 0.5, 0.5]).double()
    still = (still / still.norm()).expand(60, 4)
    shown = [
        Demonstration(TIME, torch.cat((k * TIME[:, None].expand(60, 3), still), 1), {})
        for k in (0.9, 1.0, 1.1)
    ]
    for operator in (AbsoluteOrientation("hand"), ABSOLUTE):
        skill = fit_model(shown, operator)
        assert float(torch.linalg.eigvalsh(skill.covariances_[0]).min()) > 1e-9


def test_the_time_of_a_product_is_refused():
    with pytest.raises(DataError, match="activation='time'"):
        fit_model(recordings(), ABSOLUTE, fusion=CovarianceFusion(activation="product"))


@cache
def handling():
    """Where the whole of a skill is in tangent space: two arms, and a bottle that is new."""
    turn = partial(RelativeOrientation, frame="bottle", geometry="tangent")
    hands = [Stack(RelativePosition(n, "bottle"), turn(n)) for n in ("l_hand", "r_hand")]
    skill = TaskParameterizedGMM(8, [Stack(*hands), Canonical()], upper_body())
    return skill.fit(few_bottles())


def test_the_likelihood_of_a_time_is_that_of_the_coordinates_then():
    regression = model(RELATIVE, ABSOLUTE).skill
    time, first = torch.linspace(0, 3, 76, dtype=torch.float64), regression.conditionals[0]
    marginals = TimeMarginals.of(regression.log_weights, first.time_mean, first.time_variance)
    parts = regression.kinematics, regression.operators, regression.conditionals, marginals
    likelihood = TimeLikelihood(*parts, time, slack=0.0, negligible=0.0)
    shown = recordings(seed=4, count=1)[0]
    for state in (HAND.state(shown.joints[[7, 31]]), HAND.state(shown.joints[[11]])):
        got = likelihood(state, dict(shown.frames))
        for row, joints in zip(got, state.joints, strict=True):
            alone = HAND.state(joints)
            every = [operator.at(time) for operator in regression.operators]
            local = [operator.coordinates(alone, shown.frames) for operator in every]
            joint = regression.log_density(time, local)
            weights = marginals.log_activation(time[:, None]).logsumexp(-1)
            expected = (joint - weights).numpy()
            np.testing.assert_allclose(row - row.max(), expected - expected.max(), atol=1e-6)


def test_what_compiles_no_logarithms_says_so():
    with pytest.raises(DataError, match="geometry='quaternion'"):
        compile_skill(handling().skill, backend="eager")


def test_what_is_wanted_is_the_minimum_of_the_exact_cost():
    """Finite differences, far from what is wanted: the linearisation's Jacobian is exact."""
    skill = handling()
    regression, time = skill.skill, torch.tensor(4.4, dtype=torch.float64)
    frame = few_bottles()[0].frames["bottle"]
    generator = torch.Generator().manual_seed(0)
    joints = few_bottles()[0].joints[:1].to(torch.float64)
    joints = joints + 0.3 * torch.randn(1, 17, generator=generator, dtype=torch.float64)
    activation = regression.estimate(time, joints, {"bottle": frame}).activation.expand(1, -1)
    cost = PostureCost(
        regression.posture_search(), activation, time, joints,
        {"bottle": frame.expand((1,))}, regression.kinematics.state,
    )  # fmt: skip
    steps = 1e-6 * torch.eye(17, dtype=torch.float64).reshape(17, 1, 1, 17)
    heights, downhill, _ = cost(torch.cat((joints[None, None], joints + steps, joints - steps)))
    slope = (heights[1:18] - heights[18:]).squeeze() / 2e-6
    assert float((slope + downhill[0].squeeze()).abs().max() / downhill[0].abs().max()) < 1e-6


PALM = Wrench("hand", "board")


def motions(demonstrations):
    return [Motion.of(one, slides()) for one in demonstrations]


def test_friction_works_and_a_press_does_not():
    shares, sizes = shares_of_work(PALM, motions(wipes()))
    np.testing.assert_allclose(sizes, [FRICTION * PRESS, 0, PRESS], atol=1e-9)
    assert shares[0] > 0.95
    assert shares[2] < 0.05
    assert with_force_axes([PALM], motions(wipes())) == (Wrench("hand", "board", [2]),)


def test_given_axes_are_kept():
    given = Wrench("hand", "board", [0])
    assert with_force_axes([given], motions(wipes())) == (given,)


def test_pushing_a_damper_is_work():
    shown = wipes()[0]
    time = np.asarray(shown.time)
    way = 0.05 * np.sin(np.pi * time / time[-1])
    joints = torch.from_numpy(np.stack((0 * way, 0 * way, 0.3 - way), -1))
    wrench = torch.zeros(len(time), 6).double()
    wrench[:, 2] = torch.from_numpy(-200 * np.gradient(way, time))
    pushed = replace(shown, joints=joints, wrenches={"hand": wrench})
    with pytest.raises(DataError, match=r"no force of 'hand' .* z 1\.00 at"):
        with_force_axes([PALM], motions([pushed]))
