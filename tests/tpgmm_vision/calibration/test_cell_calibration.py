"""A robot's cell by its own motion: how exact, what is said, and what is refused."""

from dataclasses import replace

import numpy as np
import pytest

from tests.support.simulated_cells import (
    CUBE,
    HAND,
    SimulatedCell,
    robot_named,
    so101_cell,
    two_arm_cell,
    wrist_cell,
)  # fmt: skip
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_vision.calibration.cell_calibration import Mount, calibrate_cell
from tpgmm_vision.detection.tags import Detections
from tpgmm_vision.poses import inverse, rigid
from tpgmm_vision.targets import Target, cube

pytestmark = pytest.mark.slow

N = 30


def mounts(cell: SimulatedCell) -> dict[str, Mount]:
    return {name: Mount(target, link) for name, (target, _, link) in cell.targets.items()}


def calibrated(cell, rng, recorded=None, **changed):
    joints, seen = recorded or cell.recorded(N, rng)
    given = {"cameras": cell.described(), "mounts": mounts(cell), "bases": cell.bases} | changed
    return calibrate_cell(cell.robot, joints, seen, **given)


def away(cell, found, rng):
    """Between tags where cameras see them, and where the robot holds them at new postures."""
    joints = cell.postures(20, rng)
    names = cell.robot.joint_names
    believed = joints - cell.offsets + [found.joint_offsets.get(name, 0.0) for name in names]
    true, distances = cell.base, []
    for name, (target, pose, link) in cell.targets.items():
        for camera, (place, carrier) in cell.cameras.items():
            seen = (
                inverse(cell.links(joints, carrier) @ place) @ cell.links(joints, link) @ pose
            )
            cell.base = found.bases.get("right_", np.eye(4))
            said = cell.links(believed, carrier) @ found.cameras[camera] @ seen
            held = cell.links(believed, link) @ found.mounts[name]
            cell.base = true
            distances += np.linalg.norm((inverse(held) @ said)[:, :3, 3], axis=1).tolist()
        assert target
    return np.array(distances)


@pytest.mark.parametrize("make", [so101_cell, wrist_cell, two_arm_cell])
def test_what_cameras_see_is_where_hands_are(make):
    rng = np.random.default_rng(1)
    cell = make(1.0, rng, backlash=0.0)
    found = calibrated(cell, rng)
    distances = away(cell, found, rng)
    assert np.median(distances) < 0.0015
    assert np.quantile(distances, 0.95) < 0.003
    true = dict(zip(cell.robot.joint_names, cell.offsets, strict=True))
    known = [name for name in found.joint_offsets if name not in found.unknown]
    assert len(known) >= 3
    for name in known:
        error = abs(found.joint_offsets[name] - true[name])
        assert error < max(np.radians(0.3), 4 * found.uncertainty[name]), name
    assert not found.problems
    assert np.median(found.position_errors) < 0.004  # of single postures, noise of joints too
    assert np.radians(0.1) < found.joint_noise < np.radians(0.3)


def test_tags_that_stand_still_are_placed_and_are_no_hand():
    rng = np.random.default_rng(2)
    cell = so101_cell(1.0, rng, backlash=0.0)
    pose = rigid((0, 0, 0.5), (0.15, 0.1, 0.03))
    cell.targets["base"] = cube([0, 1, 2, 3, 4], 0.04), pose, None
    found = calibrated(cell, rng)
    # the camera's turn about the vertical and an offset are one freedom: judged by the camera
    [(place, _)] = cell.cameras.values()
    [camera] = found.cameras.values()
    there, said = inverse(place) @ pose, inverse(camera) @ found.mounts["base"]
    assert np.linalg.norm((there - said)[:3, 3]) < 0.002
    del cell.targets["base"]
    assert np.median(away(cell, found, rng)) < 0.003
    assert len(found.position_errors) < N  # only where the hand is seen


def test_what_no_picture_can_tell_is_zero_and_said():
    rng = np.random.default_rng(2)
    found = calibrated(so101_cell(1.0, rng), rng)
    assert found.unknown == ("shoulder_pan", "wrist_roll")
    assert found.joint_offsets["shoulder_pan"] == found.joint_offsets["wrist_roll"] == 0
    assert "shoulder_pan, wrist_roll" in str(found)


