"""Units of stored values: named, declared, guessed, calibrated."""

import math

import pytest

from tests.support import lerobot_sets
from tpgmm_datasets import DatasetError, Scale, load_lerobot
from tpgmm_datasets.robots import parse_robot
from tpgmm_datasets.units import as_scale, guess_unit, units_of, with_pose_units


def test_declared_units_are_believed(root):
    expected = lerobot_sets.joints_of(load_lerobot(root))
    lerobot_sets.undeclared(root, 180 / math.pi)
    units = {"units": ["deg", "deg", "deg"]}
    lerobot_sets.change_info(
        root, lambda i: i["features"]["observation.state"].update(info=units)
    )
    lerobot_sets.assert_equal(lerobot_sets.joints_of(load_lerobot(root)), expected)


def test_values_that_cannot_be_radians_are_refused_until_said_what_they_are(root):
    lerobot_sets.undeclared(root, 1000)
    with pytest.raises(DatasetError, match=r"not radians: 'left_elbow' .*'deg'") as caught:
        load_lerobot(root)
    assert caught.value.column == "observation.state"
    assert caught.value.file == lerobot_sets.DATA
    raw = lerobot_sets.joints_of(load_lerobot(root, units="raw"))
    assert max(float(joints.abs().max()) for joints in raw) > 4 * math.pi


def test_values_that_are_no_joints_of_the_robot_need_no_unit(root):
    def percent(values):
        return values * [1, 1, 1000]

    lerobot_sets.change_table(
        root,
        lerobot_sets.DATA,
        lambda t: lerobot_sets.set_column(t, "observation.state", percent),
    )
    lerobot_sets.change_info(root, lambda i: i["features"]["observation.state"].pop("info"))
    seen = []
    load_lerobot(
        root,
        robot=lerobot_sets.Arm("left_elbow", "right_elbow"),
        events={"largest": lambda d: seen.append(d) or float(d.time[d.joints[:, 2].argmax()])},
    )
    assert seen[0].joint_names == lerobot_sets.NAMES


def test_scales_take_the_ends_of_a_range_to_each_other():
    scale = Scale.between((-100, 100), (-1.0, 3.0))
    assert [scale.factor * x + scale.offset for x in (-100, 0, 100)] == [-1.0, 1.0, 3.0]
    calibrated = Scale.from_calibration(1024, 3072)
    ends = [calibrated.factor * x + calibrated.offset for x in (-100, 100)]
    assert ends == pytest.approx([-math.pi / 2, math.pi / 2])
    ticks = Scale.ticks(4096, zero=2048)
    assert ticks.factor * 3072 + ticks.offset == pytest.approx(math.pi / 2)
    with pytest.raises(DatasetError, match="two different ends"):
        Scale.between((1, 1), (0, 1))


@pytest.mark.parametrize("zero", [None, 0, 1000, 1500, 2500])
@pytest.mark.parametrize("per_turn", [4096, 1000])
@pytest.mark.parametrize("stored", [(-100.0, 100.0), (0.0, 100.0)])
def test_calibrated_values_are_angles_from_the_zero(zero, per_turn, stored):
    low, high = 1000, 3000
    scale = Scale.from_calibration(low, high, per_turn=per_turn, zero=zero, stored=stored)
    for share in (0.0, 0.3, 1.0):
        value = stored[0] + share * (stored[1] - stored[0])
        tick = low + share * (high - low) - (2000 if zero is None else zero)
        angle = 2 * math.pi * tick / per_turn
        assert scale.factor * value + scale.offset == pytest.approx(angle, abs=1e-12)


@pytest.mark.parametrize(
    ("largest", "guess"),
    [
        (4 * math.pi, "rad"),
        (13, "deg or normalised"),
        (100, "deg or normalised"),
        (101, "deg"),
        (360, "deg"),
        (361, "ticks"),
    ],
)
def test_a_unit_is_guessed_from_the_range(largest, guess):
    assert guess_unit(0.0, largest) == guess_unit(-largest, 1.0) == guess


def test_values_of_poses_have_the_units_of_poses():
    names = ["elbow", *(f"cup.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz"))]
    units = ("deg", "m", "m", "m", "1", "1", "1", "1")
    assert with_pose_units(names, ["deg"] * 8) == units
    assert with_pose_units(names[:-1], ["deg"] * 7) == ("deg",) * 7
    assert with_pose_units(None, ["deg"]) == ("deg",)


@pytest.mark.parametrize("order", [1, -1])
def test_names_come_before_patterns_and_these_before_the_default(order):
    units = [("left_gripper.pos", "mm"), ("*", "deg"), ("lift", "m")][::order]
    given = dict([*units, ("*gripper", "rad"), ("left_*", "raw")])
    stored = ("left_gripper.pos", "left_elbow.pos", "right_gripper", "wrist", "up")
    final = ("left_gripper", "left_elbow", "right_gripper", "wrist", "lift")
    found = units_of(given, stored, final, None, "")
    assert found == ["mm", "raw", "rad", "deg", "m"]
    assert units_of({"*elbow": "deg"}, stored, final, None, "")[1:3] == ["deg", "auto"]


def test_lerobots_units_are_degrees_and_a_grippers_range():
    robot = parse_robot("bi_so101")
    stored = [f"{name}.pos" for name in robot.joint_names]
    known = units_of("lerobot", stored, robot.joint_names, robot, "")
    for name, unit, low, high in zip(stored, known, robot.lower, robot.upper, strict=True):
        scale, ends = as_scale(unit, ""), (float(low), float(high))
        if "gripper" in name:
            reached = [scale.factor * x + scale.offset for x in (0, 100)]
            assert reached == pytest.approx(ends) and scale.stored == (0, 100)
        else:
            assert unit == "deg"
    free = robot.drop_limits(["left_gripper", "right_gripper"])
    for other in (None, free, parse_robot("so101")):  # no limits of that joint are known
        found = units_of("lerobot", stored, robot.joint_names, other, "")
        assert found == ["raw" if "gripper" in name else "deg" for name in stored]
