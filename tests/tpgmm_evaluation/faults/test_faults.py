"""What the plants of the faults suite do, and what its measures call wrong."""

import numpy as np
import pytest

from tpgmm_evaluation.faults.drawing import KINDS, Fault, Run
from tpgmm_evaluation.faults.measures import false_status, measure
from tpgmm_evaluation.faults.runs import Log, Tick, simulate
from tpgmm_evaluation.faults.servos import Servo, Servos

ONE, FREE = np.eye(4)[1], np.array([[[-9.0]], [[9.0]]]) * np.ones((2, 1, 4))


def settled(servo, reference, **surroundings):
    """Where joints come to rest."""
    servos = Servos([servo], np.zeros((1, 4)), (-9 * np.ones(4), 9 * np.ones(4)), 2)
    servos.send(reference[None])
    none, walls = np.zeros((1, 4)), surroundings.pop("walls", FREE)
    for _ in range(400):
        servos.advance(np.array([0.02]), none > 0, none, walls, **surroundings)
    return servos.joints[:, 0]


def run(faults, rate=50.0, **servo):
    """Return a run of the arm with four joints."""
    return Run("four joints", rate, Servo(**servo), faults, 0, np.random.default_rng(0))


@pytest.mark.parametrize("stiffness", [0.3, 3.0, 30.0, np.inf])
def test_surfaces_yield_by_their_stiffness(stiffness):
    walls = np.where(FREE > 0, 0.1, FREE)
    robot, shadow = settled(Servo(damping=0.3), 0.5 * ONE, walls=walls, surface=stiffness)
    share = 0.0 if stiffness == np.inf else 1 / (1 + stiffness)
    assert robot[1] == pytest.approx(0.1 + 0.4 * share, abs=1e-3)
    assert shadow[1] == pytest.approx(0.5, abs=1e-3)


@pytest.mark.parametrize("way", [1, -1])
def test_what_rubs_does_so_on_both_sides(way):
    robot, _ = settled(Servo(), 0.5 * way * ONE, rubs=0.1)
    assert way * robot[1] == pytest.approx(0.4, abs=0.01)


def test_a_loop_that_stood_allows_no_longer_step():
    stalled = run([Fault("stall", 1.2, 3.0, np.ones(4), 0.9)])
    assert (stalled.given > 0.9).sum() == 2
    assert stalled.drive.max() < 0.0301
    assert run([]).drive == pytest.approx(0.02)


def test_every_kind_is_drawn_and_some_drives_are_as_they_were_shown():
    drawn = [Run.draw("development", seed, [50.0], ["sagging"]) for seed in range(150)]
    assert {fault.kind for one in drawn for fault in one.faults} == set(KINDS)
    assert all(0.05 < np.abs(one.servo.sag).max() < 0.11 for one in drawn)


def log_of(status, held):
    """Return a log of a robot of which a joint is held by 0.2 rad."""
    log = Log(run([Fault("hold", 0.0, 5.0, ONE)]))
    for k in range(100):
        still = np.zeros(4)
        joints = held * 0.2 * ONE
        row = (0.02, 0.02 * k, still, joints, still, still, joints, joints, 0.02 * k)
        log.rows.append(Tick(*row, status, True))
    return log


@pytest.mark.parametrize(
    ("status", "held", "false"),
    [("running", 1, True), ("finished", 1, True), ("waiting", 1, False), ("running", 0, False)],
)
def test_a_joint_that_is_held_is_waited_for(status, held, false):
    wrong = false_status(log_of(status, held))
    assert wrong[-1] == false
    assert not wrong[:20].any()


def test_a_run_ends_and_says_what_holds_it():
    [log] = simulate([run([Fault("hold", 1.0, 3.0, ONE)], noise=0.002)])
    found = measure(log)
    assert found["ended"]
    assert not found["stuck"]
    assert found["mute"] < 0.5
