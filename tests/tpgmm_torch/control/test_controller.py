"""A running skill, tick by tick: its beginning, its end, what it is told on the way."""

import pytest
import torch

from tests.support.mixtures import CASES, Case, Problem, assert_close
from tests.support.worlds import OBJECT
from tpgmm_torch import Frame, Situation
from tpgmm_torch.control.controller import Controller
from tpgmm_torch.control.rollout import rollout
from tpgmm_torch.exceptions import ShapeError
from tpgmm_torch.motion.motion_bounds import MotionBounds

NAMES = ["the paper's", "poses in two frames"]
EVERY_WORLD = pytest.mark.parametrize("case", [CASES[name] for name in NAMES], ids=NAMES)
DT, LAST = 0.1, 1.2


def begun(problem: Problem, **options) -> Controller:
    """A skill of 1.2 s that begins at 0.2 s."""
    defaults = {"begin": 0.2, "end": 0.2 + LAST}
    joints, frames = problem.state.joints, problem.frames
    return Controller(problem.regression(), joints, frames, **{**defaults, **options})


@EVERY_WORLD
def test_what_was_measured_may_stand_for_the_last_reference(case: Case):
    problem = Problem.of(case, 3, 2)
    regression, kinematics = problem.regression(), case.world.kinematics
    controller = begun(problem, feedback="measured")
    for k in range(5):
        measured = kinematics.retract(controller.reference + 0.01)
        controller.step(DT, measured)
        time = torch.tensor(0.2 + k * DT, dtype=torch.float64)
        expected = regression.step(time, kinematics.state(measured), problem.frames)
        assert_close(controller.reference, kinematics.retract(expected.joints))
        assert float(controller.time) == pytest.approx(float(time))


@pytest.mark.parametrize("bounded", [False, True])
@pytest.mark.parametrize("blend", [0.0, 0.5])
def test_a_whole_skill_is_a_rollout(blend, bounded):
    problem = Problem.of(CASES["the paper's"], 3, 2)
    bounds = MotionBounds.of(problem.regression().kinematics) if bounded else None
    controller = begun(problem, blend=blend, bounds=bounds, at_rest=False)
    time = 0.2 + DT * torch.arange(13, dtype=torch.float64)
    situations = [
        Situation(problem.state.joints[row], {OBJECT: problem.frames[OBJECT][row]}, time)
        for row in range(2)
    ]
    both = rollout(problem.regression(), situations, time, blend, bounds, False)
    for k in range(13):
        assert not controller.finished
        command = controller.step(DT)
        assert controller.command is command
        for row, trajectory in enumerate(both):
            assert_close(controller.reference[row], trajectory.joints[k])
            assert_close(command.covariance[row], trajectory.covariance[k])
    assert controller.finished


def test_after_the_end_the_last_reference_is_held():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    controller = begun(problem, end=0.35)
    controller.step(DT)
    controller.step(DT)
    assert not controller.finished  # 0.3 s of 0.35 s
    controller.step(DT)
    assert controller.finished
    reference, estimate = controller.reference, controller.command.estimate
    command = controller.step(DT, problem.state.joints)
    assert command.estimate is estimate
    assert command.status == ["finished"] * 2
    assert float(controller.time) == 0.35
    assert torch.equal(controller.reference, reference)
    assert not command.velocity.any()


def test_rounding_does_not_cost_the_last_step():
    problem = Problem.of(CASES["canonical"], 3)
    controller = begun(problem, begin=0.0, end=0.3)  # 0.1 + 0.1 + 0.1 is more than 0.3
    estimates = [controller.step(0.1).estimate for _ in range(5)]
    assert len({id(estimate) for estimate in estimates}) == 4
    assert float(controller.time) == 0.3


def test_objects_are_where_they_were_last_seen():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    elsewhere = {
        OBJECT: Frame(
            problem.frames[OBJECT].position + 0.05, problem.frames[OBJECT].orientation
        )
    }
    told, follows = begun(problem), begun(problem)
    told.step(DT)
    follows.step(DT)
    told.step(DT, frames=elsewhere)
    assert (told.reference - follows.step(DT).reference).abs().max() > 1e-3
    told.step(DT)
    begun_there = begun(problem)
    begun_there.step(DT)
    begun_there.step(DT, frames=elsewhere)
    begun_there.step(DT, frames=elsewhere)
    assert torch.equal(told.reference, begun_there.reference)


def test_looking_ahead_changes_nothing():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    controller = begun(problem, blend=0.5)
    controller.step(DT)
    ahead = controller.copy()
    expected = [ahead.step(DT).reference for _ in range(3)]
    assert float(controller.time) == pytest.approx(0.2)
    for joints in expected:
        assert torch.equal(controller.step(DT).reference, joints)


def test_other_robots_are_refused():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    controller = begun(problem)
    with pytest.raises(ShapeError, match=r"began with joints of shape \(2, 17\).*\(1, 17\)"):
        controller.step(DT, problem.state.joints[:1])


def test_numbers_given_in_another_type_are_converted():
    problem = Problem.of(CASES["the paper's"], 3)
    pose = problem.frames[OBJECT]
    single = {OBJECT: Frame(pose.position.float(), pose.orientation.float())}
    options = {"begin": 0.0, "end": 1.0}
    regression = problem.regression()
    plain = Controller(regression, problem.state.joints, problem.frames, **options)
    other = Controller(regression, problem.state.joints.tolist(), single, **options)
    assert_close(other.step(DT).reference, plain.step(DT).reference, 1e-5)
