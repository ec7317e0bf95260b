"""A running skill, tick by tick: its beginning, its end, its inputs."""

import re
from dataclasses import fields
from datetime import timedelta

import numpy as np
import pytest
import torch

from tests.support.damage import FULL
from tests.support.mixtures import CASES, Case, Problem, assert_close
from tests.support.robot_zoo import HANDS
from tests.support.skills import bottle_demonstrations, few_bottles, generator, small_bottle
from tests.support.worlds import OBJECT
from tpgmm_control.loop.controller import Controller
from tpgmm_control.loop.rollout import rollout
from tpgmm_control.sensing.trust import Trust
from tpgmm_datasets.bottle.skill import bottle_operators
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import Frame, Robot, Situation, TaskParameterizedGMM
from tpgmm_torch.exceptions import DataError, PlausibilityWarning, ShapeError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.regression.regression import Regression

NAMES = ["the paper's", "poses in two frames"]
EVERY_WORLD = pytest.mark.parametrize("case", [CASES[name] for name in NAMES], ids=NAMES)
DT, LAST = 0.1, 1.2
PLAIN = {"clock": "even", "trust": None, "smoothing": None, "bounds": None, "blend": 0.0}


def begun(problem: Problem, **options) -> Controller:
    """A skill of 1.2 s that begins at 0.2 s."""
    defaults = {"begin": 0.2, "end": 0.2 + LAST, **PLAIN}
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
        expected = regression.estimate(time, kinematics.state(measured), problem.frames)
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
    skill = problem.regression(begin=0.2, end=0.2 + LAST)
    both = rollout(skill, situations, blend=blend, bounds=bounds)
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


def test_objects_are_where_they_were_last_seen():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    pose = problem.frames[OBJECT]
    elsewhere = {OBJECT: Frame(pose.position + 0.05, pose.orientation)}
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


# Trust


def watched(problem: Problem, robots: slice | int = slice(None), **options) -> Controller:
    """A controller with trust, of some of the robots."""
    regression = problem.regression()
    frames = {name: frame[robots] for name, frame in problem.frames.items()}
    defaults = {
        "begin": 0.2,
        "end": 0.2 + LAST,
        "clock": "even",
        "smoothing": None,
        "blend": 0.3,
        "bounds": MotionBounds.of(regression.kinematics, acceleration=20.0, jerk=2000.0),
        "trust": Trust(frame_timeout=0.2),
    }
    skill = options.pop("skill", regression)
    return Controller(skill, problem.state.joints[robots], frames, **{**defaults, **options})


@pytest.mark.parametrize("lost", ["joints", "frame"])
def test_a_robot_that_knows_nothing_stands_until_it_does(lost):
    problem = Problem.of(CASES["the paper's"], 3, 2)
    controller, speeds, statuses, reasons = watched(problem), [], [], []
    for k in range(100):
        joints, frames = controller.reference.clone(), dict(problem.frames)
        if 30 <= k < 70 and lost == "joints":
            joints[1] = torch.nan
        if lost == "frame":
            pose = torch.cat((frames[OBJECT].position, frames[OBJECT].orientation), -1)
            pose[1] = torch.nan if 30 <= k < 70 else pose[1]
            frames = {OBJECT: pose}
        command = controller.step(0.01, joints, frames)
        assert bool(command.reference.isfinite().all())
        speeds.append(command.velocity.abs().amax(-1))
        statuses.append(command.status)
        reasons.append(command.reason(1))
    assert [robot[0] for robot in statuses] == ["running"] * 100
    held = [k for k in range(100) if statuses[k][1] == "holding"]
    assert held == list(range(50, 70))  # after 0.2 s
    assert float(speeds[69][1]) < 1e-6 < float(speeds[69][0])
    assert "is missing or not finite" in reasons[69]
    # it has lost the time for which it stood
    lag = controller.time[0] - controller.time[1]
    assert float(lag) == pytest.approx(0.2, abs=1e-6)


