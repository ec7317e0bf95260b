"""The synthesis loop: a batch is its members, starts do not jump, limits are kept."""

import copy
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from tests.support.mixtures import CASES, Case, Problem, assert_close, form
from tests.support.worlds import OBJECT
from tpgmm_control.loop.rollout import rollout
from tpgmm_torch import Frame, Situation, Trajectory, quaternions
from tpgmm_torch.motion.minimum_jerk import minimum_jerk
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.regression import Regression

NAMES = ["the paper's", "poses in two frames"]
EVERY_WORLD = pytest.mark.parametrize("case", [CASES[name] for name in NAMES], ids=NAMES)


def grid(length: int = 12, end: float = 2.0) -> Tensor:
    return torch.linspace(0, end, length, dtype=torch.float64)


def moving(pose: Frame, time: Tensor) -> Frame:
    """The object drifts and turns."""
    drift = 0.1 * time[:, None] * torch.tensor([1.0, -0.5, 0.2], dtype=torch.float64)
    turn = quaternions.exp(0.3 * drift)
    return Frame(pose.position + drift, quaternions.product(turn, pose.orientation))


def situations(problem: Problem, *grids: Tensor, moves: bool = False) -> list[Situation]:
    """One situation per time grid; of two, every second object moves if asked for."""
    result = []
    for index, time in enumerate(grids):
        pose = problem.frames[OBJECT][index]
        frame = moving(pose, time) if moves and index % 2 else pose
        result.append(Situation(problem.state.joints[index], {OBJECT: frame}, time))
    return result


def run(regression: Regression, given: list[Situation], **options) -> list[Trajectory]:
    options = {"blend": 0.5, "keep_limits": False, "candidates": True} | options
    peaks = options.pop("peaks", None)
    keeps = options.pop("keep_limits")
    bounds = MotionBounds.of(regression.kinematics, peaks) if keeps else None
    skill = replace(regression, begin=0.0, end=2.0, time=grid())
    return rollout(skill, given, bounds=bounds, **options)


def assert_same(a: Trajectory, b: Trajectory) -> None:
    assert torch.equal(a.time, b.time)
    assert_close(a.joints, b.joints)
    assert_close(a.covariance, b.covariance)
    for one, other in zip(a.candidates, b.candidates, strict=True):
        assert_close(one.mean, other.mean)
        assert_close(one.covariance, other.covariance)
        assert_close(one.share, other.share)


# The loop


@EVERY_WORLD
def test_each_reference_is_the_state_of_the_next_step(case: Case):
    problem = Problem.of(case, 3, 1)
    regression, kinematics = problem.regression(), case.world.kinematics
    [trajectory] = run(regression, situations(problem, grid()), blend=0)
    joints, frames = problem.state.joints[0], {OBJECT: problem.frames[OBJECT][0]}
    for time, reference, covariance in zip(
        grid(), trajectory.joints, trajectory.covariance, strict=True
    ):
        estimate = regression.estimate(time, kinematics.state(joints), frames)
        joints = kinematics.retract(estimate.joints)
        assert_close(reference, joints)
        assert_close(covariance, estimate.covariance)


@EVERY_WORLD
@pytest.mark.parametrize("moves", [False, True], ids=["standing", "moving"])
@pytest.mark.parametrize("keep_limits", [False, True], ids=["free", "limited"])
def test_a_batch_is_its_situations_one_at_a_time(case: Case, moves, keep_limits):
    problem = Problem.of(case, 3, 3)
    given = situations(problem, grid(), grid(), grid(), moves=moves)
    regression = problem.regression()
    batch = run(regression, given, keep_limits=keep_limits)
    for one, situation in zip(batch, given, strict=True):
        [single] = run(regression, [situation], keep_limits=keep_limits)
        assert_same(one, single)


def test_time_grids_may_differ_and_the_order_is_kept():
    problem = Problem.of(CASES["the paper's"], 3, 4)
    grids = grid(), grid(7, 1.5), grid(), grid(12, 1.9)
    given = situations(problem, *grids)
    regression = problem.regression()
    for one, situation in zip(run(regression, given), given, strict=True):
        assert torch.equal(one.time, situation.time)
        assert len(one) == len(situation.time)
        assert_same(one, run(regression, [situation])[0])


