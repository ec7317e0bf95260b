"""LeRobot's calibration files: normalised values become the angles that LeRobot means."""

import json
import math

import numpy as np
import pytest
from lerobot.motors import MotorCalibration, MotorNormMode
from lerobot.motors.feetech import FeetechMotorsBus
from lerobot.motors.motors_bus import Motor

from tests.support.lerobot_sets import DATA, add_feature, change_table, set_column
from tpgmm_datasets import DatasetError, Scale, load_lerobot

RANGES = {"shoulder_pan": (718, 3417), "wrist_roll": (0, 4095), "gripper": (2030, 3500)}
NAMES = tuple(f"{name}.pos" for name in RANGES)


def motor(number, ends, drive_mode=0):
    return {
        "id": number, "drive_mode": drive_mode, "homing_offset": -7,
        "range_min": ends[0], "range_max": ends[1],
    }  # fmt: skip


@pytest.fixture
def file(tmp_path):
    motors = {name: motor(i, ends) for i, (name, ends) in enumerate(RANGES.items(), 1)}
    (tmp_path / "arm.json").write_text(json.dumps(motors))
    return tmp_path / "arm.json"


@pytest.fixture
def arm(root):
    """The set with a state of LeRobot's names, from one end of the ranges to the other."""
    rows = np.linspace(-100, 100, 36)[:, None] * [1, 1, 0.5] + [0, 0, 50]
    add_feature(root, "arm", rows, list(NAMES))
    return root


def read_by_lerobot(ticks, mode):
    """Normalise ticks as LeRobot stores them, by its own motor bus."""
    bus = FeetechMotorsBus.__new__(FeetechMotorsBus)  # without a port
    motors = {
        name: Motor(i, "sts3215", MotorNormMode.RANGE_0_100 if name == "gripper" else mode)
        for i, name in enumerate(RANGES, 1)
    }
    bus.motors = motors
    bus.calibration = {
        name: MotorCalibration(**motor(i, ends))
        for i, (name, ends) in enumerate(RANGES.items(), 1)
    }
    bus._id_to_model_dict = {m.id: m.model for m in motors.values()}
    bus._id_to_name_dict = {m.id: name for name, m in motors.items()}
    stored = bus._normalize(dict(enumerate(ticks, 1)))
    return [stored[i] for i in range(1, 4)]


def test_values_become_the_angles_that_lerobot_means(arm, file):
    shares = np.linspace(0, 1, 36)[:, None]
    ends = np.array(list(RANGES.values()))
    ticks = np.round(ends[:, 0] + shares * (ends[:, 1] - ends[:, 0])).astype(int)
    stored = np.array([read_by_lerobot(row, MotorNormMode.RANGE_M100_100) for row in ticks])
    degrees = np.array([read_by_lerobot(row, MotorNormMode.DEGREES) for row in ticks])
    change_table(arm, DATA, lambda t: set_column(t, "arm", lambda _: stored))
    read = load_lerobot(arm, joints="arm", calibration=file)
    found = np.concatenate([d.joints.numpy() for d in read])
    # LeRobot counts 4095 ticks to the turn where there are 4096
    expected = np.radians(degrees[:, :2]) * 4095 / 4096
    np.testing.assert_allclose(found[:, :2], expected, rtol=0, atol=1e-12)
    gripper = (ticks[:, 2] - ends[2].mean()) * math.tau / 4096
    np.testing.assert_allclose(found[:, 2], gripper, rtol=0, atol=1e-12)


def test_two_arms_have_a_file_each_and_units_by_name_come_first(root, file):
    rows = np.tile(np.linspace(0, 100, 36)[:, None], 6)
    names = [f"{side}_{name}" for side in ("left", "right") for name in NAMES]
    add_feature(root, "arms", rows, names)
    given = {"calibration": {"left_": file, "right_": str(file)}}
    given["units"] = {"right_gripper.pos": "raw"}
    [first, *_] = load_lerobot(root, joints="arms", **given)
    scales = [Scale.from_calibration(*ends) for ends in RANGES.values()][:2]
    scales.append(Scale.from_calibration(*RANGES["gripper"], stored=(0, 100)))
    scales = [*scales, *scales[:2], Scale(1.0)]
    expected = rows[:12] * [s.factor for s in scales] + [s.offset for s in scales]
    np.testing.assert_allclose(first.joints.numpy(), expected, rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("{", r"arm\.json: the calibration cannot be read"),
        ("[]", "a calibration is a JSON object of motors"),
        ({"shoulder_pan": {"id": 1}}, "'shoulder_pan' needs whole numbers"),
        ({"shoulder_pan": motor(1, (5, 5))}, "'shoulder_pan' needs whole numbers .* a range"),
        ({"elbow": motor(1, (0, 9))}, r"the motor 'elbow' is not among the val.*joint_names="),
        (
            {"wrist_roll": motor(1, (0, 9))},
            r"no motor for \['shoulder_pan\.pos', 'gripper\.pos'\].*--units shoulder_pan",
        ),
        (
            {"wrist_roll": motor(1, (0, 9), drive_mode=1)},
            r"'wrist_roll' has the drive mode 1.*Scale\.from_calibration\(0, 9",
        ),
    ],
)
def test_what_is_no_calibration_of_the_set_is_refused(arm, file, content, message):
    file.write_text(content if isinstance(content, str) else json.dumps(content))
    with pytest.raises(DatasetError, match=message):
        load_lerobot(arm, joints="arm", calibration=file)


def test_values_in_degrees_and_units_for_all_are_refused(arm, file):
    change_table(arm, DATA, lambda t: set_column(t, "arm", lambda values: 1.2 * values))
    with pytest.raises(DatasetError, match=r"goes from -120 to .*use_degrees.*units='deg'"):
        load_lerobot(arm, joints="arm", calibration=file)
    for options, message in (
        ({"calibration": file, "units": "deg"}, "give one of them"),
        ({"calibration": file.with_name("leg.json")}, r"cannot be read: .*leg\.json"),
        ({"calibration": 3}, "several by prefix; got"),
        ({"calibration": {"left_": None}}, "several by prefix; got"),
    ):
        with pytest.raises(DatasetError, match=message):
            load_lerobot(arm, joints="arm", **options)