@pytest.mark.parametrize(
    "dt", [0.0, -0.01, np.nan, np.inf, None, "soon", timedelta(seconds=1), [0.01, [0.02]]]
)
def test_time_that_does_not_increase_moves_nothing(dt):
    problem = Problem.of(CASES["the paper's"], 3, 2)
    controller = watched(problem)
    for _ in range(5):
        controller.step(0.01)
    before, time = controller.reference, controller.time
    command = controller.step(dt)
    assert command.status == ["holding"] * 2
    assert "time did not increase" in command.reason(1)
    assert torch.equal(command.reference, before)
    assert torch.equal(controller.time, time)
    assert controller.step(0.01).status == ["running"] * 2


def test_a_tick_of_more_than_a_second_is_told():
    controller = watched(Problem.of(CASES["the paper's"], 3, 2))
    controller.step(0.01)
    before = controller.time
    with pytest.warns(PlausibilityWarning, match="in seconds, not in milliseconds"):
        controller.step(33)
    assert bool((controller.time <= before + 0.5).all())


def test_robots_may_have_times_of_their_own():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    controller = watched(problem)
    steps = torch.tensor([0.01, 0.02], dtype=torch.float64)
    for _ in range(11):
        controller.step(steps)
    assert controller.time.tolist() == pytest.approx([0.3, 0.4])
    before = controller.reference
    command = controller.step(torch.tensor([0.01, -1.0]))
    assert controller.time.tolist() == pytest.approx([0.31, 0.4])
    moved = (command.reference - before).abs().amax(-1) > 0
    assert moved.tolist() == [True, False]
    assert command.status == ["running", "holding"]
    assert "time did not increase" in command.reason(1)
    assert controller.step(0.01).status == ["running"] * 2


def test_what_the_model_cannot_tell_stops_one_robot():
    problem = Problem.of(CASES["the paper's"], 3, 3)
    fails = []

    class Failing(Regression):
        def estimate(self, time, joints, frames, bounds=None):
            if fails and (joints.ndim == 2 or torch.equal(joints, controller.reference[1])):
                raise DataError("singular")
            return super().estimate(time, joints, frames, bounds)

    plain = problem.regression()
    skill = Failing(**{f.name: getattr(plain, f.name) for f in fields(plain)})
    controller = watched(problem, skill=skill)
    for _ in range(40):
        controller.step(0.01)
    fails.append(True)
    for _ in range(60):
        command = controller.step(0.01)
    assert command.status == ["running", "holding", "running"]
    assert "no finite answer" in command.reason(1)
    speed = command.velocity.abs().amax(-1)
    assert float(speed[1]) < 1e-9 < float(speed[0])


def test_a_robot_that_somebody_moves_is_approached_within_bounds():
    problem = Problem.of(CASES["the paper's"], 3, 2)
    bounds = MotionBounds.of(problem.regression().kinematics, acceleration=20.0, jerk=2000.0)
    controller = watched(problem, clock="waiting", end=3.0, bounds=bounds)
    for _ in range(60):
        controller.step(0.01, controller.reference)
    away = controller.reference.clone()
    away[0] += 0.3 * torch.tensor([1, -1] * 8 + [1])
    robot = problem.regression().kinematics
    away = away.clamp(robot.lower, robot.upper)
    jitter, statuses = np.random.default_rng(0), []
    for _ in range(150):
        before = controller.reference
        seen = torch.stack((away[0], controller.reference[1]))
        seen += torch.from_numpy(1e-5 * jitter.standard_normal(seen.shape))
        command = controller.step(0.01, seen)
        step = (command.reference - before).abs()
        assert bool((step <= bounds.velocity * 0.01 * (1 + 1e-9)).all())
        statuses.append(command.status)
    assert (command.reference[0] - away[0]).abs().max() < 0.06
    assert {first for first, _ in statuses} == {"running", "displaced"}
    assert {second for _, second in statuses} == {"running"}
    assert controller.time[0] < controller.time[1] - 1.0


