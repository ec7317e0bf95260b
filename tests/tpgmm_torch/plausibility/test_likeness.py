"""Copies, strangers, and too few."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.skills import HANDLING, HANDS, handlings, waves
from tpgmm_torch import Canonical
from tpgmm_torch.plausibility.check import summarize
from tpgmm_torch.plausibility.likeness import check_freedom, check_likeness
from tpgmm_torch.robots.joint_space import JointSpace


def found(items):
    return [(f.check, f.episodes) for f in check_likeness(summarize(items, None))]


def test_demonstrations_of_one_skill_are_alike():
    assert found(waves(6)) == []


def test_copies_are_named_with_what_they_copy():
    shown = waves(4)
    assert found([*shown, shown[1], shown[1]]) == [("copies", (4, 5))]
    still = replace(shown[0], joints=0 * shown[0].joints)
    assert found([still, still]) == []


def test_a_motion_played_backwards_is_unlike_the_others():
    shown = waves(6)
    shown[3] = replace(shown[3], joints=shown[3].joints.flip(0))
    [(check, episodes)] = found(shown)
    assert (check, episodes) == ("episodes", (3,))


def test_joints_that_hardly_move_say_little():
    shown = waves(6)
    still = [np.tile([[0.1 * (n == 2)]], (30, 1)) for n in range(6)]
    wider = [
        replace(d, joints=np.hstack((d.joints, s)), joint_names=None)
        for d, s in zip(shown, still, strict=True)
    ]
    assert found(wider) == []


@pytest.mark.parametrize(
    ("n", "correlated", "told"),
    [
        (1, True, True),
        (1, False, True),
        (2, True, True),
        (2, False, False),
        (3, True, False),
    ],
)
def test_freedom(n, correlated, told):
    findings = list(check_freedom(n, HANDLING, HANDS, correlated))
    assert [f.check for f in findings] == ["freedom"] * told
    assert len(summarize(handlings(n), HANDS)) == n


def test_one_joint_alone_is_learned_from_two():
    assert list(check_freedom(2, [Canonical()], JointSpace(("a",)), correlated=True)) == []
