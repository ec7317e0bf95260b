"""What ``fit`` checks: units, one clock, enough demonstrations, objects that nobody holds."""

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.support.refusals import refused
from tests.support.skills import HANDLING, HANDS, handlings, waves
from tpgmm_torch import (
    AbsolutePosition,
    Canonical,
    Demonstration,
    Frame,
    Hold,
    RelativeOrientation,
    RelativePosition,
    Stack,
    TaskParameterizedGMM,
    attach_holds,
)
from tpgmm_torch.checks import check
from tpgmm_torch.checks.training import summarize
from tpgmm_torch.exceptions import PlausibilityWarning, ShapeError, UnknownNameError
from tpgmm_torch.robots import Poses
from tpgmm_torch.robots.kinematics import JointSpace

HAND = Poses(["hand"], orientation=False)
PUT = RelativePosition("cup", "tray")
SPACE = JointSpace(("a", "b", "c"))


def found(items, kinematics=SPACE, operators=(), **options):
    return list(check(summarize(items, kinematics), kinematics, operators, **options))


def test_what_a_summary_keeps():
    time = np.arange(6) / 2
    cup = np.zeros((6, 3))
    cup[2:, 1] = 0.3
    frames = {"cup": Frame(cup), "box": Frame([1, 0, 0])}
    shown = Demonstration(time, np.stack((time, -time), 1), frames, ("a", "b"), {"put": 0.5})
    [one] = summarize([shown], JointSpace(("b", "a")))
    assert (one.begin, one.duration, one.step) == (0.0, 2.5, 0.5)
    assert one.joint_names == ("b", "a") and one.events == {"put": 0.2}
    assert one.low.tolist() == [-2.5, 0] and one.high.tolist() == [0, 2.5]
    assert list(one.frames) == ["cup", "box"] and one.frames["cup"].recorded
    assert one.frames["cup"].moves and one.frames["cup"].high.tolist() == [0, 0.3, 0]
    assert not one.frames["box"].moves and not one.frames["box"].recorded


def test_good_demonstrations_give_no_findings():
    assert found(waves(6)) == []
    assert found(handlings(5), HANDS, HANDLING, correlated=True) == []


def test_joints_beyond_their_limits_by_a_turn_cannot_be():
    robot = JointSpace(("a", "b", "c"))
    robot.lower, robot.upper = robot.lower.new_full((3,), -2), robot.lower.new_full((3,), 2)
    assert found(waves(3), robot) == []
    wild = [replace(d, joints=d.joints * 9, joint_names=robot.joint_names) for d in waves(3)]
    [finding] = found(wild, robot)
    assert finding.check == "units" and finding.impossible and "degrees" in finding.remedy


def limit_joints():
    """A robot whose last joint may not go where the others may."""
    robot = JointSpace(("a", "b", "c"))
    robot.lower = robot.lower.new_tensor([-1.2, -1.2, -0.2])
    robot.upper = robot.upper.new_tensor([1.2, 1.2, 1.2])
    return robot


def test_joints_somewhat_beyond_their_limits_and_in_another_order_are_unlikely():
    shown = [replace(d, joint_names=None) for d in waves(3)]
    assert found(shown, limit_joints()) == []
    swapped = [replace(d, joints=d.joints[:, [2, 1, 0]]) for d in shown]
    [finding] = found(swapped, limit_joints())
    assert finding.check == "order" and "0] would fit the joints" in finding.message
    beyond = [replace(d, joints=d.joints + 2.0, joint_names=SPACE.joint_names) for d in shown]
    [finding] = found(beyond, limit_joints())
    assert (finding.check, finding.impossible) == ("limits", False)
    assert set(finding.names) == {"a", "b", "c"}
    model = TaskParameterizedGMM(2, [Canonical()], limit_joints(), random_state=0)
    with pytest.warns(PlausibilityWarning, match="order does not fit the limits"):
        model.fit(swapped)