def test_an_object_that_moves_is_followed_as_it_moves():
    problem = Problem.of(CASES["the paper's"], 3, 1)
    pose, time = problem.frames[OBJECT][0], grid()
    start = problem.state.joints[0]
    path = moving(pose, time)
    still = Frame(pose.position.expand(12, 3), pose.orientation.expand(12, 4))
    constant, repeated, moved = run(
        problem.regression(),
        [Situation(start, {OBJECT: frame}, time) for frame in (pose, still, path)],
    )
    assert_same(constant, repeated)
    assert_close(moved.joints[0], constant.joints[0])
    assert (moved.joints[-1] - constant.joints[-1]).abs().max() > 1e-3


@pytest.mark.parametrize("keep_limits", [False, True], ids=["free", "limited"])
def test_before_the_beginning_and_after_the_end_references_are_held(keep_limits):
    problem = Problem.of(CASES["the paper's"], 3, 2)
    regression, step = problem.regression(), float(grid()[1])
    longer = step * torch.arange(-3, 20, dtype=torch.float64)
    for blend in (0.0, 0.5):
        options = {"blend": blend, "keep_limits": keep_limits}
        inside = run(regression, situations(problem, grid(), grid()), **options)
        for one, found in zip(
            inside, run(regression, situations(problem, longer, longer), **options), strict=True
        ):
            assert torch.equal(found.time, longer)
            assert_close(found.joints[3:15], one.joints, 1e-10)
            assert_close(found.joints[:3], one.joints[:1].expand(3, -1), 1e-10)
            assert_close(found.joints[15:], one.joints[-1:].expand(8, -1), 1e-10)
            assert_close(found.covariance[15:], one.covariance[-1:].expand(8, -1, -1), 1e-10)


@EVERY_WORLD
@pytest.mark.parametrize("moves", [False, True], ids=["still", "moving"])
@pytest.mark.parametrize("fusion", [form(), form("covariance", "product")])
@pytest.mark.parametrize("part", [7, 512])
def test_candidates_are_those_of_each_tick(case: Case, moves, fusion, part, monkeypatch):
    monkeypatch.setattr("tpgmm_torch.skills.reproduction.PART", part)
    problem = Problem.of(case, 3, 2)
    regression, time = problem.regression(fusion=fusion), grid()
    given = situations(problem, time, time, moves=moves)
    trajectories = run(regression, given)
    together = {OBJECT: Frame.stack([item.frames[OBJECT] for item in given])}
    joints = problem.state.joints
    for k, now in enumerate(time):
        here = {name: pose[k] if moves else pose for name, pose in together.items()}
        state = case.world.kinematics.state(joints)
        estimate = regression.estimate(now, state, here)
        candidates = regression.candidates(now, state, here, estimate)
        joints = torch.stack([trajectory.joints[k] for trajectory in trajectories])
        for row, trajectory in enumerate(trajectories):
            for one, other in zip(trajectory.candidates, candidates, strict=True):
                assert_close(one.mean[k], other.mean[row])
                assert_close(one.covariance[k], other.covariance[row])
                assert_close(one.share[k], other.share[row])


# The start


def test_a_blend_adds_the_gap_while_it_fades_and_nothing_afterwards():
    problem = Problem.of(CASES["canonical"], 3, 1)  # its references do not depend on the state
    given = situations(problem, grid(41))
    [plain] = run(problem.regression(), given, blend=0)
    [blended] = run(problem.regression(), given, blend=0.8)
    fade = 1 - minimum_jerk(grid(41) / 0.8)
    gap = given[0].joints - plain.joints[0]
    assert_close(blended.joints, plain.joints + fade[:, None] * gap)
    assert_close(blended.joints[grid(41) >= 0.8], plain.joints[grid(41) >= 0.8])


# Limits