def test_a_wrong_focal_length_and_wrong_tags_are_said():
    rng = np.random.default_rng(3)
    cell = so101_cell(1.0, rng)
    recorded = cell.recorded(N, rng)
    larger = cube(list(CUBE.corners), 0.03 * 1.015)
    [said] = calibrated(cell, rng, recorded, mounts={"cube": Mount(larger, HAND)}).problems
    assert "tags are 1." in said and "smaller" in said and "ruler" in said
    [front] = cell.described().values()
    wrong = replace(front.camera, focal_length=(545.0, 545.0))
    cameras = {"front": replace(front, camera=wrong)}
    [said] = calibrated(cell, rng, recorded, cameras=cameras).problems
    assert "focal length of camera 'front'" in said and "too small" in said


@pytest.mark.parametrize("what", ["camera", "target"])
def test_what_was_moved_on_the_way_is_refused(what):
    rng = np.random.default_rng(4)
    cell = so101_cell(1.0, rng)
    joints = cell.postures(N, rng)
    seen = cell.corners(joints, rng)["front"][:18]
    push = rigid((0, 0, 0), (0.012, -0.016, 0.0))
    if what == "camera":
        cell.cameras["front"] = (cell.cameras["front"][0] @ push, None)
    else:
        cell.targets["cube"] = (CUBE, cell.targets["cube"][1] @ push, HAND)
    seen += cell.corners(joints, rng)["front"][18:]
    recorded = cell.measured(joints, rng), {"front": [Detections(one) for one in seen]}
    name = {"camera": "front", "target": "cube"}[what]
    match = rf"{what} '{name}' was moved by (1[6-9]|2[0-4]) mm .* at picture 1[78] of 30"
    with pytest.raises(DataError, match=match):
        calibrated(cell, rng, recorded)


def test_wrong_tags_do_not_count():
    rng = np.random.default_rng(5)
    cell = so101_cell(1.0, rng)
    joints, seen = cell.recorded(N, rng)
    for picture in (3, 17):
        number, corners = next(iter(seen["front"][picture].corners.items()))
        seen["front"][picture] = Detections({number: np.roll(corners, 1, axis=0)})
    found = calibrated(cell, rng, (joints, seen))
    assert found.problems[0].startswith("2 of")
    assert np.median(away(cell, found, rng)) < 0.004


def test_postures_that_do_not_tell_are_refused_with_what_is_missing():
    rng = np.random.default_rng(6)
    cell = so101_cell(1.0, rng)
    cell.middle, moving = cell.postures(1, rng)[0], np.array([1, 0, 0, 0, 0, 0])
    cell.reach = cell.reach * moving
    with pytest.raises(
        DataError, match=r"without rotation .* turn shoulder_lift \(. deg\), elbow"
    ):
        calibrated(cell, rng)
    joints, seen = so101_cell(1.0, rng).recorded(N, rng)
    few = {"front": [one if k < 5 else Detections() for k, one in enumerate(seen["front"])]}
    with pytest.raises(DataError, match=r"'front' sees tags of \['cube'\] in 5 of 30 pictures"):
        calibrated(cell, rng, (joints, few))


def test_what_does_not_go_together_is_refused():
    rng = np.random.default_rng(7)
    cell = so101_cell(1.0, rng)
    joints, seen = cell.recorded(10, rng)
    pictures, held, other = seen["front"], Mount(CUBE, HAND), Target({7: CUBE.corners[10]})
    twice = [*pictures[:-1], Detections(twice=frozenset([12]))]
    for shown, options, error, message in (
        ({"front": twice}, {}, DataError, r"sees tags twice, by picture \{9: \[12\]\}"),
        ({"side": pictures}, {}, UnknownNameError, "'side'"),
        ({"front": pictures[1:]}, {}, DataError, "9 pictures for 10 rows"),
        (seen, {"mounts": {"cube": Mount(CUBE, "l_hand")}}, UnknownNameError, "'l_hand'"),
        (seen, {"mounts": {"cube": Mount(CUBE)}}, DataError, "nothing moves"),
        (seen, {"mounts": {"a": held, "b": held}}, DataError, "share numbers of tags"),
        (
            seen,
            {"mounts": {"cube": held, "o": Mount(other, HAND)}},
            DataError,
            "no camera sees tags of",
        ),
        (seen, {"bases": ["right_"]}, DataError, "begin with 'right_'"),
    ):
        with pytest.raises(error, match=message):
            calibrated(cell, rng, (joints, shown), **options)
    with pytest.raises(DataError, match=r"shape \(n, 17\), those of \['waist_roll'"):
        calibrate_cell(robot_named("upper_body"), joints, seen, cell.described(), mounts(cell))
