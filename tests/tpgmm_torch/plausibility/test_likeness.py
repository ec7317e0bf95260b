"""Copies, strangers, too few, and operators that look at what nobody carries."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from tests.support.skills import HANDLING, HANDS, handlings, waves
from tpgmm_torch import (
    AbsolutePosition,
    Canonical,
    Demonstration,
    Frame,
    Hold,
    Poses,
    RelativeOrientation,
    RelativePosition,
    Stack,
    TaskParameterizedGMM,
    quaternions,
)
from tpgmm_torch.exceptions import PlausibilityWarning
from tpgmm_torch.plausibility.check import summarize
from tpgmm_torch.plausibility.likeness import (
    check_carried_things,
    check_freedom,
    check_likeness,
)
from tpgmm_torch.robots.joint_space import JointSpace

HAND = Poses(["hand"], orientation=False)
PUT = RelativePosition("cup", "tray")


def found(items, robot=None):
    return [(f.check, f.episodes) for f in check_likeness(summarize(items, robot), robot)]


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


@pytest.mark.parametrize("named", [True, False])
def test_the_sign_of_a_quaternion_makes_no_stranger(named):
    tool, time = Poses(["tool"]), torch.linspace(0, 2, 40, dtype=torch.float64)
    turn = quaternions.exp(time[:, None] * torch.tensor([0.6, 0.0, 0.8]).double())
    shown = []
    for n in range(8):
        tilt = quaternions.exp(torch.tensor([0.02 * n, 0.0, 0.0]).double())
        # as trackers do: w >= 0, and two of them w <= 0
        q = quaternions.product(tilt, turn)
        q = torch.where(q[:, :1] < 0, -q, q) * (-1 if n in (2, 5) else 1)
        joints = torch.cat((torch.zeros(40, 3), q), dim=1)
        shown.append(
            Demonstration(time, joints, joint_names=tool.joint_names if named else None)
        )
    assert found(shown, None if named else tool) == []


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


@pytest.mark.parametrize(
    ("operator", "says"),
    [
        (PUT, False),
        (AbsolutePosition("cup"), False),
        (RelativeOrientation("cup", "tray", held=True), False),
        (RelativePosition("cup", "hand"), True),  # the hand moves
        (RelativePosition("hand", "cup"), True),
        (RelativePosition("hand", "cup", held=True), True),
        (Canonical(), True),
    ],
)
def test_what_never_moves_says_nothing_until_it_is_held(operator, says):
    operators = [Stack(operator, RelativePosition("hand", "tray"))]
    found = list(check_carried_things(operators, HAND, []))
    assert bool(found) != says
    assert not list(check_carried_things(operators, HAND, [Hold("cup", "hand")]))


def shown(carried):
    """A hand that goes to a cup and, perhaps, takes it to a tray."""
    time, rng, found = np.linspace(0, 2, 61), np.random.default_rng(0), []
    there = np.clip(time, 0, 1)[:, None]
    back = np.clip(time - 1, 0, 1)[:, None]
    for _ in range(5):
        cup, tray = rng.uniform(-0.3, 0.3, (2, 3))
        path = there * cup + back * (tray - cup) + 1e-4 * rng.normal(size=(61, 3))
        pose = np.where(time[:, None] <= 1, cup, path) if carried else np.tile(cup, (61, 1))
        frames = {"cup": Frame(pose), "tray": Frame(tray)}
        found.append(Demonstration(time, path, frames))
    return found


@pytest.mark.parametrize("robust", [True, False])
def test_fit_tells(robust):
    model = TaskParameterizedGMM(4, [PUT, Canonical()], HAND, robust=robust, random_state=0)
    with pytest.warns(PlausibilityWarning, match=r"no link holds cup: position:cup@tray says"):
        model.fit(shown(carried=False))
    model.fit(shown(carried=True))  # warnings are errors
    [hold] = model.holds_
    assert (hold.frame, hold.link) == ("cup", "hand") and math.isclose(
        hold.begin, 1, abs_tol=0.1
    )
