"""Bounds from a robot, demonstrations and the user; what contradicts is refused."""

import warnings

import pytest
import torch

from tests.support.refusals import refused
from tests.support.robot_zoo import ZOO, upper_body, zoo
from tpgmm_datasets.robots import upper_body_urdf
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DataError, MissingLimitsWarning, ShapeError, UnknownNameError
from tpgmm_torch.motion.motion_bounds import MotionBounds
from tpgmm_torch.robots.kinematics import JointSpace

ROBOT = JointSpace(["a", "b"])


def peaks(acceleration, jerk):
    return torch.tensor(acceleration).double(), torch.tensor(jerk).double()


def test_a_robots_limits_and_documented_defaults():
    robot = upper_body()
    bounds = MotionBounds.of(robot)
    assert torch.equal(bounds.lower, robot.lower) and torch.equal(bounds.upper, robot.upper)
    assert torch.equal(bounds.velocity, robot.velocity)
    # the speed limit of 4 rad/s in 0.1 s, and that acceleration in 0.025 s
    assert bounds.acceleration.tolist() == [40.0] * 17
    assert bounds.jerk.tolist() == [1600.0] * 17


def test_what_was_demonstrated_counts_with_a_margin():
    shown = peaks([1.0, 9.0] + [0.0] * 15, [4.0, 2000.0] + [0.0] * 15)
    bounds = MotionBounds.of(upper_body(), shown)
    # at least the speed limit in 0.25 s
    assert bounds.acceleration.tolist() == [16.0, 27.0] + [16.0] * 15
    assert bounds.jerk.tolist() == [640.0, 6000.0] + [640.0] * 15


def test_without_limits_of_speed_demonstrations_alone_tell():
    # the second joint was shown at constant speed
    bounds = MotionBounds.of(ROBOT, peaks([2.0, 1e-12], [10.0, 1e-10]))
    assert bounds.acceleration.tolist() == [6.0, torch.inf]
    assert bounds.jerk.tolist() == [240.0, torch.inf]
    assert bounds.velocity.tolist() == [torch.inf] * 2
    assert MotionBounds.of(ROBOT).acceleration.tolist() == [torch.inf] * 2


def test_speeds_of_motors_without_load_are_no_reason_to_hurry():
    """A description of 37 rad/s: as fast as one of 4, or as the joint that moved most."""
    text = upper_body_urdf().replace('velocity="4"', 'velocity="37"')
    robot = Robot.from_urdf(text, ("l_hand",))
    still = [0.0] * (robot.n_joints - 1)
    calm, lively = (
        MotionBounds.of(robot, peaks([most, *still], [0.0, *still])) for most in (0.1, 9.0)
    )
    assert {*calm.acceleration.tolist()} == {16.0} and {*calm.velocity.tolist()} == {37.0}
    assert {*lively.acceleration.tolist()} == {27.0}
    assert {*MotionBounds.of(robot).acceleration.tolist()} == {40.0}


def test_what_the_description_says_wins():
    limit = 'velocity="3" acceleration="7" deceleration="6" jerk="50"/>'
    robot = Robot.from_urdf(ZOO.replace('velocity="3"/>', limit), ("flange",), joints=["elbow"])
    bounds = MotionBounds.of(robot, peaks([100.0], [1e4]))
    assert (bounds.acceleration.tolist(), bounds.jerk.tolist()) == ([6.0], [50.0])


def test_the_user_tightens_them():
    robot = upper_body()
    bounds = MotionBounds.of(
        robot,
        velocity=1.0,
        acceleration={"waist_yaw": 2.0},
        jerk=torch.full((17,), 30.0),
        upper={"waist_roll": 0.1},
    )
    assert bounds.velocity.tolist() == [1.0] * 17
    assert bounds.acceleration.tolist() == [10.0] * 2 + [2.0] + [10.0] * 14
    assert bounds.jerk.tolist() == [30.0] * 17
    assert float(bounds.upper[0]) == 0.1 and torch.equal(bounds.upper[1:], robot.upper[1:])


@pytest.mark.parametrize(("given", "error", "message"), [
    ({"velocity": 5.0}, DataError, r"velocity is wider .* waist_roll 5 \(robot: 4\)"),
    ({"upper": {"waist_roll": 3.0}}, DataError, r"upper is wider .* waist_roll 3 \(rob"),
    ({"lower": {"waist_yaw": -9.0}}, DataError, "lower is wider"),
    ({"lower": {"l_elbow": -0.1}, "upper": {"l_elbow": -0.2}}, DataError, "lower must not"),
    ({"velocity": 0.0}, DataError, "velocity must be greater than 0: joint 0"),
    ({"acceleration": -1.0}, DataError, "acceleration must be greater than 0"),
    ({"jerk": {"elbow": 1.0}}, UnknownNameError, "joint 'elbow' is not in the robot"),
    ({"speed": 1.0}, UnknownNameError, "bound 'speed' is not in .* 'velocity'"),
    ({"jerk": [1.0, 2.0]}, ShapeError, "jerk is one number or one for each of the 17"),
    ({"jerk": float("nan")}, DataError, "jerk holds 1 value"),
])  # fmt: skip
def test_what_contradicts_is_refused(given, error, message):
    refused(lambda: MotionBounds.of(upper_body(), **given), error, message)


def test_bounds_of_other_joints_are_refused():
    with pytest.raises(ShapeError, match=r"peaks .* shape \(17,\), got \(2,\)"):
        MotionBounds.of(upper_body(), peaks([1.0, 2.0], [1.0, 2.0]))
    two, three = torch.ones(2), torch.ones(3)
    with pytest.raises(ShapeError, match=r"velocity has shape \(3,\), lower has \(2,\)"):
        MotionBounds(-two, two, three, two, two)


def test_a_description_without_limits_is_told_once():
    robot = zoo(("flange",))
    with pytest.warns(MissingLimitsWarning, match=r"joints \['swivel'\]") as told:
        MotionBounds.of(robot)
    assert len(told) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert MotionBounds.of(robot, velocity=0.1).velocity.tolist() == [0.1] * 5
        MotionBounds.of(ROBOT)  # nothing is described, so nothing is missing
