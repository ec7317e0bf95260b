import numpy as np
import pytest

from tests.support.drawn_tags import CAMERA, drawn, look_at
from tpgmm_datasets.robots import so101_urdf
from tpgmm_torch import Robot
from tpgmm_torch.exceptions import DataError, UnknownNameError
from tpgmm_vision.cell import camera_content, camera_poses, cell_from, pose_content
from tpgmm_vision.detection.tag_source import TagSource
from tpgmm_vision.poses import inverse, pose_matrix, pose_vector, rigid
from tpgmm_vision.sources import pose_source
from tpgmm_vision.targets import target_from

KEY = "observation.images.front"
EYE = look_at((0.7, 0.2, 0.5), (0.2, 0.0, 0.05))
CUP = {
    "target": {"cube": [10, 11, 12, 13, 14], "size": 0.04},
    "pose": [0, 0, -0.08, 1, 0, 0, 0],
}
BASE = {"target": {"tag": 0, "size": 0.06}, "pose": [0.1, 0.15, 0.0, 1, 0, 0, 0]}


def content(**more):
    camera = camera_content(CAMERA, KEY) | {"pose": pose_content(EYE)}
    return {
        "cameras": {"front": camera},
        "objects": {"cup": CUP},
        "checks": {"base": BASE},
    } | more


def picture(cup, rng, base_from_camera=EYE, twice=False):
    target = target_from(CUP["target"])
    things = [(target_from(BASE["target"]), pose_matrix(BASE["pose"]))]
    if cup is not None:
        things.append((target, cup @ inverse(pose_matrix(CUP["pose"]))))
        if twice:
            moved = rigid((0, 0, 0), (0.0, -0.2, 0.0)) @ cup
            things.append((target, moved @ inverse(pose_matrix(CUP["pose"]))))
    return {KEY: drawn(CAMERA, base_from_camera, things, rng)}


def test_an_object_is_found_lost_and_found_again():
    rng, source = np.random.default_rng(0), TagSource(cell_from(content()))
    cup = rigid((0, 0, 0.7), (0.2, 0.0, 0.0))
    never = source.poses(picture(None, rng), {}, 0.0)["cup"]
    assert not never.valid and np.isnan(never.pose).all() and "no tag" in never.reason
    for tick in range(1, 4):
        seen = source.poses(picture(cup, rng), {}, 0.04 * tick)["cup"]
        assert seen.valid and np.linalg.norm(seen.pose[:3] - cup[:3, 3]) < 0.001
    lost = source.poses(picture(None, rng), {}, 1.0)["cup"]
    assert not lost.valid and "for 0.9 s" in lost.reason and np.isfinite(lost.pose).all()
    moved = rigid((0, 0, 0.7), (0.25, -0.05, 0.0))
    again = source.poses(picture(moved, rng), {}, 1.04)["cup"]
    assert again.valid and np.linalg.norm(again.pose[:3] - moved[:3, 3]) < 0.001
    source.reset()
    assert np.isnan(source.poses(picture(None, rng), {}, 0.0)["cup"].pose).all()


def test_no_pose_is_valid_while_a_camera_was_moved():
    rng, source = np.random.default_rng(1), TagSource(cell_from(content()))
    cup = rigid((0, 0, 0.7), (0.2, 0.0, 0.0))
    knocked = EYE @ rigid((0.0, 0.03, 0.0), (0.02, 0.0, 0.0))
    source.poses(picture(cup, rng), {}, 0.0)
    for tick in range(1, 8):
        found = source.poses(picture(cup, rng, knocked), {}, 0.04 * tick)["cup"]
        assert not found.valid or np.linalg.norm(found.pose[:3] - cup[:3, 3]) < 0.001
        assert bool(source.problem) == (tick >= 3)
    assert "camera 'front' was moved by 20 mm" in source.problem == found.reason
    assert source.poses(picture(cup, rng), {}, 0.4)["cup"].valid and not source.problem


def test_a_tag_that_is_there_twice_has_no_pose():
    rng, source = np.random.default_rng(2), TagSource(cell_from(content()))
    found = source.poses(picture(rigid((0, 0, 0.7), (0.2, 0.1, 0.0)), rng, twice=True), {}, 0.0)
    assert not found["cup"].valid and "is seen twice" in found["cup"].reason


def test_a_camera_on_a_link_moves_with_it():
    arm = Robot.from_urdf(so101_urdf(), ["gripper_frame_link"])
    joints = dict.fromkeys(arm.joint_names, 0.0) | {"shoulder_pan": 0.3, "elbow_flex": -0.4}
    on_link = rigid((0.1, 0.2, 0.3), (0.0, 0.05, -0.02))
    camera = camera_content(CAMERA, KEY) | {"link": "gripper_frame_link"}
    cell = cell_from(
        content(cameras={"wrist": camera | {"pose": pose_vector(on_link).tolist()}})
    )
    state = arm.state([[joints[name] for name in arm.joint_names]])
    hand = np.r_[
        state.position("gripper_frame_link")[0], state.orientation("gripper_frame_link")[0]
    ]
    expected = pose_matrix(hand) @ on_link
    np.testing.assert_allclose(camera_poses(cell, arm, joints)["wrist"], expected, atol=1e-9)
    with pytest.raises(DataError, match="on links"):
        TagSource(cell)
    with pytest.raises(UnknownNameError, match="shoulder_pan"):
        camera_poses(cell, arm, {})


def test_bad_cells_and_pictures_are_refused():
    arm = Robot.from_urdf(so101_urdf(), ["gripper_frame_link"])
    unplaced = {"cameras": {"front": camera_content(CAMERA, KEY)}}
    for make, changes, error, message in (
        (TagSource, unplaced, DataError, "tpgmm calibrate cell"),
        (TagSource, {"objects": {}}, DataError, "no objects"),
        (lambda c: TagSource(c, arm), {"joints": ["waist_yaw"]}, DataError, "another robot"),
        (pose_source, {"source": "lidar"}, UnknownNameError, "source 'lidar'"),
    ):
        with pytest.raises(error, match=message):
            make(cell_from(content(**changes)))
    source, rng = pose_source(cell_from(content())), np.random.default_rng(3)
    [shown] = picture(None, rng).values()
    with pytest.raises(UnknownNameError, match=r"observation\.images\.front"):
        source.poses({"observation.images.side": shown}, {}, 0.0)
    with pytest.raises(DataError, match="640 x 480 pixels, got 320 x 240"):
        source.poses({KEY: shown[::2, ::2]}, {}, 0.0)