def test_a_robot_without_limits_of_speed_moves_as_it_was_shown():
    urdf = re.sub(r'velocity="[^"]*"', "", upper_body_urdf())
    robot = Robot.from_urdf(urdf, HANDS)
    assert not robot.velocity.isfinite().any()
    model = TaskParameterizedGMM(8, bottle_operators(), robot, tol=1e-2)
    skill = model.fit(few_bottles()).skill
    shown = few_bottles()[0]
    bottle, away = shown.frames["bottle"], torch.tensor([0.6, 0.0, 0.0])
    controller = Controller(skill, shown.joints[0], shown.frames)
    speed, peak = torch.zeros(robot.n_joints), torch.zeros(robot.n_joints)
    while not controller.finished:
        share = (float(controller.time) - 1.0) / (skill.end - 1.0)
        pulled = Frame(bottle.position + min(max(share, 0), 1) * away, bottle.orientation)
        before = controller.reference
        command = controller.step(0.05, before, {"bottle": pulled})
        after = (command.reference - before) / 0.05
        speed, peak = after, torch.maximum(peak, (after - speed).abs() / 0.05)
    assert bool((peak <= 3 * skill.peaks[0] * 1.001).all())


def test_a_tracker_that_loses_what_a_hand_holds_stops_nobody():
    shown = bottle_demonstrations()[0]
    controller = Controller(small_bottle().skill, shown.joints[0], shown.frames)
    for tick in range(400):
        pose = shown.frames["bottle"] if tick < 100 else None
        holds = {"bottle": "l_hand"} if tick == 50 else None
        command = controller.step(0.01, controller.reference, {"bottle": pose}, holds=holds)
        assert command.status != "holding"


CLOCKS = ["even", "waiting", "localizing"]


@pytest.mark.parametrize("jitter", [0.0, 0.5])
@pytest.mark.parametrize("clock", CLOCKS)
def test_a_robot_in_a_batch_is_what_it_is_alone(clock, jitter):
    """With faults in some of them, at different times, and ticks of their own."""
    problem = Problem.of(CASES["the paper's"], 3, 8)
    batch = watched(problem, clock=clock)
    alone = {robot: watched(problem, robot, clock=clock) for robot in (0, 2, 3, 5)}
    rng = np.random.default_rng(0)
    for k in range(130):
        joints = batch.reference + torch.from_numpy(1e-3 * rng.standard_normal((8, 17)))
        if 20 <= k < 50:
            joints[2] = torch.nan
        if k == 40:
            away = batch.reference[5] - 0.2 * batch.reference[5].sign()
        if 40 <= k < 60:  # somebody holds it there
            joints[5] = away
        pose = problem.frames[OBJECT]
        poses = torch.cat((pose.position, pose.orientation), -1)
        poses[:, :3] += torch.from_numpy(1e-3 * rng.standard_normal((8, 3)))
        if 60 <= k < 100:
            poses[3] = torch.nan
        steps = 0.01 * (1 + jitter * torch.from_numpy(rng.uniform(-1, 3, 8)))
        command = batch.step(steps, joints, {OBJECT: poses})
        for robot, one in alone.items():
            single = one.step(float(steps[robot]), joints[robot], {OBJECT: poses[robot]})
            assert_close(command.reference[robot], single.reference, 1e-9)
            assert command.status[robot] == single.status
            assert command.reason(robot) == single.reason()


def test_a_robot_of_the_bottle_in_a_batch_is_what_it_is_alone():
    """With faults in some of them: to 1e-9, also where postures are searched."""
    model, rng = small_bottle(), np.random.default_rng(0)
    situations = generator().situations(12, seed=5)
    start = torch.stack([situation.joints for situation in situations])
    frame = Frame.stack([situation.frames["bottle"] for situation in situations])
    batch, chosen = Controller(model.skill, start, {"bottle": frame}), (2, 3, 4, 5)
    alone = {one: Controller(model.skill, start[one], {"bottle": frame[one]}) for one in chosen}
    for tick in range(120):
        joints = batch.reference + torch.from_numpy(1e-4 * rng.standard_normal(start.shape))
        poses = torch.cat((frame.position, frame.orientation), -1)
        if 20 <= tick < 60:
            joints[2], poses[4] = torch.nan, torch.nan
            joints[3] += 0.7
        if tick >= 20:
            poses[5, :3] += torch.tensor([0.1, 0.2, 0.3])
        # every robot has ticks of its own, in the second half
        steps = 0.02 * (1 + (tick >= 60) * torch.from_numpy(rng.uniform(-0.5, 1, len(start))))
        command = batch.step(steps, joints, {"bottle": poses})
        for robot, one in alone.items():
            single = one.step(float(steps[robot]), joints[robot], {"bottle": poses[robot]})
            assert_close(command.reference[robot], single.reference, 1e-9)
            assert command.status[robot] == single.status


