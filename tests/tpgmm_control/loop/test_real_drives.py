"""What the guide's page on real robots says of drives, tried on simulated ones."""

import numpy as np
import pytest

from tests.support.skills import bottle_demonstrations, small_bottle
from tpgmm_control import Controller
from tpgmm_evaluation.faults.servos import Servo, Servos

pytestmark = pytest.mark.slow

PERIOD = 0.02
STEPS = np.arange(1, 21)[:, None] / 20  # 1 kHz
SHOWN = bottle_demonstrations()[5]


def begun(clock="localizing"):
    return Controller(small_bottle().skill, SHOWN.joints[0], SHOWN.frames, clock=clock)


def test_between_ticks_the_cubic_is_smooth_and_late_and_others_step():
    controller, commands = begun(), []
    while not controller.finished:
        command = controller.step(PERIOD, controller.reference)
        commands.append((command.reference.numpy(), PERIOD * command.velocity.numpy()))
    s, q, v = STEPS, *(np.array(part)[:, None] for part in zip(*commands, strict=True))
    cubic = (2 * s**3 - 3 * s**2 + 1) * q[:-1] + (s**3 - 2 * s**2 + s) * v[:-1]
    cubic = cubic + (3 * s**2 - 2 * s**3) * q[1:] + (s**3 - s**2) * v[1:]
    ways = cubic, q[:-1] + s * (q[1:] - q[:-1]), (q + s * v)[:-1], (q + 0 * s)[:-1]
    steps, jerks = (
        np.array([np.abs(np.diff(way.reshape(-1, 17), n, axis=0)).max() for way in ways])
        for n in (1, 2)
    )
    # of a line, of extrapolated references and of those that are held, in units of the cubic's
    assert steps[0] == pytest.approx(0.7e-3, rel=0.1)
    assert steps[1:] / steps[0] == pytest.approx([1, 5, 20], rel=0.1)
    assert jerks[1] / jerks[0] == pytest.approx(3, rel=0.1)


def driven(servo, clock="localizing", integral=np.inf, seconds=30.0):
    """The last command, all statuses, seconds, and the gaps at each tick [rad]."""
    controller, start = begun(clock), SHOWN.joints[:1].numpy()
    robot = small_bottle().kinematics_
    limits = robot.lower.numpy() - 1, robot.upper.numpy() + 1
    servos = Servos([servo], start, limits, round(seconds / PERIOD) + 1)
    none, free = np.zeros_like(start), np.stack((start - 9, start + 9))
    statuses, gaps, correction = [], [], 0.0
    while not controller.finished and len(gaps) < seconds / PERIOD:
        joints = servos.joints[0, 0]
        command = controller.step(PERIOD, joints)
        gap = command.reference.numpy() - joints
        correction = np.clip(correction + PERIOD / integral * gap, -0.3, 0.3)
        servos.send(command.reference.numpy()[None] + correction)
        servos.advance(np.array([PERIOD]), none > 0, none, free)
        statuses.append(command.status)
        gaps.append(np.abs(gap).max())
    return command, {*statuses}, len(gaps) * PERIOD, gaps


LAST = float(small_bottle().time_[-1]) + 0.1


@pytest.mark.parametrize("servo", [Servo(lag=0.3), Servo(lag=0.5), Servo(delay=PERIOD)])
def test_a_drive_that_is_late_needs_no_setting_and_less_speed_brings_it_nearer(servo):
    _, statuses, seconds, gaps = driven(servo)
    assert statuses == {"running"} and seconds < LAST + 1
    _, statuses, _, slow = driven(servo, clock="localizing:speed=0.5")
    assert statuses == {"running"} and max(slow) < 0.8 * max(gaps)


def test_a_drive_that_sags_is_told_of_and_an_integral_term_corrects_it():
    sags = Servo(sag=0.1)
    command, statuses, seconds, gaps = driven(sags)
    assert statuses == {"running"} and seconds < LAST + 1
    assert float(command.offset.abs().max()) == pytest.approx(0.1, rel=0.05)
    assert gaps[-1] == pytest.approx(0.1, rel=0.05)
    _, statuses, seconds, gaps = driven(sags, integral=1.0)
    assert statuses <= {"running", "waiting"} and seconds < LAST + 1
    assert gaps[-1] < 0.01


def test_a_drive_that_sticks_ends_late_or_is_waited_for_by_name():
    _, statuses, seconds, _ = driven(Servo(stiction=0.04))
    assert "running" in statuses and seconds < 30
    command, *_ = driven(Servo(stiction=0.25), seconds=5.0)
    assert command.status == "waiting" and command.reason().startswith("joint '")