def test_frames_and_time_in_other_units():
    far = [replace(d, frames={"cup": Frame([300, 20, 10])}) for d in waves(3)]
    assert [f.names for f in found(far)] == [("cup",)]
    slow = [replace(d, time=1000 * d.time) for d in waves(3)]
    assert [f.check for f in found(slow)] == ["time"]


def test_demonstrations_on_several_clocks():
    longer = [replace(d, time=d.time * (1 + n / 10)) for n, d in enumerate(waves(4))]
    later = [replace(d, time=d.time + n) for n, d in enumerate(waves(4))]
    for items, text in ((longer, "last from"), (later, "begin at different times")):
        [finding] = found(items)
        assert finding.check == "alignment" and text in finding.message


def test_segments_in_the_time_of_the_skill_are_on_its_clock():
    shown = waves(4)
    middle = replace(shown[0], time=shown[0].time * 0.4 + 0.6)
    assert found([*shown, middle]) == []
    for one, time in ((shown[0], shown[0].time * 0.5), (middle, middle.time + 2)):
        short = replace(one, time=time)
        assert [f.check for f in found([*shown, short])] == ["alignment"]


@pytest.mark.parametrize(
    ("n", "correlated", "few"),
    [(1, True, True), (1, False, True), (2, True, True), (2, False, False), (3, True, False)],
)
def test_few_demonstrations(n, correlated, few):
    findings = found(handlings(n), HANDS, HANDLING, correlated=correlated)
    assert [f.check for f in findings] == ["freedom"] * few
    assert found(waves(2), SPACE, [Canonical()], correlated=True) == []  # which has no frames


@pytest.mark.parametrize(("operator", "active"), [
    (PUT, False),
    (AbsolutePosition("cup"), False),
    (RelativeOrientation("cup", "tray", held=True), False),
    (RelativePosition("cup", "hand"), True),  # the hand moves
    (RelativePosition("hand", "cup"), True),
    (RelativePosition("hand", "cup", held=True), True),
    (Canonical(), True),
])  # fmt: skip
def test_an_object_that_never_moves_constrains_no_joint_until_it_is_held(operator, active):
    operators, shown = [Stack(operator, RelativePosition("hand", "tray"))], carrying(False)
    assert bool(found(shown, HAND, operators)) != active
    assert found(shown, HAND, operators, holds=[Hold("cup", "hand")]) == []


def carrying(carried):
    """A hand that goes to a cup and, perhaps, takes it to a tray."""
    time, rng, shown = np.linspace(0, 2, 61), np.random.default_rng(0), []
    there = np.clip(time, 0, 1)[:, None]
    back = np.clip(time - 1, 0, 1)[:, None]
    for _ in range(5):
        cup, tray = rng.uniform(-0.3, 0.3, (2, 3))
        path = there * cup + back * (tray - cup) + 1e-4 * rng.normal(size=(61, 3))
        pose = np.where(time[:, None] <= 1, cup, path) if carried else np.tile(cup, (61, 1))
        frames = {"cup": Frame(pose), "tray": Frame(tray)}
        shown.append(Demonstration(time, path, frames))
    return shown


def test_fit_warns_of_operators_of_objects_that_nothing_holds():
    model = TaskParameterizedGMM(4, [PUT, Canonical()], HAND, random_state=0)
    with pytest.warns(PlausibilityWarning, match=r"no link holds cup: position:cup@tray says"):
        model.fit(carrying(carried=False))
    model.fit(attach_holds(carrying(carried=True), HAND))  # warnings are errors
    [hold] = model.holds_
    assert (hold.frame, hold.link) == ("cup", "hand")
    assert math.isclose(hold.begin, 1, abs_tol=0.1)


def test_joints_that_the_robot_does_not_have_are_refused():
    with pytest.raises(ShapeError, match="has 3 joints, the robot has 4"):
        summarize(waves(2), JointSpace(("a", "b", "c", "d")))
    named = [replace(d, joint_names=("a", "b", "x")) for d in waves(2)]
    refused(lambda: summarize(named, SPACE), UnknownNameError, "'c' is not in")
