"""Poses of objects: every way to write one, and what does not fit."""

import math

import numpy as np
import pytest
import torch

from tests.support.lerobot_sets import DATA, add_feature, change_table, set_column
from tpgmm_datasets import DatasetError, FramePose, load_lerobot
from tpgmm_datasets.lerobot.layout import Feature
from tpgmm_torch import quaternions

POSITION = np.array([0.1, -0.2, 0.3])
RPY = np.array([0.3, -0.5, 1.1])


def euler_matrix(roll, pitch, yaw):
    def turn(axis, angle):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix = np.eye(3)
        matrix[[i, j], [i, j]] = math.cos(angle)
        matrix[i, j], matrix[j, i] = -math.sin(angle), math.sin(angle)
        return matrix

    return turn(2, yaw) @ turn(1, pitch) @ turn(0, roll)


QUATERNION = quaternions.from_matrix(torch.from_numpy(euler_matrix(*RPY)))
YAW = quaternions.from_matrix(torch.from_numpy(euler_matrix(0, 0, RPY[2])))


@pytest.mark.parametrize(
    ("values", "options", "expected"),
    [
        (QUATERNION.numpy(), {}, QUATERNION),
        (QUATERNION.numpy()[[1, 2, 3, 0]], {"rotation": "xyzw"}, QUATERNION),
        (quaternions.log(QUATERNION).numpy(), {"rotation": "rotvec"}, QUATERNION),
        (RPY, {"rotation": "euler"}, QUATERNION),
        (np.rad2deg(RPY), {"rotation": "euler", "degrees": True}, QUATERNION),
        (RPY[2:], {"rotation": "yaw"}, YAW),
        (RPY[:0], {"rotation": None}, quaternions.identity()),
    ],
)
def test_every_way_to_write_a_rotation_gives_the_same_frame(root, values, options, expected):
    row = np.concatenate((POSITION * 1000, values))
    add_feature(root, "observation.cup", np.tile(row, (36, 1)))
    pose = FramePose("observation.cup", scale=1e-3, **options)
    frame = load_lerobot(root, frames={"cup": pose})[0].frames["cup"]
    assert frame.batch_shape == ()
    torch.testing.assert_close(frame.position, torch.from_numpy(POSITION))
    turned = quaternions.match_hemisphere(frame.orientation, expected)
    torch.testing.assert_close(turned, expected)


def test_a_frame_is_constant_or_moves_and_is_chosen_by_place_or_name(root):
    values = np.random.default_rng(0).normal(size=(36, 5))
    add_feature(root, "observation.objects", values, list("abcde"))
    for columns in ([1, 2, 3], ["b", "c", "d"], slice(1, 4)):
        for constant in (True, False, None):
            pose = FramePose("observation.objects", columns, rotation=None, constant=constant)
            frame = load_lerobot(root, frames={"cup": pose})[1].frames["cup"]
            expected = values[12, 1:4] if constant else values[12:21, 1:4]
            torch.testing.assert_close(frame.position, torch.from_numpy(expected))


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (FramePose("observation.environment_state", rotation="xyzw"), "norm of a quaternion|"),
        (FramePose("observation.environment_state", rotation="yaw"), "needs 4 values"),
        (FramePose("observation.environment_state", ["bottle.x", "u"], None), "no value 'u'"),
        (FramePose("observation.environment_state", [0, 1, 9], None), "no value 9"),
    ],
)
def test_a_frame_that_does_not_fit_its_feature_is_refused(root, pose, message):
    def spoiled(values):
        return values * 2

    change_table(root, DATA, lambda t: set_column(t, "observation.environment_state", spoiled))
    with pytest.raises(DatasetError, match=message):
        load_lerobot(root, frames={"bottle": pose})


def test_an_unknown_rotation_is_refused():
    with pytest.raises(DatasetError, match="rotation 'wzyx'"):
        FramePose("x", rotation="wzyx")


def test_a_frame_that_is_stored_by_another_name_is_not_taken_for_it():
    names = [f"bottle.{part}" for part in ("x", "y", "z", "qw", "qx", "qy", "qz")]
    feature = Feature("observation.environment_state", "float32", (7,), tuple(names))
    with pytest.raises(DatasetError, match=r"'cup' is not stored there, \['bottle'\] are"):
        FramePose("observation.environment_state").select("cup", feature)
    named = FramePose("observation.environment_state", columns=names)
    assert named.select("cup", feature) == list(range(7))
