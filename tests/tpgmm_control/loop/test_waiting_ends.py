"""Robots that wait go on, whatever they waited for; what stands is called so."""

import copy
import pickle
import warnings

import numpy as np
import pytest

from tests.support.soft_drives import GRASP, begin, learned
from tpgmm_control import Controller
from tpgmm_torch import Demonstration, TaskParameterizedGMM
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.regression.posture import PostureSearch


@pytest.mark.parametrize("hertz", [25, 50, 200])
@pytest.mark.parametrize("joint", [0, 1])
def test_time_does_not_creep_on_in_silence_while_a_joint_is_held(hertz, joint):
    run, silent = begin(lag=0.025), 0

    def held(error, speed):
        return error * np.eye(4)[joint] * (float(run.controller.time) > 0.5)

    for _ in range(2 * hertz):
        before = float(run.controller.time)
        command = run.tick(1 / hertz, rubs=held)
        slow = float(run.controller.time) - before < 0.5 / hertz
        silent += slow and str(command.status) == "running"
    assert silent / hertz < 0.4
    assert str(command.status) == "waiting"


@pytest.mark.parametrize("noise", [0.0005, 0.004, 0.015])
@pytest.mark.parametrize("holds", [False, True])
def test_a_stop_ends_whatever_the_noise(holds, noise):
    run = begin(holds, noise=noise)
    while not run.controller.finished:
        now = sum(run.statuses.values()) * 0.02
        run.tick(stopped=3.2 <= now < 4.7)
        assert now < 9
    assert run.statuses["waiting"] * 0.02 == pytest.approx(1.5, abs=0.4)


def test_a_robot_that_nobody_frees_stops_for_good():
    run = begin(clock="localizing:wait_limit=2")
    for _ in range(100):
        run.tick()
    reasons, reference = [], None
    for k in range(300):
        command = run.tick(stopped=k < 200)
        reasons.append(command.reason())
        if str(command.status) == "stopped":
            reference = run.reference if reference is None else reference
            assert np.abs(run.reference - reference).max() < 0.02
    assert run.statuses["waiting"] * 0.02 == pytest.approx(2, abs=0.1)
    assert str(command.status) == "stopped"
    assert any("stops for good in 1.0 s" in reason for reason in reasons)
    assert "stopped for good after 2 s: joint" in command.reason()


@pytest.mark.parametrize("size", [0.03, 0.06, 0.1])
def test_a_contact_that_rubs_is_overcome(size):
    run = begin(holds=True, lag=0.2)

    def rubs(error, speed):
        if float(np.ravel(run.controller.time)[0]) < GRASP + 0.1:
            return 0.0
        still = np.abs(speed) < 2e-3
        return (
            np.where(still, np.clip(error, -size, size), size * np.sign(speed)) * np.eye(4)[1]
        )

    while not run.controller.finished:
        run.tick(0.05, rubs=rubs)
        assert sum(run.statuses.values()) * 0.05 < 25


@pytest.mark.parametrize("hertz", [50, 500])
@pytest.mark.parametrize("away", [0.0, 0.6])
def test_a_loop_that_stood_is_caught_up_with_gently(away, hertz):
    start = begin().reference + away * np.eye(4)[1]
    run = begin()
    run.controller = Controller(learned().skill, start, run.controller.holding.frames)
    run.reference = run.joints = start
    for k in range(hertz):
        before = run.reference
        run.tick(1 / hertz + 0.4 * (k == hertz // 3))
        bounds = learned().skill.motion_bounds.velocity.numpy() / hertz
        assert (np.abs(run.reference - before) <= 1.5 * bounds).all()


def test_milliseconds_hold_the_robot_and_are_named():
    run = begin()
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        commands = [run.controller.step(20.0, run.joints) for _ in range(5)]
    assert {str(one.status) for one in commands[1:]} == {"holding"}
    assert "seconds" in commands[-1].reason()
    assert {one.category for one in caught} == {PlausibilityWarning}
    assert np.array_equal(commands[-1].reference, run.joints)


@pytest.mark.parametrize("push", [0.2, -0.5])
def test_a_robot_that_is_elsewhere_at_the_end_has_not_finished(push):
    run = begin()
    while not run.controller.finished:
        assert str(run.tick().status) == "running"
    assert str(run.tick().status) == "finished"
    run.sag = push
    for _ in range(50):
        command = run.tick()
    assert str(command.status) == "waiting"
    assert f"joint 'b' is {-push:+.3f} off" in command.reason()
    run.sag = 0.0
    for _ in range(50):
        command = run.tick()
    assert str(command.status) == "finished"


def test_the_bounds_of_acceleration_alone_begin_no_search(monkeypatch):
    shown = learned()
    searches = []
    monkeypatch.setattr(PostureSearch, "advance", lambda *given: searches.append(given))
    tight = {"acceleration": 1.0, "jerk": 8.0}
    run = begin()
    frames = run.controller.holding.frames
    controller = Controller(shown.skill, run.reference, frames, bounds=tight)
    goal = Controller(shown.skill, run.reference, frames, bounds=None)
    for one in (controller, goal):
        while not one.finished:
            one.step(0.04, one.reference)
    for _ in range(100):
        controller.step(0.04, controller.reference)
    there, wanted = (
        shown.kinematics_.state(one.reference).position("hand") for one in (controller, goal)
    )
    assert float((there - wanted).norm()) < 2e-3
    assert not searches


def test_a_reference_that_cannot_keep_up_is_said_to_be_behind():
    run = begin()
    frames, start = run.controller.holding.frames, run.reference + 1.2 * np.eye(4)[1]
    slow = {"velocity": 0.3}
    with pytest.warns(PlausibilityWarning, match="start posture"):
        controller = Controller(learned().skill, start, frames, bounds=slow, blend=0.2)
    said = {controller.step(0.02, controller.reference).reason() for _ in range(40)}
    assert any("from what the skill wants, as fast as its bounds allow" in one for one in said)
    assert not any(run.tick().reason() for _ in range(40))


def test_what_runs_can_be_copied():
    time = np.linspace(0, 1, 40)
    joints = np.stack((np.sin(time), time), 1)
    shown = [Demonstration(time, joints + 0.01 * k) for k in range(3)]
    model = TaskParameterizedGMM(3).fit(shown)
    controller = Controller(model.skill, [0.0, 0.0])
    command = controller.step(0.02, [0.0, 0.0])
    for copied in (lambda one: pickle.loads(pickle.dumps(one)), copy.deepcopy):
        assert np.array_equal(copied(command).reference, command.reference)
        again = copied(controller).step(0.02, [0.0, 0.0])
        assert np.array_equal(again.reference, controller.copy().step(0.02, [0, 0]).reference)
