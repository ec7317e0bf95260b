"""What is sent: status and reasons of each robot, stiffness once it is asked for."""

import pytest
import torch

from tests.support.worlds import upper_body
from tpgmm_control.impedance.stiffness import Impedance, Stiffness
from tpgmm_control.loop.command import Command, Status
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_torch.regression.estimate import Estimate

WORDS = ["running", "waiting", "displaced", "holding", "finished"]


def command(*batch: int, codes=None, **options) -> Command:
    robot = upper_body()
    joints = robot.lower.new_zeros(*batch, robot.n_joints)
    covariance = torch.diag_embed(torch.full_like(joints, 0.01**2))
    codes = torch.zeros(batch, dtype=torch.int8) if codes is None else torch.tensor(codes)
    estimate = Estimate(joints, covariance, joints.new_ones(*batch, 1))
    defaults = {"impedance": Impedance(robot)}
    return Command(joints, joints, joints[..., 0], estimate, codes, **{**defaults, **options})


def test_a_single_robot_has_a_status_in_words():
    for code, word in enumerate(WORDS):
        assert command(codes=code).status == word == Status(word)
        assert Status(word).code == code


def test_each_robot_of_a_batch_has_its_own_status_and_reason():
    sent = command(2, 2, codes=[[0, 3], [4, 0]], reasons={(0, 1): "frame 'cup' is NaN"})
    assert sent.status == [["running", "holding"], ["finished", "running"]]
    assert sent.reason((0, 1)) == "frame 'cup' is NaN"
    assert sent.reason((1, 1)) == ""
    assert sent.of("holding").tolist() == [[False, True], [False, False]]
    assert sent.of(Status.RUNNING).tolist() == [[True, False], [False, True]]
    assert command(3, reasons={(2,): "late"}).reason(2) == "late"
    assert command(reasons={(): "late"}).reason() == "late"
    with pytest.raises(UnknownNameError, match=r"'asleep' is not in a command.*'holding'"):
        sent.of("asleep")


def test_stiffness_and_damping_are_those_of_the_impedance():
    rule = Stiffness(lowest=1.0, highest=300.0, effort=2.0, inertia=0.5, damping_ratio=1.0)
    sent = command(3, impedance=Impedance(upper_body(), rule))
    matrix = rule.matrix(sent.covariance)
    assert sent.stiffness.shape == sent.damping.shape == (3, 17)
    torch.testing.assert_close(sent.stiffness_matrix, matrix)
    torch.testing.assert_close(sent.stiffness.diag_embed(), matrix)  # of uncorrelated joints
    torch.testing.assert_close(sent.damping, 2 * (0.5 * sent.stiffness).sqrt())
    expected = sent.impedance.at_link("l_hand", sent.reference, sent.covariance)
    torch.testing.assert_close(sent.link_stiffness("l_hand"), expected)


def test_a_command_without_impedance_says_so():
    with pytest.raises(DataError, match=r"no stiffness.*Impedance\(kinematics\)"):
        _ = command(impedance=None).stiffness