def test_a_gap_to_where_the_skill_begins_is_no_speed():
    problem = Problem.of(CASES["canonical"], 3, 1)
    time = grid(161)
    [free] = run(problem.regression(), situations(problem, time), blend=0)
    kinematics = copy.copy(problem.case.world.kinematics)
    kinematics.velocity = torch.full_like(kinematics.velocity, torch.inf)
    kinematics.lower = torch.full_like(kinematics.lower, -torch.inf)
    kinematics.upper = torch.full_like(kinematics.upper, torch.inf)
    peaks = torch.full_like(kinematics.lower, 5.0), torch.full_like(kinematics.lower, 100.0)
    regression = replace(problem.regression(), kinematics=kinematics)
    begin = free.joints[0] + 0.5
    given = [replace(situations(problem, time)[0], joints=begin)]
    [bounded] = run(regression, given, blend=0, keep_limits=True, peaks=peaks)
    assert_close(bounded.joints[0], begin)
    # taken for a speed, 0.5 within a tick of 12.5 ms led 50 beyond
    assert (bounded.joints - free.joints).abs().max() <= 0.5 + 1e-9
    assert_close(bounded.joints[-1], free.joints[-1])


def test_references_keep_the_limits_of_position_and_speed():
    problem = Problem.of(CASES["the paper's"], 4, 2)
    slow = copy.copy(problem.case.world.kinematics)
    slow.velocity = torch.full_like(slow.velocity, 0.3)
    slow.lower = low = problem.state.joints.amin(0) - 0.1
    slow.upper = high = problem.state.joints.amax(0) + 0.1
    regression = replace(problem.regression(), kinematics=slow)
    time = grid(21)
    given = situations(problem, time, time)
    for free, kept in zip(
        run(regression, given), run(regression, given, keep_limits=True), strict=True
    ):
        assert bool(((free.joints < low) | (free.joints > high)).any())
        assert bool((kept.joints >= low - 1e-9).all() and (kept.joints <= high + 1e-9).all())
        speed = kept.joints.diff(dim=0) / time.diff()[:, None]
        assert float(speed.abs().max()) <= 0.3 * (1 + 1e-9)


def test_a_robot_that_starts_beyond_its_limits_returns_to_them():
    problem = Problem.of(CASES["the paper's"], 2, 1)
    kinematics = problem.case.world.kinematics
    start = problem.state.joints[0].clone()
    start[5] = kinematics.upper[5] + 0.5
    given = [Situation(start, {OBJECT: problem.frames[OBJECT][0]}, grid(30))]
    [trajectory] = run(problem.regression(), given, keep_limits=True)
    assert bool(torch.isfinite(trajectory.joints).all())
    assert float(trajectory.joints[-1, 5]) <= float(kinematics.upper[5]) + 1e-9


# Gradients


@EVERY_WORLD
def test_what_needs_no_gradient_serves_where_others_do(case: Case):
    problem = Problem.of(case, 3, 1)
    [trajectory] = run(problem.regression(), situations(problem, grid()))
    own = trajectory.candidates[0]
    for result in (trajectory.joints, trajectory.covariance, own.mean, own.covariance):
        assert not result.is_inference() and not result.requires_grad
    weight = torch.ones((), dtype=torch.float64, requires_grad=True)
    (weight * trajectory.joints.square()).sum().backward()
    assert_close(weight.grad, trajectory.joints.square().sum())


@pytest.mark.parametrize("moves", [False, True])
def test_references_are_differentiable_in_the_pose_of_an_object(moves: bool):
    problem = Problem.of(CASES["the paper's"], 3, 2)
    regression, time = problem.regression(), grid(6, 1.0)
    given = situations(problem, time, time, moves=moves)[1:]
    pose, joints = given[0].frames[OBJECT], given[0].joints

    def last(shift: Tensor) -> Tensor:
        moved = Frame(pose.position + shift, pose.orientation)
        situation = Situation(joints, {OBJECT: moved}, time)
        [trajectory] = run(regression, [situation], candidates=False)
        return trajectory.joints[-1]

    shift = torch.zeros(3, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(last, shift, eps=1e-6, atol=1e-6)
