"""The prior over the joints corrected by the tasks, against the sum of precisions."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.mixtures import CASES, Problem, local_mixture, random_local, times
from tpgmm_torch import Canonical, Frame, Stack
from tpgmm_torch.regression.active_components import Windows
from tpgmm_torch.regression.regression import PART
from tpgmm_torch.regression.task_update import TaskUpdate


class Joints(Canonical):
    """The same operator by another name, for which the precisions are summed."""


def assert_same(first, second, atol=1e-9):
    for name in ("joints", "covariance", "activation"):
        torch.testing.assert_close(
            getattr(first, name), getattr(second, name), rtol=1e-9, atol=atol
        )


@pytest.mark.parametrize("batch", [(), (4,), (2, 3)])
@pytest.mark.parametrize("name", ["the paper's", "canonical", "positions", "three"])
def test_the_update_is_the_sum_of_precisions(name, batch):
    problem = Problem.of(CASES[name], 4, *batch)
    regression = problem.regression()
    summed = [Joints() if type(o) is Canonical else o for o in regression.operators]
    other = replace(regression, operators=summed)
    for now in (torch.tensor(0.8, dtype=torch.float64), times(*batch)):
        at = now, problem.state, problem.frames
        assert_same(regression.step(*at), other.step(*at))
    assert regression._update is not None
    assert other._update is None


def test_two_operators_of_the_joints_are_one_prior():
    problem = Problem.of(CASES["the paper's"], 3)
    plain = problem.regression()
    more = random_local(np.random.default_rng(5), 3, problem.state.joints.numpy())
    mixtures = [*plain.mixtures, local_mixture(more)]
    twice = replace(plain, operators=[*plain.operators, Canonical()], mixtures=mixtures)
    summed = [Joints() if type(o) is Canonical else o for o in twice.operators]
    at = times(), problem.state, problem.frames
    assert_same(twice.step(*at), replace(twice, operators=summed).step(*at))


def test_a_mixture_of_another_kind_is_left_to_the_sum():
    case = CASES["the paper's"]
    kinematics = case.world.kinematics
    assert TaskUpdate.serves(case.operators, kinematics)
    assert not TaskUpdate.serves(case.operators[:1], kinematics)
    assert not TaskUpdate.serves([Stack(Canonical()), Canonical()], kinematics)
    poses = CASES["poses in two frames"]
    assert not TaskUpdate.serves([*poses.operators, Canonical()], poses.world.kinematics)


@pytest.mark.parametrize("alike", [True, False], ids=["one time", "own times"])
def test_thousands_of_robots_are_parts_of_a_few(alike):
    count = 2 * PART + 5
    problem = Problem.of(CASES["the paper's"], 5, count)
    regression = problem.regression()
    now = times() if alike else times(count)
    whole = regression.tick(now, problem.state.joints, problem.frames)
    for index in (0, PART - 1, PART, count - 1):
        frames = {name: frame[index] for name, frame in problem.frames.items()}
        one = regression.step(now if alike else now[index], problem.state[index], frames)
        torch.testing.assert_close(whole.joints[index], one.joints, rtol=0, atol=1e-8)
        torch.testing.assert_close(whole.covariance[index], one.covariance, rtol=0, atol=1e-8)


def test_frames_that_no_operator_asks_for_make_no_batch():
    problem = Problem.of(CASES["the paper's"], 5)
    regression, at = problem.regression(), (times(), problem.state.joints)
    other = Frame(torch.zeros(PART + 1, 3, dtype=torch.float64))
    alone = regression.tick(*at, problem.frames)
    assert_same(regression.tick(*at, {**problem.frames, "other": other}), alone)


def test_float32_is_float64_to_its_own_precision():
    problem = Problem.of(CASES["the paper's"], 4, 3)
    double = problem.regression()
    robot = problem.case.world.kinematics.to(torch.float32)
    mixtures = [
        type(m)(*(getattr(m, f).float() for f in m.__annotations__)) for m in double.mixtures
    ]
    single = replace(
        double, kinematics=robot, mixtures=mixtures, log_weights=double.log_weights.float()
    )
    frames = {
        name: Frame(f.position.float(), f.orientation.float())
        for name, f in problem.frames.items()
    }
    state = robot.state(problem.state.joints.float())
    expected = double.step(times(3), problem.state, problem.frames)
    actual = single.step(times(3).float(), state, frames)
    assert actual.joints.dtype == torch.float32
    torch.testing.assert_close(actual.joints.double(), expected.joints, rtol=0, atol=2e-4)
    torch.testing.assert_close(
        actual.covariance.double(), expected.covariance, rtol=1e-3, atol=1e-5
    )
    torch.linalg.cholesky(actual.covariance)


# Which components count


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("negligible", [1e-9, 1e-3])
def test_what_windows_leave_out_is_negligible_everywhere(seed, negligible):
    rng = np.random.default_rng(seed)
    means = torch.from_numpy(rng.uniform(0, 10, 12))
    variances = torch.from_numpy(10 ** rng.uniform(-4, 0, 12))
    log_weights = torch.from_numpy(rng.dirichlet(np.ones(12))).log()
    windows = Windows(log_weights, means, variances, negligible)
    instants = torch.from_numpy(rng.uniform(-8, 18, 2000))
    apart = (instants[:, None] - means).square() / variances
    log_h = log_weights - 0.5 * (apart + variances.log())
    shares = torch.exp(log_h - log_h.amax(1, keepdim=True))
    fewer = 0
    for instant, share in zip(instants.tolist(), shares, strict=True):
        left_out = sorted(set(range(12)) - set(windows.at(instant)))
        assert bool((share[left_out] < negligible).all())
        fewer += len(left_out)
    assert fewer > 1000
    assert windows.largest < 12 or negligible < 1e-3


def test_a_span_of_time_counts_what_its_windows_count():
    means = torch.linspace(0, 10, 11, dtype=torch.float64)
    windows = Windows(torch.zeros(11), means, torch.full((11,), 0.04), 1e-9)
    between = set(windows.between(3.0, 5.0))
    assert {3, 4, 5} <= between < set(range(11))
    for instant in np.linspace(3, 5, 50):
        assert set(windows.at(float(instant))) <= between
    assert windows.between(-100, 5) == windows.at(1e9) == tuple(range(11))


def test_keeping_all_keeps_all():
    means = torch.tensor([0.0, 100.0])
    assert Windows(torch.zeros(2), means, torch.ones(2), 0).at(0.0) == (0, 1)