@pytest.mark.parametrize("clock", CLOCKS)
def test_commands_are_within_bounds_whatever_is_told(clock):
    """Ticks with faults: every command is finite, and within limits of position and speed.

    A million of them with ``TPGMM_FUZZ=full`` (``make fuzz``).
    """
    robots, ticks = (256, 1400) if FULL else (4, 150)
    problem = Problem.of(CASES["the paper's"], 3, robots)
    robot = problem.regression().kinematics
    bounds = MotionBounds.of(robot, acceleration=20.0, jerk=2000.0)
    end, rng = 0.2 + max(LAST, ticks / 200), np.random.default_rng(0)
    controller = watched(problem, clock=clock, end=end, bounds=bounds)
    pose = problem.frames[OBJECT]
    still = torch.cat((pose.position, pose.orientation), -1)
    kept = measured = controller.reference
    for _ in range(ticks):
        measured = measured + 0.5 * (controller.reference - measured)
        joints, poses, ages = measured.clone(), still.clone(), {}
        for robot, fault in enumerate(rng.integers(40, size=robots)):
            if fault == 0:
                joints[robot] = float(rng.choice([np.nan, np.inf, 1e9]))
            elif fault == 1:
                poses[robot] = float(rng.choice([np.nan, np.inf, 0.0]))
            elif fault == 2:  # jumps, which stay if that is drawn
                poses[robot, :3] += torch.from_numpy(rng.uniform(-2, 2, 3))
                still[robot] = poses[robot] if rng.integers(4) == 0 else still[robot]
            elif fault == 3:  # degrees
                joints[robot] *= 57.3
            elif fault == 4:  # at a limit, or stretched out
                joints[robot] = bounds.lower if rng.integers(2) else 0.0
                measured[robot] = joints[robot]
            elif fault == 5:
                joints[robot] += torch.from_numpy(rng.uniform(-1, 1, 17))
            elif fault == 6:
                still[robot] = torch.cat((pose.position[robot], pose.orientation[robot]))
        if rng.integers(50) == 0:
            ages["joints"] = float(rng.choice([0.1, 1.0, np.nan]))
        dt = float(rng.choice([0.01] * 8 + [0.02, 0.0, -0.01, np.nan]))
        told = {} if rng.integers(50) == 0 else {OBJECT: poses}
        command = controller.step(dt, joints if rng.integers(50) else None, told, ages=ages)
        reference = command.reference
        assert bool(reference.isfinite().all() & command.velocity.isfinite().all())
        assert bool(
            ((reference >= bounds.lower - 1e-9) & (reference <= bounds.upper + 1e-9)).all()
        )
        if not dt > 0:
            assert torch.equal(reference, kept)
            continue
        assert bool((command.velocity.abs() <= bounds.velocity * (1 + 1e-6)).all())
        kept = reference


@pytest.mark.parametrize(("holder", "lead"), [(None, 0.06), ("l_hand", 0.03)])
def test_a_robot_that_was_stopped_in_motion_goes_on_gently(holder, lead):
    """For three seconds; what it missed was looked for elsewhere."""
    model, shown = small_bottle(), bottle_demonstrations()[0]
    controller, stands = Controller(model.skill, shown.joints[0], shown.frames), shown.joints[0]
    speeds: list[float] = []
    for tick in range(1, 700):
        holds = {"bottle": holder} if tick == 1 else None
        command = controller.step(0.01, joints=stands, holds=holds)
        speeds.append(float(command.velocity.abs().max()))
        if not 300 <= tick < 600:
            stands = command.reference
        elif tick == 500:  # it is led with care if it holds something
            ahead = float((command.reference - stands).abs().max())
        if tick == 680:  # what is left is small, and soon gone
            assert (command.reference - command.estimate.joints).abs().max() < 1e-2
    assert ahead < lead
    # as fast as it was before and would have been at most, where it was 0.8 rad/s
    assert max(speeds[600:]) < 1.3 * max(speeds[200:300])
