"""Commands beyond postures, as the demonstrations' were."""

import numpy as np
import pytest

from tests.support.soft_drives import Drives, begin, learned

SAG = 0.06


def errors(run: Drives) -> np.ndarray:
    """How far the second joint is from where the skill has it, after the first second."""
    off = []
    while not run.controller.finished:
        command = run.tick()
        off.append(float(command.estimate.joints[1]) - run.joints[1])
    return np.abs(off[50:])


def test_a_robot_is_where_the_demonstrations_were_though_its_servos_sag():
    plain, learned_servo = begin(sag=None, sag_of_drives=SAG), begin(sag=SAG, sag_of_drives=SAG)
    assert np.median(errors(plain)) > 0.8 * SAG
    assert np.median(errors(learned_servo)) < 0.1 * SAG
    assert set(learned_servo.statuses) == {"running"}


def test_what_is_sent_stays_within_the_bounds():
    run, bounds = begin(sag=SAG, sag_of_drives=SAG), learned(sag=SAG).skill.motion_bounds
    before = run.reference
    while not run.controller.finished:
        run.tick()
        assert (np.abs(run.reference - before) <= 0.02 * bounds.velocity.numpy() + 1e-9).all()
        before = run.reference


@pytest.mark.parametrize("stop", [1.2, 3.5])
def test_a_stop_is_still_waited_for(stop):
    run = begin(sag=SAG, sag_of_drives=SAG)
    while not run.controller.finished:
        now = sum(run.statuses.values()) * 0.02
        run.tick(stopped=stop <= now < stop + 2)
        assert now < 12
    assert run.statuses["waiting"] * 0.02 == pytest.approx(2.0, abs=0.5)
